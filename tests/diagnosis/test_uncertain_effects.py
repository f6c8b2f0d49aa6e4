"""Withdrawal of effects whose numbers do not differ from their identity, or that raise the held-out error."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import huber as huber_loss

from carlab.diagnosis.decisions import Decision
from carlab.diagnosis.evidence import ScoredSearch, estimate
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.identification.fit_parameters import effect_parameters
from carlab.diagnosis.identification.held_out_errors import HeldOut
from carlab.diagnosis.identification.measurement_noise import Noise
from carlab.diagnosis.selection.problem import RunControl, SearchProblem, SearchResult
from carlab.diagnosis.selection.refit import refit
from carlab.diagnosis.uncertain_effects import identity_distance, range_ratio, without_uncertain_effects
from carlab.diagnosis.weak_effects import without_harmful_effects
from carlab.prediction.errors import prediction_errors
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from sim_backends.car_parameters import MocapParameters
from tests.helpers.recorded_drives import PERIOD_S, drive

LAG, BRAKE = "steering_lag", "brake_asymmetry"
CAR = SimulatorConfig(control_period_s=PERIOD_S, mocap=MocapParameters(latency_s=0.0))
STD = 3e-4 * np.array([1.0, 1.0, 2.0, 20.0, 20.0, 40.0])


@pytest.fixture(scope="module")
def scored() -> ScoredSearch:
    """A car with a steering lag, fitted with this lag and with a brake asymmetry that it does not have."""
    true = replace(CAR, effects={LAG: {"time_constant": 0.05}})
    windows, held_out = (cut_windows(segments_of([drive(true, 30.0, seed)]), 0.8, 0.5) for seed in (3, 4))
    problem = SearchProblem(CAR, windows, 3.0 * STD, STD, {})
    scale = Scale(np.array([8, 16, 24]), np.tile(3.0 * STD, (3, 1)))
    nothing = problem.fitter(scale).fit(CAR, ())
    base, best = (refit(problem, effects, nothing, scale).fit for effects in ((), (LAG, BRAKE)))
    chi2 = dict.fromkeys((LAG, BRAKE), 100.0)
    found = SearchResult(base, best, (LAG, BRAKE), chi2, {}, ((LAG, best), (BRAKE, best)), (), scale)
    return ScoredSearch.of(problem, found, HeldOut(held_out, 3.0 * STD, Noise(STD, STD)))


def test_effect_that_the_car_does_not_have_is_withdrawn(scored: ScoredSearch) -> None:
    decisions: list[Decision] = []
    assert scored.is_joint
    confirmed = without_uncertain_effects(scored, RunControl(record=decisions.append))
    assert confirmed.found.effects == (LAG,)
    assert set(confirmed.fit.config.effects) == {LAG}
    assert confirmed.fit.config.effects[LAG]["time_constant"] == pytest.approx(0.05, rel=0.02)
    assert [(d.effect, d.passed) for d in decisions] == [(BRAKE, False), (LAG, True)]


def test_distance_is_in_standard_deviations(scored: ScoredSearch) -> None:
    assert identity_distance(scored, LAG) > 30.0
    covariance = scored.fit.covariance
    assert covariance is not None
    with_double_std = replace(scored, fit=replace(scored.fit, covariance=4.0 * covariance))
    assert identity_distance(with_double_std, LAG) == pytest.approx(0.5 * identity_distance(scored, LAG))


def with_values(scored: ScoredSearch, effect: str, z: float, variance: float) -> ScoredSearch:
    """The search with another coordinate and variance of an effect's first number."""
    k = next(k for k, f in enumerate(scored.fit.free) if f.name.startswith(f"effects.{effect}."))
    assert scored.fit.covariance is not None
    covariance, coordinates = scored.fit.covariance.copy(), scored.fit.z.copy()
    covariance[k, :] = covariance[:, k] = 0.0
    covariance[k, k], coordinates[k] = variance, z
    return replace(scored, fit=replace(scored.fit, z=coordinates, covariance=covariance))


@pytest.mark.parametrize(("z", "expected"), [(-0.4, 0.0), (1e3, np.inf)])
def test_number_beyond_a_bound_is_at_that_bound(scored: ScoredSearch, z: float, expected: float) -> None:
    """The errors do not depend on a coordinate beyond a bound, so its variance is 0. A lag of 0 is no effect."""
    assert identity_distance(with_values(scored, LAG, z, 0.0), LAG) == expected


