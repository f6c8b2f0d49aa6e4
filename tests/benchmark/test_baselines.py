"""Test that baselines name strong effects, raise no false alarm on a null case and correct predictions."""

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
    return make_case(kind, seed, effects=effects, excess=excess, fit_s=30.0, hold_s=15.0)  # type: ignore[arg-type]


def prepared(made: Case) -> Prepared:
    return prepare(made.fit, made.hold, made.nominal, floors(made))


def floors(made: Case) -> dict[str, float]:
    return dict(zip(CHANNELS, made.floor, strict=True))


def zero_correction(steps: Steps) -> FloatArray:
    return np.zeros((len(steps.starts), 3))


@pytest.fixture(scope="module")
def null_case() -> Case:
    return case("null", 11)


@pytest.fixture(scope="module")
def null_data(null_case: Case) -> Prepared:
    return prepared(null_case)


@pytest.fixture(scope="module")
def steering_delay_data() -> Prepared:
    return prepared(case("single", 12, "steering_delay", excess=4.0))


@pytest.fixture(scope="module")
def steering_offset_case() -> Case:
    return case("single", 17, "steering_offset", excess=4.0)


def test_baselines_name_no_effect_in_a_null_case(null_case: Case) -> None:
    pytest.importorskip("pysindy")
    results = run_baselines(null_case.fit, null_case.hold, null_case.nominal, floors(null_case))
    assert tuple(results) == BASELINES
    assert [entry["named"] for entry in results.values()] == [None] * len(BASELINES)
    assert results["PySINDy"]["score"] == results["stepwise BIC"]["score"] == results["refit only"]["score"]


def test_baselines_name_and_correct_a_strong_effect() -> None:
    pytest.importorskip("pysindy")
    deadband_case = case("single", 16, "throttle_deadband", excess=4.0)
    results = run_baselines(deadband_case.fit, deadband_case.hold, deadband_case.nominal, floors(deadband_case))
    assert results["stepwise BIC"]["named"] == results["PySINDy"]["named"] == "throttle_deadband"
    for name in ("stepwise BIC", "PySINDy"):
        assert 1.0 < results[name]["score"] < 0.7 * results["refit only"]["score"]
    assert results["refit only"]["named"] is None
    assert results["GP residual"]["named"] is None


def test_regression_on_one_term_estimates_the_concealed_angle(steering_offset_case: Case) -> None:
    data = prepared(steering_offset_case)
    system = System.of(data)
    column = system.fit_x[:, list(system.terms).index("steering_offset")]
    angle = 0.02 * float(column @ system.fit_y) / float(column @ column)  # a term is 0.02 rad
    assert angle == pytest.approx(steering_offset_case.concealed[0].parameters["angle"], rel=0.25)


def test_steering_delay_has_the_largest_cross_correlation(steering_delay_data: Prepared) -> None:
    assert largest_correlation(steering_delay_data) == "steering_delay"


def test_zero_correction_has_the_score_of_the_refit(steering_delay_data: Prepared) -> None:
    data = steering_delay_data
    assert held_out_score(data, zero_correction) == pytest.approx(score(data.windows, data.car.free()), rel=1e-9)
    system = System.of(data)
    assert corrected_score(data, system, np.zeros(len(system.terms))) == pytest.approx(data.refit_score, rel=1e-9)


def test_terms_belong_to_effects_and_cover_all_but_four(null_data: Prepared) -> None:
    named = {effect_of(term) for term in library(null_data)}
    assert named <= set(EFFECT_IDS)
    uncovered = {"mocap_latency", "traction_limit", "roll_dynamics", "tyre_saturation"}  # the last: linear tyres only
    assert set(EFFECT_IDS) - named == uncovered


def test_terms_equal_closed_forms(null_data: Prepared) -> None:
    """A force term is F / m; a command term is the lost acceleration."""
    terms, steps = library(null_data), null_data.steps
    drag = terms["aerodynamic_drag"](steps)
    assert drag[:, 0] == pytest.approx(-steps.middle[:, 3] * np.abs(steps.middle[:, 3]) / steps.car.mass)
    assert not drag[:, 1:].any()
    # First order: the drive force falls by 0.2 % per second; damping compensates a part of it within a step.
    sag = terms["battery_sag"](steps)[:, 0]
    push = steps.car.drive_gain * steps.commands()[:, :, 1].mean(axis=1)
    lost = -0.002 * steps.t_s * push / steps.car.mass
    assert np.corrcoef(sag, lost)[0, 1] > 0.98
    assert 0.75 < float(sag @ lost) / float(lost @ lost) < 1.0


