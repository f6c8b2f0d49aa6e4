"""Concealed proof: a generator, a seal and a scorer that know nothing of the tool they try."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from carlab.concealment.base_car import BaseCar
    from carlab.concealment.case import Case, make_case
    from carlab.concealment.catalogue import EFFECT_IDS
    from carlab.concealment.judge import judge
    from carlab.concealment.proof_set import CaseSpec, full_set, short_set
    from carlab.concealment.runner import Proof
    from carlab.concealment.scores import draw_confusion, judge_all, summarise, table_rows, write_scores

__all__ = [
    "EFFECT_IDS",
    "BaseCar",
    "Case",
    "CaseSpec",
    "Proof",
    "draw_confusion",
    "full_set",
    "judge",
    "judge_all",
    "make_case",
    "short_set",
    "summarise",
    "table_rows",
    "write_scores",
]

_HOME = {
    "EFFECT_IDS": "catalogue",
    "BaseCar": "base_car",
    "Case": "case",
    "CaseSpec": "proof_set",
    "Proof": "runner",
    "draw_confusion": "scores",
    "full_set": "proof_set",
    "judge": "judge",
    "judge_all": "scores",
    "make_case": "case",
    "short_set": "proof_set",
    "summarise": "scores",
    "table_rows": "scores",
    "write_scores": "scores",
}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"carlab.concealment.{_HOME[name]}"), name)
    raise AttributeError(f"module 'carlab.concealment' has no attribute '{name}'")
