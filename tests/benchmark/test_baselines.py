"""Baselines name strong effects, have no false alarm on a null case, and correct predictions as stated."""

from __future__ import annotations

import numpy as np
import pytest

from carlab.benchmark.baselines.correlation import largest_correlation
from carlab.benchmark.baselines.data import Prepared, Steps, clean, held_out_score, prepare
from carlab.benchmark.baselines.regression import System, corrected_score
from carlab.benchmark.baselines.run import BASELINES, run_baselines
from carlab.benchmark.baselines.scores import compare, comparison_rows
from carlab.benchmark.baselines.terms import effect_of, library
from carlab.benchmark.cases.case import CHANNELS, Case, make_case
from carlab.benchmark.cases.refit import score
from carlab.benchmark.effects.catalogue import EFFECT_IDS
from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.measurement import as_table
from carlab.benchmark.world.simulation import FloatArray


def case(kind: str, seed: int, *effects: str, excess: float = 1.0) -> Case:
    return make_case(kind, seed, effects=effects, excess=excess, fit_s=60.0, hold_s=25.0)  # type: ignore[arg-type]


def prepared(made: Case) -> Prepared:
    return prepare(made.fit, made.hold, made.nominal, floors(made))


def floors(made: Case) -> dict[str, float]:
    return dict(zip(CHANNELS, made.floor, strict=True))


def nothing(steps: Steps) -> FloatArray:
    return np.zeros((len(steps.starts), 3))


@pytest.fixture(scope="module")
def quiet() -> Case:
    return case("null", 11)


@pytest.fixture(scope="module")
def late() -> Case:
    return case("single", 12, "steering_delay", excess=4.0)


@pytest.fixture(scope="module")
def askew() -> Case:
    return case("single", 17, "steering_offset", excess=4.0)


def test_no_effect_is_named_in_a_null_case(quiet: Case) -> None:
    pytest.importorskip("pysindy")
    said = run_baselines(quiet.fit, quiet.hold, quiet.nominal, floors(quiet))
    assert tuple(said) == BASELINES
    assert [entry["named"] for entry in said.values()] == [None] * len(BASELINES)
    assert said["PySINDy"]["score"] == said["stepwise BIC"]["score"] == said["refit only"]["score"]


def test_an_easy_effect_is_named_and_corrected() -> None:
    pytest.importorskip("pysindy")
    dead = case("single", 16, "throttle_deadband", excess=4.0)
    said = run_baselines(dead.fit, dead.hold, dead.nominal, floors(dead))
    assert said["stepwise BIC"]["named"] == said["PySINDy"]["named"] == "throttle_deadband"
    for name in ("stepwise BIC", "PySINDy"):
        assert 1.0 < said[name]["score"] < 0.7 * said["refit only"]["score"]
    assert said["refit only"]["named"] is None
    assert said["GP residual"]["named"] is None


def test_regression_on_one_term_finds_the_concealed_angle(askew: Case) -> None:
    data = prepared(askew)
    system = System.of(data)
    column = system.fit_x[:, list(system.terms).index("steering_offset")]
    angle = 0.02 * float(column @ system.fit_y) / float(column @ column)  # a term is 0.02 rad
    assert angle == pytest.approx(askew.concealed[0].parameters["angle"], rel=0.25)


def test_a_late_command_is_the_largest_cross_correlation(late: Case) -> None:
    assert largest_correlation(prepared(late)) == "steering_delay"


def test_without_a_correction_the_score_is_that_of_the_refit(late: Case) -> None:
    data = prepared(late)
    assert held_out_score(data, nothing) == pytest.approx(score(data.windows, data.car.free()), rel=1e-9)
    system = System.of(data)
    assert corrected_score(data, system, np.zeros(len(system.terms))) == pytest.approx(data.refit_score, rel=1e-9)


