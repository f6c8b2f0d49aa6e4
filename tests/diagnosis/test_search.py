"""Test the time limit of the search, and the withdrawal of effects that do not matter."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from carlab.benchmark.cases.case import Case, make_case
from carlab.core.clock import SimulatedClock
from carlab.core.errors import ConfigError
from carlab.diagnosis.diagnose import Outcome, diagnose
from carlab.diagnosis.findings import SearchExtent
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.search_timer import SearchTimer
from carlab.diagnosis.selection import refit as refit_module
from carlab.diagnosis.selection.forward import Path as SelectionPath
from carlab.diagnosis.selection.forward import extend
from carlab.diagnosis.selection.problem import Model, RunControl, SearchProblem, SearchResult
from carlab.diagnosis.selection.search import search
from carlab.diagnosis.settings import DEFAULT, DiagnosisSettings
from carlab.jobs.function_workers import FunctionWorkers
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from sim_backends.effects import CATALOGUE
from tests.helpers.case_files import car_in, imported, rotated, write_case
from tests.helpers.recorded_drives import PERIOD_S, drive

FEWER = replace(DEFAULT, windows=replace(DEFAULT.windows, fit_stride_s=1.2, held_out_stride_s=1.0))
"""A quarter of the windows of the default. They do not overlap."""
HALF = replace(DEFAULT, windows=replace(DEFAULT.windows, fit_stride_s=0.6, held_out_stride_s=0.5))
"""Half as many windows as by default."""
LENIENT = replace(
    DEFAULT.selection,
    accept_chi2_min=1.0,
    accept_left_out_share=-1.0,
    accept_left_out_ratio=-1.0,
    keep_z_min=-5.0,
    min_score_chi2=0.0,
)
"""Low thresholds of significance."""
DRAG, MISALIGNMENT = "aerodynamic_drag", "mocap_yaw_misalignment"


@pytest.fixture(scope="module")
def drag() -> Case:
    """Aerodynamic drag concealed in 45 s of driving with wrong base parameters."""
    return make_case("single", 21, effects=(DRAG,), excess=2.0, fit_s=45, hold_s=20)


@pytest.fixture(scope="module")
def strong_drag() -> Case:
    """The same with a larger drag, which shorter recordings show."""
    return make_case("single", 21, effects=(DRAG,), excess=4.0, fit_s=45, hold_s=20)


@pytest.fixture(scope="module")
def long_drag() -> Case:
    """The same as ``drag`` in 60 s of driving."""
    return make_case("single", 21, effects=(DRAG,), excess=2.0, fit_s=60, hold_s=30)


@pytest.fixture(autouse=True)
def _two_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search two effects only, because the whole catalogue takes long."""
    monkeypatch.setattr("carlab.diagnosis.diagnose.CATALOGUE", {name: CATALOGUE[name] for name in (DRAG, MISALIGNMENT)})


def found(
    case: Case,
    folder: Path,
    angles: tuple[float, float] = (0.0, 0.0),
    settings: DiagnosisSettings = FEWER,
    **options: Any,
) -> Outcome:
    """Diagnose a case, measured with misalignments [rad] of the fitted and the held-out recording."""
    write_case(case, folder)
    fit = imported(rotated(case.fit, angles[0]), folder / "fit.csv")
    hold = imported(rotated(case.hold, angles[1]), folder / "hold.csv")
    return diagnose(fit, hold, car_in(folder), settings=settings, **options)


def names(outcome: Outcome) -> list[str]:
    return [effect.id for effect in outcome.diagnosis.effects]


@pytest.mark.slow
def test_negligible_effect_is_not_named(long_drag: Case, tmp_path: Path) -> None:
    """A misalignment of 0.5 mrad changes the lateral velocity by 1 mm/s; the test below names it without a limit."""
    settings = replace(DEFAULT, selection=replace(LENIENT, min_practical_size=0.2))
    assert names(found(long_drag, tmp_path, (5e-4, 5e-4), settings)) == [DRAG]


