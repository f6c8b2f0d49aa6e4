"""Refits of a search: equal ones are not repeated, and start at the same values, whatever the order of the effects."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fit, Fitter
from carlab.diagnosis.identification.fit_parameters import FitParameter, effect_parameters
from carlab.diagnosis.selection import candidates, moves
from carlab.diagnosis.selection import refit as refit_module
from carlab.diagnosis.selection.problem import Candidate, Model, RunControl, SearchProblem
from carlab.diagnosis.selection.refit import refit, refit_candidate, refit_without_each
from carlab.diagnosis.selection.screening import ScreeningResult
from carlab.diagnosis.settings import DEFAULT
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from sim_backends.car_parameters import MocapParameters
from tests.helpers.recorded_drives import PERIOD_S, drive

LAG, BRAKE = "steering_lag", "brake_asymmetry"
CAR = SimulatorConfig(control_period_s=PERIOD_S, mocap=MocapParameters(latency_s=0.0))
RATIOS = DEFAULT.selection.limit_start_ratios
STD = 3e-4 * np.array([1.0, 1.0, 2.0, 20.0, 20.0, 40.0])


def short_problem() -> tuple[SearchProblem, Scale]:
    """A search on 10 s of a car whose steering lags."""
    true = replace(CAR, effects={LAG: {"time_constant": 0.05}})
    problem = SearchProblem(CAR, cut_windows(segments_of([drive(true, 10.0, 3)]), 0.8, 0.5), 3.0 * STD, STD, {})
    return problem, Scale(np.array([8, 16, 24]), np.tile(3.0 * STD, (3, 1)))


def test_refit_with_effects_in_another_order_is_not_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Effects and parameters of the result have the requested order."""
    problem, scale = short_problem()
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


def test_candidate_starts_at_the_values_of_a_fit_whose_effects_have_another_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The effects of a search's result are sorted by strength, the parameters of its fit by acceptance."""
    problem, scale = short_problem()
    fit = refit(problem, (LAG, BRAKE), problem.fitter(scale).fit(CAR, ()), scale).fit
    sorted_model = Model((BRAKE, LAG), fit, scale)
    begun: dict[str, float] = {}
    fit_from = Fitter.fit

    def watched(
        fitter: Fitter, config: SimulatorConfig, free: tuple[FitParameter, ...], start: FloatArray, **options: Any
    ) -> Fit:
        begun.update(zip((f.name for f in free), start.tolist(), strict=True))
        return fit_from(fitter, config, free, start, **options)

    monkeypatch.setattr(Fitter, "fit", watched)
    refit_candidate(problem, sorted_model, ScreeningResult("rolling_resistance", 1.0, np.array([[0.3]])))
    values = {f.name: float(z) for f, z in zip(fit.free, fit.z, strict=True)}
    assert begun.pop("effects.rolling_resistance.force") == 0.3
    assert begun == values
    assert values[f"effects.{LAG}.time_constant"] != values[f"effects.{BRAKE}.gain_ratio"]


def test_fits_start_once_for_each_choice_if_one_other_number_is_free() -> None:
    size, choice = FitParameter("size", 0.0, 1.0, 0.0, 9.0), FitParameter("form", 0.0, 1.0, 0.0, 1.0, choice=True)
    starts = np.array([[3.0, 1.0], [1.0, 0.0], [2.0, 1.0]])
    assert refit_module._distinct_starts((size, choice), starts, RATIOS).tolist() == [[3.0, 1.0], [1.0, 0.0]]
    assert refit_module._distinct_starts((size,), starts[:, :1], RATIOS).tolist() == [[3.0]]
    assert refit_module._distinct_starts((size, size), starts, RATIOS).tolist() == starts.tolist()