def test_distance_of_two_numbers_uses_their_correlation() -> None:
    """Sum and difference of both are known to 1 and 0.1; the difference is 1 away from the identity."""
    free = effect_parameters("marker_offset", CAR)
    covariance = 0.25 * np.array([[1.0 + 0.01, 1.0 - 0.01], [1.0 - 0.01, 1.0 + 0.01]])
    fit = Fit(CAR, free, np.array([0.5, -0.5]), 0.0, np.zeros(1), covariance)
    problem = SearchProblem(CAR, None, np.ones(6), np.ones(6), {})  # type: ignore[arg-type]
    scored = ScoredSearch(problem, None, None, fit, {}, True)  # type: ignore[arg-type]
    assert identity_distance(scored, "marker_offset") == pytest.approx(10.0)
    assert identity_distance(scored, "steering_rate_limit") == np.inf


@pytest.mark.parametrize(("is_stated", "expected"), [(False, 0.25), (True, np.hypot(0.25, 30.0))])
def test_place_of_a_patch_counts_only_if_the_car_file_states_it(is_stated: bool, expected: float) -> None:
    """The loss of grip is a quarter of its standard deviation; the place is 30 standard deviations away."""
    values = {"low_friction_patch": {"x": 0.0, "y": 0.0, "radius": 0.5, "loss": 0.0}}
    car = replace(CAR, effects=values if is_stated else {})
    free = effect_parameters("low_friction_patch", car)
    covariance = np.diag([0.01, 0.01, 0.01, 0.16])
    fit = Fit(car, free, np.array([3.0, 0.0, 0.0, 0.1]), 0.0, np.zeros(1), covariance)
    problem = SearchProblem(car, None, np.ones(6), np.ones(6), {})  # type: ignore[arg-type]
    scored = ScoredSearch(problem, None, None, fit, {}, True)  # type: ignore[arg-type]
    assert identity_distance(scored, "low_friction_patch") == pytest.approx(expected)


def test_distance_from_the_numbers_and_the_form_of_the_car_file() -> None:
    stated = replace(CAR, effects={"torque_steer": {"coefficient": 0.1, "source": 1.0}})
    problem = SearchProblem(stated, None, np.ones(6), np.ones(6), {})  # type: ignore[arg-type]
    free = effect_parameters("torque_steer", stated)
    covariance = np.diag([0.25, 0.0])
    same, other = (
        ScoredSearch(problem, None, None, Fit(stated, free, np.array(z), 0.0, np.zeros(1), covariance), {}, True)  # type: ignore[arg-type]
        for z in ([1.0, 0.0], [0.0, -1.0])
    )
    assert identity_distance(same, "torque_steer") == pytest.approx(2.0)
    assert identity_distance(other, "torque_steer") == np.inf


def test_fit_with_estimated_initial_states_decides_nothing(scored: ScoredSearch) -> None:
    estimated = replace(scored, is_joint=False)
    assert without_uncertain_effects(estimated, RunControl()) is estimated


def test_effects_that_raise_both_held_out_errors_are_withdrawn(scored: ScoredSearch) -> None:
    """The rms error and Huber's loss decide on drives of the same car, which does not have the effect."""
    true = replace(CAR, effects={LAG: {"time_constant": 0.05}})
    problem, scale = scored.problem, scored.found.scale
    best = refit(problem, (LAG, BRAKE), problem.fitter(scale).fit(CAR, ()), scale).fit
    without = refit(problem, (LAG,), best, scale).fit
    outcomes = []
    for seed in (4, 6, 7, 8, 10, 12, 17):
        windows = cut_windows(segments_of([drive(true, 30.0, seed)]), 0.8, 0.5)
        before, after = (
            prediction_errors(simulate_windows(windows, fit.config), windows)[0, :, -1] for fit in (without, best)
        )
        is_larger = np.mean((after / STD) ** 2) >= np.mean((before / STD) ** 2)
        robust = np.maximum(1.4826 * np.median(np.abs(after), axis=0), 3.0 * STD)
        loss_before, loss_after = (huber_loss(4.0, each / robust).sum() for each in (before, after))
        is_confirmed = not is_larger or loss_after < loss_before
        held_out = HeldOut(windows, 3.0 * STD, Noise(STD, STD))
        confirmed = without_harmful_effects(problem, replace(scored.found, best=best), held_out, RunControl())
        assert confirmed.effects == ((LAG, BRAKE) if is_confirmed else (LAG,))
        outcomes.append(is_confirmed)
    assert min(outcomes.count(True), outcomes.count(False)) >= 2