def test_result_is_the_same_with_two_processes(drag: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One process repeats no refit of the same accuracy, although four stages remove each effect.

    The rounding of sums depends on the number of threads, so a diagnosis without given workers sets it too.
    """
    fits: list[bytes] = []

    def counted(
        problem: SearchProblem, effects: tuple[str, ...], start: np.ndarray, scale: Scale, compared: float | None = None
    ) -> Model:
        fits.append(repr((effects, start.tolist(), scale.sigma.tolist(), compared)).encode())
        return fit_from(problem, effects, start, scale, compared)

    fit_from = refit_module._fit_from
    settings = replace(FEWER, selection=replace(LENIENT, min_practical_size=0.0))
    with FunctionWorkers(2) as workers:
        shared = found(drag, tmp_path, (5e-4, 5e-4), settings, workers=workers).diagnosis
    monkeypatch.setattr(refit_module, "_fit_from", counted)
    with threadpool_limits(2, "blas"):
        alone = found(drag, tmp_path, (5e-4, 5e-4), settings).diagnosis
    assert [effect.id for effect in alone.effects] == [DRAG, MISALIGNMENT]
    assert replace(shared, seconds=0.0) == replace(alone, seconds=0.0)
    assert len(fits) > 2
    assert len(set(fits)) == len(fits)


@pytest.mark.slow
def test_effect_that_raises_the_held_out_error_is_withdrawn(long_drag: Case, tmp_path: Path) -> None:
    """The cameras see the car turned in the fitted recording only."""
    outcome = found(long_drag, tmp_path, (0.02, 0.0), HALF)
    assert names(outcome) == [DRAG]
    refused = [d for d in outcome.figure_data.decisions if not d.passed and d.stage == "confirm"]
    assert [(d.effect, d.alternatives[0][0].setting) for d in refused] == [
        (MISALIGNMENT, "selection.min_held_out_rise")
    ]


@pytest.mark.parametrize(("min_share", "expected"), [(0.99, []), (0.5, [DRAG])])
def test_effect_that_explains_little_is_not_named(
    drag: Case, tmp_path: Path, min_share: float, expected: list[str]
) -> None:
    """The cameras see the car turned in the held-out recording only, so drag explains only a part of its errors."""
    strict = replace(DEFAULT.rivals, min_explained_share=min_share)
    assert names(found(drag, tmp_path, (0.0, 0.01), replace(FEWER, rivals=strict))) == expected


def test_time_limit_ends_the_search_with_a_valid_report(drag: Case, tmp_path: Path) -> None:
    outcome = found(drag, tmp_path, budget_s=1e-3)
    assert outcome.diagnosis.search == SearchExtent(False, "budget", 1e-3)
    assert outcome.diagnosis.effects == ()
    held_out = outcome.diagnosis.held_out
    assert held_out["refit"].score < held_out["nominal"].score
    assert "cut short by the time limit of 0.001 s" in outcome.diagnosis.sentence
    extent = {"is_complete": False, "stopped_by": "budget", "budget_s": 1e-3, "effects": [], "omitted": []}
    assert outcome.diagnosis.to_dict()["search"] == extent


def test_stages_that_the_user_ends_are_listed_and_give_no_result(
    drag: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error of an untrained network would state that nothing can be predicted."""
    for module in ("carlab.diagnosis.diagnose", "carlab.prediction.network_ensemble"):
        monkeypatch.setattr(f"{module}.check_duration", lambda segments, settings: None)
    stages = {"curves": True, "ceiling": True, "discrepancy": True, "adapt": True}
    ended = found(drag, tmp_path, effects=[DRAG], stop=lambda: True, **stages).diagnosis
    assert ended.search.omitted == ("measured curves", "adaptation", "learned discrepancy", "black box")
    assert ended.search.effects == (DRAG,)
    assert set(ended.held_out) == {"nominal", "refit", "with_effects", "constant_velocity", "noise_floor"}
    assert ended.ceiling is None


def test_stopped_search_keeps_the_effects_found_so_far(drag: Case, tmp_path: Path) -> None:
    activities = []
    outcome = found(
        drag,
        tmp_path,
        (0.01, 0.01),
        progress=lambda activity, share: activities.append(activity),
        stop=lambda: "searching for effect 2" in activities,
    )
    assert len(names(outcome)) == 1
    assert outcome.diagnosis.held_out["with_effects"].score < outcome.diagnosis.held_out["refit"].score
    assert outcome.diagnosis.search == SearchExtent(False, "user", None)


def one_step(problem: SearchProblem, start: SelectionPath, control: RunControl) -> SelectionPath:
    """A greedy path that ends after its first effect."""
    one = replace(problem.settings, selection=replace(problem.settings.selection, max_effects=1))
    return extend(replace(problem, settings=one), start, control)


def test_search_that_is_stopped_during_its_alternatives_is_incomplete(
    strong_drag: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    activities: list[str] = []
    results: list[SearchResult] = []

    def recorded_search(problem: SearchProblem, control: RunControl) -> SearchResult:
        results.append(search(problem, control))
        return results[-1]

    monkeypatch.setattr("carlab.diagnosis.selection.search.extend", one_step)
    monkeypatch.setattr("carlab.diagnosis.diagnose.search", recorded_search)
    settings = replace(FEWER, selection=replace(DEFAULT.selection, min_effects_for_alternatives=1))
    outcome = found(
        strong_drag,
        tmp_path,
        (0.02, 0.02),
        settings,
        progress=lambda activity, share: activities.append(activity),
        stop=lambda: any(activity.startswith("alternative 1") for activity in activities),
    )
    assert outcome.diagnosis.search == SearchExtent(False, "user", None)
    assert not results[0].is_complete


def test_search_without_further_candidates_is_complete_after_its_time_limit() -> None:
    car = SimulatorConfig(control_period_s=PERIOD_S)
    windows = cut_windows(segments_of([drive(car, 15.0, 3)]), 0.8, 0.5)
    problem = SearchProblem(car, windows, np.full(6, 1e-2), np.full(6, 1e-2), {}, ())
    polls = iter([False])  # the time ends after the first poll
    assert search(problem, RunControl(ends_search=lambda: next(polls, True))).is_complete


def test_stop_during_the_checks_after_the_search_is_reported() -> None:
    stopped: list[bool] = []
    timer = SearchTimer(None, stop=lambda: bool(stopped))
    assert not timer.ends_search()
    timer.end_checks()
    assert timer.extent().is_complete
    stopped.append(True)
    timer.end_checks()
    assert timer.extent() == SearchExtent(False, "user", None)


@pytest.mark.parametrize(
    ("case", "limits", "expected"),
    [
        ("strong_drag", {}, {DRAG, MISALIGNMENT}),
        ("drag", {"max_alternatives": 0}, {MISALIGNMENT}),
        pytest.param("drag", {"min_remaining_excess": 0.99}, {MISALIGNMENT}, marks=pytest.mark.slow),
        pytest.param("drag", {"min_effects_for_alternatives": 2}, {MISALIGNMENT}, marks=pytest.mark.slow),
    ],
)
def test_other_choice_repairs_a_wrong_turn(
    request: pytest.FixtureRequest,
    case: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    limits: dict[str, Any],
    expected: set[str],
) -> None:
    """A greedy path that ends after its first effect leaves the drag, unless other choices are followed."""
    monkeypatch.setattr("carlab.diagnosis.selection.search.extend", one_step)
    selection = replace(DEFAULT.selection, **{"min_effects_for_alternatives": 1, **limits})
    settings = replace(FEWER, selection=selection)
    drag = request.getfixturevalue(case)
    outcome = found(drag, tmp_path, (0.02, 0.02), settings, effects=(DRAG, MISALIGNMENT))  # named as the search ends
    assert set(names(outcome)) == expected


def test_progress_states_the_remaining_time() -> None:
    clock = SimulatedClock()
    timer = SearchTimer(100.0, search_share=0.8, clock=clock)
    shown: list[str] = []
    progress = timer.progress(lambda activity, share: shown.append(activity))
    for t_s in (0.0, 30.0, 79.0, 81.0):
        clock.sleep_until(t_s)
        progress("refitting", 0.5)
    assert shown == [f"refitting (at most {left_s} s left)" for left_s in (80, 50, 1)] + ["refitting"]
    assert timer.ends_search()
    assert SearchTimer(math.inf, clock=clock).extent() == SearchExtent()


@pytest.mark.parametrize("budget_s", [0.0, -3.0, math.nan])
def test_time_limit_out_of_range_is_refused_with_the_remedy(budget_s: float) -> None:
    with pytest.raises(ConfigError, match=r"--budget .*: give a time above 0 s"):
        SearchTimer(budget_s)