def test_gaps_and_jumps_are_repaired_for_baselines(null_case: Case) -> None:
    complete = as_table(null_case.recordings[0])
    broken = {name: np.delete(column, [50, 51, 200]) for name, column in complete.items()}
    broken["x"][120] += 0.4
    repaired = clean(broken, null_case.nominal, np.array(null_case.floor))
    assert repaired.t_s == pytest.approx(complete["t"] - complete["t"][0], abs=1e-4)
    assert repaired.measured[:, 0] == pytest.approx(complete["x"], abs=0.05)


def test_unusable_recording_raises_data_error(null_case: Case) -> None:
    milliseconds = {**null_case.fit, "t": null_case.fit["t"] * 1000.0}
    results = run_baselines(milliseconds, null_case.hold, null_case.nominal, floors(null_case))
    assert "control period" in results["failed"]


def test_preparation_does_not_modify_the_car_of_the_case(null_case: Case) -> None:
    before = BaseCar(**null_case.nominal.__dict__)
    prepared(null_case)
    assert null_case.nominal == before


def test_diagnosis_and_baselines_are_scored_on_the_same_cases() -> None:
    def row(kind: str, true: list[str], named: list[str], excess: float) -> dict[str, object]:
        given = {"kind": kind, "true": true, "named": named, "excess": excess}
        return {**given, "implied": [], "reported": True, "floor_ratio": 0.9}

    rows = {
        "a": row("single", ["motor_lag"], ["motor_lag"], 2.0),
        "b": row("single", ["battery_sag"], ["motor_lag"], 0.5),
        "c": row("null", [], ["motor_lag"], 0.0),
        "d": row("single", ["yaw_damping"], ["yaw_damping"], 2.0),  # no baseline result
    }
    result = {"named": "battery_sag", "score": 2.0, "refit_score": 3.0, "seconds": 0.1}
    results = {"a": dict.fromkeys(BASELINES, result), "b": dict.fromkeys(BASELINES, result), "c": {"failed": "why"}}
    figures = {entry["figure"]: entry for entry in compare(rows, results)}
    strong = figures["correct effect first, strictly, excess >= 1"]
    assert (strong["tool"], strong["PySINDy"]) == ({"hits": 1, "count": 1}, {"hits": 0, "count": 1})
    assert strong["refit only"] is None
    all_strengths = figures["correct effect first, strictly, all strengths"]
    assert (all_strengths["tool"], all_strengths["PySINDy"]) == ({"hits": 1, "count": 2}, {"hits": 1, "count": 2})
    alarms = figures["false alarms, null and parameters"]
    assert (alarms["tool"]["hits"], alarms["PySINDy"]["hits"]) == (1, 0)
    ratio = figures["floor ratio, singles, median"]
    assert ratio["GP residual"] == {"median": 0.5, "count": 2}
    assert ratio["cross-correlation"] is None
    assert all(len(cells) == 2 + len(BASELINES) for cells in comparison_rows(list(figures.values())))
    rows["a"] = {**rows["a"], "named": [], "reported": False, "floor_ratio": None}
    (ratio,) = (entry for entry in compare(rows, results) if entry["figure"].startswith("floor ratio"))
    assert ratio["tool"] == {"median": 0.45, "count": 2}  # no gain in the case without a report


def test_name_that_a_wrong_base_model_implies_is_no_false_alarm_of_a_baseline() -> None:
    row = {"kind": "null", "true": [], "named": [], "excess": 0.0, "implied": ["tyre_saturation"], "reported": True}
    result = {"named": "tyre_saturation", "score": 2.0, "refit_score": 3.0}
    results = {"PySINDy": result, "stepwise BIC": {**result, "named": "yaw_damping"}}
    alarms = next(entry for entry in compare({"a": row}, {"a": results}) if entry["figure"].startswith("false alarms"))
    assert [alarms[name]["hits"] for name in ("tool", "PySINDy", "stepwise BIC")] == [0, 0, 1]