def test_fit_that_is_compared_ends_early_with_nearly_the_same_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the lag, the base parameters explain a part of it in several iterations."""
    problem, scale = short_problem()
    fitter, free = problem.fitter(scale), problem.free_parameters(())
    true = fitter.fit(problem.config_with((LAG,)), problem.free_parameters((LAG,)))
    iterations: list[int] = []
    jacobian = Fitter.jacobian

    def counted(own: Fitter, config: SimulatorConfig, *given: Any) -> FloatArray:
        iterations[-1] += 1
        return jacobian(own, config, *given)

    def fitted(compared_cost: float | None) -> Fit:
        iterations.append(0)
        return fitter.fit(CAR, free, tolerance=1e-6, iterations=30, compared_cost=compared_cost)

    monkeypatch.setattr(Fitter, "jacobian", counted)
    exact, early = fitted(None), fitted(true.cost)
    equal = fitted(exact.cost)
    assert iterations[1] < iterations[0] / 2
    assert iterations[2] == iterations[0]
    assert early.cost - true.cost == pytest.approx(exact.cost - true.cost, rel=0.05)
    assert equal.cost == pytest.approx(exact.cost, rel=1e-5)


@pytest.fixture
def finished(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Effects whose fits are begun, and those whose fits are finished."""
    calls: list[list[str]] = [[], []]
    for name, own in (("begin_refit", calls[0]), ("finish_refit", calls[1])):
        refit_of = getattr(refit_module, name)

        def counted(problem: SearchProblem, model: Model, part: Any, of: Any = refit_of, own: Any = own) -> Candidate:
            own.append(part.effect)
            return of(problem, model, part)

        monkeypatch.setattr(candidates, name, counted)
    return calls


@pytest.mark.parametrize("accept_chi2_min", [25.0, 1e9])
def test_candidates_with_small_gains_are_finished_only_if_no_other_is_accepted(
    finished: list[list[str]], accept_chi2_min: float
) -> None:
    """The model has the lag of the steering. The car also has a lag of the motor and a misalignment."""
    small = {"motor_lag": {"time_constant": 0.15}, "mocap_yaw_misalignment": {"angle": 0.02}}
    true = replace(CAR, effects={LAG: {"time_constant": 0.05}, **small})
    windows = cut_windows(segments_of([drive(true, 10.0, 3)]), 0.8, 0.5)
    limit = replace(
        DEFAULT.selection, accept_chi2_min=accept_chi2_min, steady_z_min=accept_chi2_min, min_score_share=0.0
    )
    problem = SearchProblem(CAR, windows, 3.0 * STD, STD, {}, tuple(small), replace(DEFAULT, selection=limit))
    model = refit(problem, (LAG,), problem.fitter(short_problem()[1]).fit(CAR, ()), short_problem()[1])
    found = candidates.next_candidates(problem, model, RunControl())
    begun, complete = finished
    assert found[0].effect == complete[0] == "motor_lag"
    assert len(begun) > 1
    if accept_chi2_min < 1e9:
        assert set(complete) < set(begun)
        assert set(complete) == {c.effect for c in found}
    else:
        assert set(complete) == set(begun) == {c.effect for c in found}
        assert all(c.is_tested for c in found)
    full = refit(problem, (LAG, "motor_lag"), found[0].fit, model.scale)
    assert found[0].gain == pytest.approx(model.fit.cost - full.fit.cost, rel=0.03)


@pytest.mark.parametrize(
    ("name", "other", "chi2", "replaced"),
    [
        ("motor_lag", "throttle_delay", 20.0, True),
        ("motor_lag", "throttle_delay", 15.0, False),
        ("motor_lag", "longitudinal_slip", 23.0, False),
        ("motor_lag", "longitudinal_slip", 25.0, True),
        ("steering_lag", "steering_rate_limit", 17.0, True),
        ("longitudinal_slip", "motor_lag", 20.0, True),
        ("longitudinal_slip", "motor_lag", 10.0, False),
    ],
)
def test_swap_with_an_effect_of_more_numbers_needs_a_higher_chi2(
    monkeypatch: pytest.MonkeyPatch, name: str, other: str, chi2: float, replaced: bool
) -> None:
    """Slipping wheels have one number more than a lag."""
    problem, scale = short_problem()
    problem = replace(problem, confusable={name: (other,)})
    nothing = Model((), problem.fitter(scale).fit(CAR, ()), scale)
    swap = Candidate(other, nothing.fit, 0.0), chi2
    monkeypatch.setattr(moves, "_fitted_swap", lambda *given: swap)
    monkeypatch.setattr(moves, "fit_with_scale", lambda problem, effects, *given: Model(effects, nothing.fit, scale))
    model = moves._swap(problem, Model((name,), nothing.fit, scale), {name: nothing}, RunControl())
    assert (model.effects if model is not None else (name,)) == ((other,) if replaced else (name,))


