"""Class of the missing physics: which unnamed terms describe a residual."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from carlab.diagnosis import naming
from carlab.diagnosis.settings import DEFAULT
from carlab.diagnosis.unexplained.description import ChosenTerm, ResidualModel
from carlab.diagnosis.unexplained.residual_terms import MAX_STEP_SHARE, STEP_SHARES, TERMS

ERROR = np.tile([3.0, 1.0, 1.0, 1.0, 1.0, 1.0], (20, 1))
"""Held-out errors [noise floors] with an excess of 8 squared noise floors in x."""


def described(monkeypatch: pytest.MonkeyPatch, fall: float, *, is_significant: bool = False) -> str:
    """Class statement of a residual with one term that lowers the squared error in x by ``fall``."""
    chosen = (ChosenTerm(TERMS[0], 0, 1.0, 9.0),)
    terms = ResidualModel(chosen, np.array([fall, 0.0, 0.0, 0.0, 0.0, 0.0]))
    monkeypatch.setattr(naming, "fit_residual_terms", lambda *arguments: terms)
    monkeypatch.setattr(naming, "start_features", lambda windows: {})
    monkeypatch.setattr(naming, "worst_regime", lambda features, errors: "everywhere alike")
    found = SimpleNamespace(scale=None, best=None, effects=())
    result: Any = naming.NamingResult(found, terms if is_significant else ResidualModel(()), None, None)  # type: ignore[arg-type]
    problem: Any = SimpleNamespace(fitter=lambda scale: None, settings=DEFAULT)
    held_out: Any = SimpleNamespace(floor=np.ones(6), windows=None)
    return naming.describe_unexplained(problem, result, 1.0, ERROR, held_out)[0].kind


def test_weak_term_that_explains_little_is_no_class(monkeypatch: pytest.MonkeyPatch) -> None:
    """The best of 600 terms and channels is a weak term by chance, for example steps of a throttle for a carpet."""
    assert described(monkeypatch, 0.4).startswith("no term of the library explains it")
    assert described(monkeypatch, 4.0).startswith(TERMS[0].statement)
    assert described(monkeypatch, 0.4, is_significant=True).startswith(TERMS[0].statement)


def test_long_period_over_a_command_is_no_quantisation() -> None:
    """A battery that sags with the current gives a curve over the throttle with less than two periods."""
    statements = {t.formula: t.statement for t in TERMS if "steps" in t.inputs}
    for share in STEP_SHARES:
        is_step = "as if the throttle were quantised" in statements[f"sin(2 pi u / {share:.3g})"]
        assert is_step is (share <= MAX_STEP_SHARE)
