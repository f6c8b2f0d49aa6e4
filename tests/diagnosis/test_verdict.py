"""The verdict without named effects depends on the held-out score and on faults of the recording."""

import numpy as np
import pytest

from carlab.diagnosis.evidence import ScoredSearch, verdict_of
from carlab.diagnosis.findings import DataFault
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.held_out_errors import HeldOut
from carlab.diagnosis.identification.measurement_noise import Noise
from carlab.diagnosis.selection.problem import SearchProblem, SearchResult
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from sim_backends.car_parameters import MocapParameters
from tests.helpers.recorded_drives import PERIOD_S, drive

CAR = SimulatorConfig(control_period_s=PERIOD_S, mocap=MocapParameters(latency_s=0.0))
STD = 3e-4 * np.array([1.0, 1.0, 2.0, 20.0, 20.0, 40.0])
SLOW = DataFault("slow_poses", "vx, vy, yaw_rate", 900, "reported: the poses are 0.05 s apart.")
OTHER = DataFault("estimated_velocity", "vx, vy, yaw_rate", 900, "reported: the velocities are estimated.")


@pytest.fixture(scope="module")
def scored() -> ScoredSearch:
    """A search without effects on a drive of the car of the car file."""
    windows = cut_windows(segments_of([drive(CAR, 10.0, 3)]), 0.8, 0.5)
    problem = SearchProblem(CAR, windows, 3.0 * STD, STD, {})
    scale = Scale(np.array([8, 16, 24]), np.tile(3.0 * STD, (3, 1)))
    fit = problem.fitter(scale).fit(CAR, ())
    found = SearchResult(fit, fit, (), {}, {}, (), (), scale)
    return ScoredSearch(problem, found, HeldOut(windows, STD, Noise(STD, STD)), fit, {})


@pytest.mark.parametrize(
    ("score", "has_unnamed", "fault", "verdict"),
    [
        (1.1, True, OTHER, "none"),
        (1.3, True, OTHER, "unexplained"),
        (1.7, True, OTHER, "unexplained"),
        (1.7, False, OTHER, "none"),
        (1.9, False, OTHER, "unexplained"),
        (1.3, True, SLOW, "none"),
        (1.7, True, SLOW, "none"),
        (1.7, False, SLOW, "none"),
        (1.9, True, SLOW, "unexplained"),
        (1.9, False, SLOW, "unexplained"),
    ],
)
def test_error_of_slow_poses_is_not_unexplained(
    scored: ScoredSearch, score: float, has_unnamed: bool, fault: DataFault, verdict: str
) -> None:
    """Errors of ``score`` noise floors; slow poses give an exact car up to 1.8."""
    error = np.full((5, 6), score) * STD
    scored.errors.update(nominal=error, refit=error, with_effects=error)  # type: ignore[attr-defined]
    assert verdict_of(scored, has_unnamed, [fault]) == verdict
