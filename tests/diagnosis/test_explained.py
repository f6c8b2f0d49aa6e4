"""Test that the stated probability of a name falls by what the named effects leave unexplained."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.diagnosis.evidence import ScoredSearch, effect_findings
from carlab.diagnosis.explained import explained_loss_share, explained_shares
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.held_out_errors import HeldOut
from carlab.diagnosis.identification.measurement_noise import Noise
from carlab.diagnosis.selection.problem import SearchProblem, SearchResult
from carlab.diagnosis.selection.refit import refit
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from sim_backends.car_parameters import MocapParameters
from sim_backends.effects.base import Parameters
from tests.helpers.recorded_drives import PERIOD_S, drive

LAG = "steering_lag"
CAR = SimulatorConfig(control_period_s=PERIOD_S, mocap=MocapParameters(latency_s=0.0))
STD = 3e-4 * np.array([1.0, 1.0, 2.0, 20.0, 20.0, 40.0])
EIGHT_TO_TEN = 1.0 / (1.0 + 0.8**5)
"""The logistic function of the settings for a root of chi2 of 10: half are correct at 8, with slope 5."""


def scored(**missing: Parameters) -> ScoredSearch:
    """A car with a steering lag and other ``missing`` effects, of which only the lag is named."""
    true = replace(CAR, effects={LAG: {"time_constant": 0.05}, **missing})
    windows, held_out = (cut_windows(segments_of([drive(true, 20.0, seed)]), 0.8, 0.5) for seed in (3, 4))
    problem = SearchProblem(CAR, windows, 3.0 * STD, STD, {})
    scale = Scale(np.array([8, 16, 24]), np.tile(3.0 * STD, (3, 1)))
    nothing = problem.fitter(scale).fit(CAR, ())
    base, best = (refit(problem, effects, nothing, scale).fit for effects in ((), (LAG,)))
    found = SearchResult(base, best, (LAG,), {LAG: 100.0}, {}, ((LAG, best),), (), scale)
    return ScoredSearch.of(problem, found, HeldOut(held_out, 3.0 * STD, Noise(STD, STD)))


def test_probability_of_a_name_that_explains_everything() -> None:
    (finding,) = effect_findings(scored())
    assert finding.confidence == pytest.approx(EIGHT_TO_TEN, rel=0.02)


def test_probability_falls_by_the_unexplained_share() -> None:
    """A slope of the floor, which is not named, causes most of the error."""
    search = scored(road_slope={"angle": 0.02, "direction": 1.0})
    before, after = search.scores()["refit"], search.scores()["with_effects"]
    by_score = 1.0 - (after**2 - 1.0) / (before**2 - 1.0)
    by_loss = explained_loss_share(search.problem, search.found, search.held_out)
    assert explained_shares(search.problem, search.found, search.held_out) == pytest.approx((by_loss, by_score))
    share = max(by_loss, by_score)
    assert 0.0 < share < 0.6
    (whole_catalogue,) = effect_findings(search)
    assert whole_catalogue.confidence == pytest.approx(share * EIGHT_TO_TEN)
    (requested,) = effect_findings(search, covers_catalogue=False)
    assert requested.confidence == pytest.approx(EIGHT_TO_TEN)


def test_weak_excess_has_no_share() -> None:
    search = scored()
    held_out = replace(search.held_out, floor=10.0 * search.scores()["refit"] * search.held_out.floor)
    assert explained_shares(search.problem, search.found, held_out) is None