@pytest.mark.parametrize("has_effect", [True, False])
def test_candidates_wait_only_if_the_model_has_an_effect_and_they_are_not_confusable_with_the_best(
    has_effect: bool,
) -> None:
    problem, scale = short_problem()
    problem = replace(problem, confusable={"motor_lag": ("throttle_delay",)})
    nothing = problem.fitter(scale).fit(CAR, ())
    gains = {"motor_lag": 10.0, "drag_brake": 5.0, BRAKE: 4.9, "throttle_delay": 1.0, "wind": -1.0}
    begun = [Candidate(name, nothing, gain) for name, gain in gains.items()]
    model = Model((LAG,) if has_effect else (), nothing, scale)
    first, waiting = candidates._first_and_waiting(problem, model, begun)
    assert [c.effect for c in waiting] == ([BRAKE, "wind"] if has_effect else [])
    assert first == [c for c in begun if c not in waiting]
    worse = [replace(c, gain=c.gain - 20.0) for c in begun]
    assert candidates._first_and_waiting(problem, model, worse) == (worse, [])


def test_refit_for_a_comparison_does_not_replace_an_accurate_one() -> None:
    problem, scale = short_problem()
    model = refit(problem, (LAG, BRAKE), problem.fitter(scale).fit(CAR, ()), scale)
    early = refit_without_each(problem, model, RunControl(), is_comparison=True)
    accurate = refit_without_each(problem, model, RunControl())
    assert len(problem.refits) == 5
    assert accurate[LAG].fit.cost < early[LAG].fit.cost
    again = refit_without_each(problem, model, RunControl(), is_comparison=True)
    assert {name: m.fit.cost for name, m in again.items()} == {name: m.fit.cost for name, m in accurate.items()}
    assert len(problem.refits) == 5


def test_progress_of_a_step_does_not_go_back() -> None:
    """All candidates are refitted, tested and refused, first those with large gains, then the others."""
    true = replace(CAR, effects={LAG: {"time_constant": 0.05}, "motor_lag": {"time_constant": 0.15}})
    windows = cut_windows(segments_of([drive(true, 10.0, 3)]), 0.8, 0.5)
    refuse = replace(DEFAULT.selection, accept_chi2_min=1e9, steady_z_min=1e9, min_score_share=0.0)
    names = ("motor_lag", "mocap_yaw_misalignment", "rolling_resistance")
    problem = SearchProblem(CAR, windows, 3.0 * STD, STD, {}, names, replace(DEFAULT, selection=refuse))
    model = refit(problem, (LAG,), problem.fitter(short_problem()[1]).fit(CAR, ()), short_problem()[1])
    shares: list[float] = []
    candidates.next_candidates(problem, model, RunControl(lambda activity, share: shares.append(share)))
    assert len(shares) > 4
    assert shares == sorted(shares)
    step = 1.0 / problem.settings.selection.max_effects
    assert step <= shares[0] < shares[-1] < 2.0 * step


@pytest.mark.parametrize("effect", ["combined_slip", "steering_rate_limit"])
def test_fits_of_a_single_limit_also_begin_at_weaker_limits(effect: str) -> None:
    """A strong limit raises the cost, because the other parameters fit the drive without the limit."""
    (limit,) = effect_parameters(effect, CAR)
    strong, weak = limit.coordinate(2.0), limit.coordinate(9.0)
    starts = refit_module._distinct_starts((limit,), np.array([[strong], [weak]]), RATIOS)
    assert limit.value(starts[:, 0]) == pytest.approx([2.0, 3.4, 6.0])
