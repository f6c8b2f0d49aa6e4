"""Proof on concealed effects: generator, sealed answers and scores, independent of the diagnosis that they test."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from carlab.benchmark.cases.case import Case, make_case
    from carlab.benchmark.cases.proof_set import CaseSpec, full_set, short_set
    from carlab.benchmark.effects.catalogue import EFFECT_IDS
    from carlab.benchmark.proof.case_score import score_case
    from carlab.benchmark.proof.runner import Proof
    from carlab.benchmark.proof.scores import draw_confusion, score_cases, summarise, table_rows, write_scores
    from carlab.benchmark.world.base_car import BaseCar

__all__ = [
    "EFFECT_IDS",
    "BaseCar",
    "Case",
    "CaseSpec",
    "Proof",
    "draw_confusion",
    "full_set",
    "make_case",
    "score_case",
    "score_cases",
    "short_set",
    "summarise",
    "table_rows",
    "write_scores",
]

_MODULES = {
    "EFFECT_IDS": "effects.catalogue",
    "BaseCar": "world.base_car",
    "Case": "cases.case",
    "CaseSpec": "cases.proof_set",
    "Proof": "proof.runner",
    "draw_confusion": "proof.scores",
    "full_set": "cases.proof_set",
    "score_case": "proof.case_score",
    "score_cases": "proof.scores",
    "make_case": "cases.case",
    "short_set": "cases.proof_set",
    "summarise": "proof.scores",
    "table_rows": "proof.scores",
    "write_scores": "proof.scores",
}


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(importlib.import_module(f"carlab.benchmark.{_MODULES[name]}"), name)
    raise AttributeError(f"module 'carlab.benchmark' has no attribute '{name}'")
