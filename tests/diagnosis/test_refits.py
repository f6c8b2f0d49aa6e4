"""Refits of a search: equal ones are not repeated, whatever the order of their effects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from carlab.diagnosis.identification.fit import Scale
from carlab.diagnosis.selection import refit as refit_module
from carlab.diagnosis.selection.problem import Model, SearchProblem
from carlab.diagnosis.selection.refit import refit
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from sim_backends.car_parameters import MocapParameters
from tests.helpers.recorded_drives import PERIOD_S, drive

LAG, BRAKE = "steering_lag", "brake_asymmetry"
CAR = SimulatorConfig(control_period_s=PERIOD_S, mocap=MocapParameters(latency_s=0.0))
STD = 3e-4 * np.array([1.0, 1.0, 2.0, 20.0, 20.0, 40.0])


def test_refit_with_effects_in_another_order_is_not_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Effects and parameters of the result have the requested order."""
    true = replace(CAR, effects={LAG: {"time_constant": 0.05}})
    problem = SearchProblem(CAR, cut_windows(segments_of([drive(true, 10.0, 3)]), 0.8, 0.5), 3.0 * STD, STD, {})
    scale = Scale(np.array([8, 16, 24]), np.tile(3.0 * STD, (3, 1)))
    nothing = problem.fitter(scale).fit(CAR, ())
    first = refit(problem, (LAG, BRAKE), nothing, scale)

    def refuse(*arguments: object) -> Model:
        raise AssertionError("the refit is repeated")

    monkeypatch.setattr(refit_module, "_fit_from", refuse)
    second = refit(problem, (BRAKE, LAG), nothing, scale)
    assert second.effects == (BRAKE, LAG)
    assert second.fit.free == problem.free_parameters((BRAKE, LAG))
    assert second.fit.values() == first.fit.values()
    assert second.fit.cost == first.fit.cost
    with pytest.raises(AssertionError, match="repeated"):
        refit(problem, (LAG,), nothing, scale)