def test_remaining_effects_have_the_fit_that_was_judged(scored: ScoredSearch) -> None:
    """After two removals, a new fit from the first one would end in another point than the one that was judged."""
    true = replace(CAR, effects={LAG: {"time_constant": 0.05}})
    held_out = HeldOut(cut_windows(segments_of([drive(true, 30.0, 17)]), 0.8, 0.5), 3.0 * STD, Noise(STD, STD))
    problem, scale, names = scored.problem, scored.found.scale, (LAG, BRAKE, "torque_steer")
    best = refit(problem, names, problem.fitter(scale).fit(CAR, ()), scale).fit
    found = replace(scored.found, best=best, effects=names)
    decisions: list[Decision] = []
    confirmed = without_harmful_effects(problem, found, held_out, RunControl(record=decisions.append))
    assert confirmed.effects == (LAG,)
    without = refit(problem, (), confirmed.best, scale).fit
    scores = [held_out.score(held_out.final_error(fit.config)) for fit in (without, confirmed.best)]
    assert decisions[-1].alternatives[0][0].statistic == pytest.approx(scores[0] / scores[1] - 1.0, rel=1e-9)


SATURATION = "motor_saturation"


@pytest.fixture(scope="module")
def saturated() -> ScoredSearch:
    """A car whose drive force is limited to 4 N, fitted with this limit; the model errs by more than the noise."""
    true = replace(CAR, effects={SATURATION: {"force": 4.0, "roundness": 0.0}, LAG: {"time_constant": 0.05}})
    windows, held_out = (cut_windows(segments_of([drive(true, 30.0, seed)]), 0.8, 0.5) for seed in (3, 4))
    problem = SearchProblem(CAR, windows, STD, STD, {})
    scale = Scale(np.array([8, 16, 24]), np.tile(3.0 * STD, (3, 1)))
    nothing = problem.fitter(scale).fit(CAR, ())
    base, best = (refit(problem, effects, nothing, scale).fit for effects in ((), (SATURATION,)))
    found = SearchResult(base, best, (SATURATION,), {SATURATION: 100.0}, {}, ((SATURATION, best),), (), scale)
    return ScoredSearch.of(problem, found, HeldOut(held_out, STD, Noise(STD, STD)))


def test_limit_whose_interval_does_not_reach_the_end_of_its_range_is_confirmed(saturated: ScoredSearch) -> None:
    assert not saturated.is_joint
    decisions: list[Decision] = []
    assert without_uncertain_effects(saturated, RunControl(record=decisions.append)).found.effects == (SATURATION,)
    ((condition,),) = decisions[0].alternatives
    force = estimate(saturated, f"effects.{SATURATION}.force")
    assert force.low90 < 4.0 < force.high90
    end = next(f.high for f in saturated.fit.free if f.name == f"effects.{SATURATION}.force")
    assert condition.statistic == pytest.approx(end / force.high90)
    assert condition.statistic > 10.0


def test_limit_that_may_be_infinite_is_withdrawn(saturated: ScoredSearch) -> None:
    """The interval of the force is as wide as its range."""
    value = float(next(z for f, z in zip(saturated.fit.free, saturated.fit.z, strict=True) if SATURATION in f.name))
    uncertain = with_values(saturated, SATURATION, value, 1e4)
    decisions: list[Decision] = []
    assert without_uncertain_effects(uncertain, RunControl(record=decisions.append)).found.effects == ()
    assert [(d.effect, d.passed) for d in decisions] == [(SATURATION, False)]
    assert decisions[0].alternatives[0][0].statistic == 1.0


@pytest.mark.parametrize(("inertia_std", "expected"), [(1e-3, np.inf), (1e3, 1.0)])
def test_limit_is_confirmed_if_another_number_differs_from_its_identity(
    saturated: ScoredSearch, inertia_std: float, expected: float
) -> None:
    """Slipping wheels with an inertia need no finite stiffness."""
    values = {"inertia": 0.01, "stiffness": 1e3}
    free = effect_parameters("longitudinal_slip", CAR)
    names = [f.name.rpartition(".")[2] for f in free]
    covariance = np.diag([inertia_std**2 if name == "inertia" else 1e2 for name in names])
    z = np.array([f.coordinate(values[name]) for f, name in zip(free, names, strict=True)])
    config = replace(CAR, effects={"longitudinal_slip": values})
    fit = replace(saturated.fit, config=config, free=free, z=z, covariance=covariance)
    assert range_ratio(replace(saturated, fit=fit), "longitudinal_slip") == expected