def test_terms_belong_to_effects_and_cover_nearly_all_of_them(quiet: Case) -> None:
    data = prepared(quiet)
    named = {effect_of(term) for term in library(data)}
    assert named <= set(EFFECT_IDS)
    without = {"mocap_latency", "traction_limit", "roll_dynamics", "tyre_saturation"}  # the last: linear tyres only
    assert set(EFFECT_IDS) - named == without


def test_terms_against_closed_forms(quiet: Case) -> None:
    """Force terms are F / m; a term of the commands is the lost acceleration."""
    data = prepared(quiet)
    terms, steps = library(data), data.steps
    drag = terms["aerodynamic_drag"](steps)
    assert drag[:, 0] == pytest.approx(-steps.middle[:, 3] * np.abs(steps.middle[:, 3]) / steps.car.mass)
    assert not drag[:, 1:].any()
    # First order: the drive force falls by 0.2 % per second; damping compensates a part of it within a step.
    sag = terms["battery_sag"](steps)[:, 0]
    push = steps.car.drive_gain * steps.commands()[:, :, 1].mean(axis=1)
    lost = -0.002 * steps.t_s * push / steps.car.mass
    assert np.corrcoef(sag, lost)[0, 1] > 0.98
    assert 0.75 < float(sag @ lost) / float(lost @ lost) < 1.0


def test_gaps_and_jumps_are_repaired_for_baselines(quiet: Case) -> None:
    whole = as_table(quiet.recordings[0])
    broken = {name: np.delete(column, [50, 51, 200]) for name, column in whole.items()}
    broken["x"][120] += 0.4
    mended = clean(broken, quiet.nominal, np.array(quiet.floor))
    assert mended.t_s == pytest.approx(whole["t"] - whole["t"][0], abs=1e-4)
    assert mended.measured[:, 0] == pytest.approx(whole["x"], abs=0.05)


def test_an_unusable_recording_raises_data_error(quiet: Case) -> None:
    milliseconds = {**quiet.fit, "t": quiet.fit["t"] * 1000.0}
    said = run_baselines(milliseconds, quiet.hold, quiet.nominal, floors(quiet))
    assert "control period" in said["failed"]


def test_the_car_of_a_case_is_not_changed(quiet: Case) -> None:
    before = BaseCar(**quiet.nominal.__dict__)
    prepared(quiet)
    assert quiet.nominal == before


def test_diagnosis_and_baselines_are_scored_on_the_same_cases() -> None:
    def row(kind: str, true: list[str], named: list[str], excess: float) -> dict[str, object]:
        return {"kind": kind, "true": true, "named": named, "excess": excess, "floor_ratio": 0.9}

    rows = {
        "a": row("single", ["motor_lag"], ["motor_lag"], 2.0),
        "b": row("single", ["battery_sag"], ["motor_lag"], 0.5),
        "c": row("null", [], ["motor_lag"], 0.0),
        "d": row("single", ["yaw_damping"], ["yaw_damping"], 2.0),  # no baseline result
    }
    one = {"named": "battery_sag", "score": 2.0, "refit_score": 3.0, "seconds": 0.1}
    said = {"a": dict.fromkeys(BASELINES, one), "b": dict.fromkeys(BASELINES, one), "c": {"failed": "why"}}
    figures = {entry["figure"]: entry for entry in compare(rows, said)}
    strong = figures["correct effect first, strictly, excess >= 1"]
    assert (strong["tool"], strong["PySINDy"]) == ({"hits": 1, "count": 1}, {"hits": 0, "count": 1})
    assert strong["refit only"] is None
    every = figures["correct effect first, strictly, all strengths"]
    assert (every["tool"], every["PySINDy"]) == ({"hits": 1, "count": 2}, {"hits": 1, "count": 2})
    alarms = figures["false alarms, null and parameters"]
    assert (alarms["tool"]["hits"], alarms["PySINDy"]["hits"]) == (1, 0)
    ratio = figures["floor ratio, singles, median"]
    assert ratio["GP residual"] == {"median": 0.5, "count": 2}
    assert ratio["cross-correlation"] is None
    assert all(len(cells) == 2 + len(BASELINES) for cells in comparison_rows(list(figures.values())))
