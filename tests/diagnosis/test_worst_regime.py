"""Driving condition with the largest errors."""

import numpy as np

from carlab.diagnosis.report.sentences import regime_clause
from carlab.diagnosis.unexplained.description import worst_regime


def test_rounding_errors_of_constant_commands_are_no_steering_rate() -> None:
    """The steering changes in 30 of 100 windows, where the error is larger; in the others it is constant."""
    changes = np.arange(100) >= 70
    rates = np.where(changes, 2.0, 1e-13 * np.arange(100))
    same = dict.fromkeys(("v", "w", "r", "d", "u", "du", "t"), np.ones(100))
    regime = worst_regime(same | {"dd": rates}, np.where(changes, 3.0, 1.0))
    assert regime == "|steering rate| > 0 /s"
    assert regime_clause(regime) == "mostly while the steering changes"
