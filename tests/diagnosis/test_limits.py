"""Limits of effects without a name, against fits of these effects and the truth of simulated cars."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.diagnosis.evidence import ScoredSearch
from carlab.diagnosis.findings import Estimate, FigureData
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.held_out_errors import HeldOut
from carlab.diagnosis.identification.measurement_noise import Noise
from carlab.diagnosis.limits import effect_limits
from carlab.diagnosis.report.html_page import render_page
from carlab.diagnosis.report.numbers import number
from carlab.diagnosis.report.sentences import verdict_sentence
from carlab.diagnosis.selection.problem import SearchProblem, SearchResult
from carlab.diagnosis.selection.refit import refit
from carlab.diagnosis.settings import EVIDENCE
from carlab.jobs.function_workers import FunctionWorkers
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from sim_backends.car_parameters import MocapParameters
from sim_backends.effects import CATALOGUE
from tests.diagnosis.report_material import changed, no_mismatch
from tests.helpers.recorded_drives import PERIOD_S, drive

CAR = SimulatorConfig(control_period_s=PERIOD_S, mocap=MocapParameters(latency_s=0.0))
STD = 3e-4 * np.array([1.0, 1.0, 2.0, 20.0, 20.0, 40.0])
FITTED = (
    "steering_lag", "command_delay", "steering_offset", "steering_deadband", "steering_backlash", "throttle_deadband",
    "yaw_damping", "marker_offset", "aerodynamic_drag",
)  # fmt: skip


def searched(true: SimulatorConfig) -> ScoredSearch:
    """A search that named nothing, for a drive of a car."""
    windows, held_out = (
        cut_windows(segments_of([drive(true, s, seed)]), 0.8, 0.5) for s, seed in ((60.0, 3), (9.0, 4))
    )
    problem = SearchProblem(CAR, windows, 3.0 * STD, STD, {})
    scale = Scale(np.array([8, 16, 24]), np.tile(3.0 * STD, (3, 1)))
    base = refit(problem, (), problem.fitter(scale).fit(CAR, ()), scale).fit
    found = SearchResult(base, base, (), {}, {}, (), (), scale)
    fit = problem.fitter(scale).with_covariance(base)
    return ScoredSearch(problem, found, HeldOut(held_out, 3.0 * STD, Noise(STD, STD)), fit, {})


@pytest.fixture(scope="module")
def correct() -> ScoredSearch:
    return searched(CAR)


@pytest.fixture(scope="module")
def limits(correct: ScoredSearch) -> dict[str, dict[str, Estimate]]:
    return effect_limits(correct, FunctionWorkers())


@pytest.mark.parametrize("effect", FITTED)
def test_limits_agree_with_fits_of_the_effect(
    correct: ScoredSearch, limits: dict[str, dict[str, Estimate]], effect: str
) -> None:
    problem, scale = correct.problem, correct.found.scale
    fit = problem.fitter(scale).with_covariance(refit(problem, (effect,), correct.fit, scale).fit)
    assert fit.covariance is not None
    for name, limit in limits[effect].items():
        k = [f.name for f in fit.free].index(f"effects.{effect}.{name}")
        std = EVIDENCE.interval_factor * fit.free[k].size * np.sqrt(fit.covariance[k, k])
        assert limit.std == pytest.approx(std, rel=0.35)
        assert limit.value == pytest.approx(fit.config.values()[fit.free[k].name], abs=0.5 * std)
        assert limit.low90 <= limit.value <= limit.high90


def test_limits_are_wider_where_the_model_errs(correct: ScoredSearch, limits: dict[str, dict[str, Estimate]]) -> None:
    """By the factors on standard errors; the size at which a slope is taken grows too, so not exactly."""
    std = effect_limits(replace(correct, excess=1.0), FunctionWorkers())["steering_lag"]["time_constant"].std
    factors = EVIDENCE.model_interval_factor / EVIDENCE.interval_factor
    assert std == pytest.approx(factors * limits["steering_lag"]["time_constant"].std, rel=0.1)
    assert factors > 1.2


def test_limits_of_a_correct_car_contain_the_identities(limits: dict[str, dict[str, Estimate]]) -> None:
    intervals = [e for own in limits.values() for e in own.values()]
    assert len(intervals) >= 25
    identities = {"exponent": 1.0, "gain_ratio": 1.0}
    contained = [e.low90 <= identities.get(name, 0.0) <= e.high90 for own in limits.values() for name, e in own.items()]
    assert np.mean(contained) >= 0.8


@pytest.mark.parametrize(
    ("effect", "name", "size"), [("steering_lag", "time_constant", 0.003), ("steering_offset", "angle", -0.001)]
)
def test_limit_contains_a_small_effect_that_has_no_name(effect: str, name: str, size: float) -> None:
    limit = effect_limits(searched(replace(CAR, effects={effect: {name: size}})), FunctionWorkers())[effect][name]
    assert limit.low90 < size < limit.high90
    assert abs(limit.value) > 3.0 * limit.std


def test_interval_beyond_the_range_of_a_number_is_marked(correct: ScoredSearch) -> None:
    """A car that acts 30 ms earlier than its file states seems to have a negative lag."""
    late = replace(CAR, command_delay_s=CAR.command_delay_s + 0.03)
    found = replace(correct.found, base=replace(correct.fit, config=late), best=replace(correct.fit, config=late))
    problem = replace(correct.problem, nominal=late)
    with_bound = replace(correct, problem=problem, found=found, fit=found.best)
    limit = effect_limits(with_bound, FunctionWorkers())["steering_delay"]["delay"]
    assert (limit.value, limit.low90, limit.high90, limit.at_limit) == (0.0, 0.0, 0.0, True)


def test_effects_without_a_linear_estimate_are_omitted(limits: dict[str, dict[str, Estimate]]) -> None:
    """A patch and a slope without size have no place; a limit of infinity has no slope."""
    assert not {"low_friction_patch", "road_slope", "steering_rate_limit", "motor_saturation"} & set(limits)


def test_report_states_the_narrowest_limits(limits: dict[str, dict[str, Estimate]]) -> None:
    diagnosis = changed(no_mismatch(), limits=limits)
    sentence = verdict_sentence(diagnosis)
    assert "for example" not in verdict_sentence(replace(diagnosis, limits={}))
    typical = {e: CATALOGUE[e].parameters[0].typical for e, own in limits.items() if len(own) == 1}
    ends = {e: max(abs(x.low90), abs(x.high90)) for e in typical for x in limits[e].values()}
    narrowest = min(
        (e for e in typical if CATALOGUE[e].parameters[0].identity == 0.0), key=lambda e: ends[e] / abs(typical[e])
    )
    assert f"for example {CATALOGUE[narrowest].name} beyond {number(ends[narrowest])}" in sentence
    stated = {f"effects.{narrowest}.{CATALOGUE[narrowest].parameters[0].name}": 0.1}
    assert CATALOGUE[narrowest].name not in verdict_sentence(replace(diagnosis, car_file_parameters=stated))
    beyond = {name: replace(e, at_limit=True) for name, e in limits[narrowest].items()}
    assert CATALOGUE[narrowest].name not in verdict_sentence(replace(diagnosis, limits={**limits, narrowest: beyond}))
    page = render_page(diagnosis, FigureData())
    assert page.count("Limits of the other effects") == 1
    for effect, own in limits.items():
        for name in own:
            assert f"<code>{effect}.{name}</code>" in page
    assert diagnosis.to_dict()["limits"]["steering_lag"]["time_constant"]["unit"] == "s"
