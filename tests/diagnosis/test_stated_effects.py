"""Test effects, measured curves and standard deviations that the car file states."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from carlab.benchmark.cases.case import Case, make_case
from carlab.diagnosis.diagnose import Outcome, diagnose
from carlab.diagnosis.findings import Diagnosis, EffectFinding, ErrorLocation, Estimate, Evidence
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fit, Fitter
from carlab.diagnosis.identification.fit_parameters import base_parameters, effect_parameters, with_effect
from carlab.diagnosis.report.model_file import with_parameter_std
from carlab.diagnosis.report.next_drive import with_texts
from carlab.diagnosis.report.sentences import effect_sentence, verdict_sentence
from carlab.diagnosis.selection.problem import SearchProblem
from carlab.diagnosis.selection.screening import Screen
from carlab.diagnosis.settings import DEFAULT, IDENTIFICATION
from carlab.prediction.windows import PredictionWindows, cut_windows, segments_of
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CATALOGUE, CURVES, EFFECTS
from tests.helpers.case_files import car_in, imported, rotated

FEWER = replace(DEFAULT, windows=replace(DEFAULT.windows, fit_stride_s=1.2, held_out_stride_s=1.0))
"""A quarter of the windows of the default."""
MISALIGNMENT = "mocap_yaw_misalignment"


@pytest.fixture(scope="module")
def case() -> Case:
    """A drive of a car without missing physics, with wrong base parameters."""
    return make_case("null", 22, fit_s=45, hold_s=20)


@pytest.fixture
def nominal(case: Case, tmp_path: Path) -> SimulatorConfig:
    case.nominal.write(tmp_path / "car.toml")
    return car_in(tmp_path)


@pytest.fixture
def windows(case: Case, tmp_path: Path) -> PredictionWindows:
    segments = segments_of(imported(case.fit, tmp_path / "drive.csv"))
    return cut_windows(segments, DEFAULT.windows.fit_window_s, 2.0, DEFAULT.windows.fit_window_s)


@pytest.fixture(autouse=True)
def _two_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search two effects only, because the whole catalogue takes long."""
    few = {name: CATALOGUE[name] for name in (MISALIGNMENT, "aerodynamic_drag")}
    monkeypatch.setattr("carlab.diagnosis.diagnose.CATALOGUE", few)


def diagnosed(case: Case, folder: Path, nominal: SimulatorConfig, angle_rad: float, stated_rad: float) -> Outcome:
    """Diagnose drives with a yaw misalignment, of which the car file states another value."""
    read = (imported(rotated(table, angle_rad), folder / "drive.csv") for table in (case.fit, case.hold))
    stated = replace(nominal, effects={MISALIGNMENT: {"angle": stated_rad}})
    return diagnose(*read, stated, settings=FEWER)


def test_wrong_number_of_a_stated_effect_is_named(case: Case, tmp_path: Path, nominal: SimulatorConfig) -> None:
    outcome = diagnosed(case, tmp_path, nominal, angle_rad=0.06, stated_rad=0.02)
    (effect,) = outcome.diagnosis.effects
    assert effect.id == MISALIGNMENT
    assert effect.car_file_values == {"angle": 0.02}
    assert effect.parameters["angle"].value == pytest.approx(0.06, abs=0.006)
    assert effect.sentence.startswith("Wrong in the car file: ")
    assert effect.sentence.endswith("not 0.02 rad.")
    assert outcome.model.effects[MISALIGNMENT]["angle"] == effect.parameters["angle"].value
    report = outcome.diagnosis.to_dict()
    assert report["effects"][0]["car_file_values"] == {"angle": 0.02}
    assert report["sentence"].startswith("One effect of the car file has wrong numbers: ")
    assert " With corrected numbers, the position error " in report["sentence"]


def test_correct_number_of_a_stated_effect_stays(case: Case, tmp_path: Path, nominal: SimulatorConfig) -> None:
    outcome = diagnosed(case, tmp_path, nominal, angle_rad=0.06, stated_rad=0.06)
    assert outcome.diagnosis.effects == ()
    assert outcome.model.effects == {MISALIGNMENT: {"angle": 0.06}}


def test_stated_values_are_the_origin_of_every_effect(nominal: SimulatorConfig) -> None:
    """Also of effects whose identity is infinite, and of values far outside the usual range."""
    for name in CATALOGUE:
        config = with_effect(nominal, name)
        stated = {f.name: float(f.value(np.array(0.37))) for f in effect_parameters(name, nominal) if not f.choice}
        config = config.with_values(stated)
        assert with_effect(config, name) is config
        for f in effect_parameters(name, config):
            if not f.choice:
                assert float(f.value(np.array(0.0))) == pytest.approx(stated[f.name])
                assert f.coordinate(stated[f.name]) == pytest.approx(0.0, abs=1e-9)
    far = replace(nominal, effects={"motor_lag": {"time_constant": 4.0}})
    (lag,) = effect_parameters("motor_lag", far)
    assert float(lag.value(np.array(0.0))) == 4.0


def test_measured_curves_of_the_car_file_are_not_fitted(nominal: SimulatorConfig, windows: PredictionWindows) -> None:
    config = nominal
    for curve in CURVES:
        config = with_effect(config, curve.id)
    problem = SearchProblem(config, windows, np.ones(6), np.ones(6), {})
    assert {f.name for f in problem.free_parameters(())} == {f.name for f in base_parameters(nominal)}
    assert not any(problem.is_candidate(curve.id) for curve in CURVES)


def test_standard_deviation_of_the_car_file_is_that_of_the_prior(nominal: SimulatorConfig) -> None:
    name = "motor.drive_gain"
    value = nominal.values()[name]
    known = replace(nominal, parameter_std={name: 0.04 * value})
    change_share = IDENTIFICATION.prior_change_share
    (before,), (after,) = ([f for f in base_parameters(c, uses_std=True) if f.name == name] for c in (nominal, known))
    at_one_std = [float(f.value(np.array(f.prior_z))) for f in (before, after)]
    assert at_one_std[1] == pytest.approx(value * np.exp(np.hypot(0.04, change_share)))
    assert at_one_std[0] > at_one_std[1]
    wide = replace(nominal, parameter_std={name: 10.0 * value})
    assert base_parameters(wide, uses_std=True) == base_parameters(nominal)
    assert base_parameters(known) == base_parameters(nominal)


def test_car_that_changed_by_a_fifth_is_not_held_by_the_prior(
    case: Case, tmp_path: Path, nominal: SimulatorConfig
) -> None:
    """The drive gain of the car file is a fifth too large, with a standard deviation of 0.01 per cent."""
    name = "motor.drive_gain"
    true = diagnosed(case, tmp_path, nominal, 0.0, 0.0).diagnosis.parameters[name].value
    wrong = nominal.with_values({name: 1.2 * true})
    known = replace(wrong, parameter_std={name: 1e-4 * true})
    found = diagnosed(case, tmp_path, known, 0.0, 0.0).diagnosis
    assert found.effects == ()
    assert found.parameters[name].value == pytest.approx(true, rel=0.02)


def test_a_choice_of_the_car_file_is_the_origin(nominal: SimulatorConfig) -> None:
    stated = replace(nominal, effects={"torque_steer": {"coefficient": 0.1, "source": 1.0}})
    coefficient, source = effect_parameters("torque_steer", stated)
    assert (float(coefficient.value(np.array(0.0))), float(source.value(np.array(0.0)))) == (0.1, 1.0)
    assert float(source.value(np.array(source.coordinate(0.0)))) == 0.0
    sentence = effect_sentence(
        "torque_steer",
        {"coefficient": Estimate(0.1, 0.01, 0.09, 0.11, "N m"), "source": Estimate(0.0, 0.0, 0.0, 0.0, "1")},
        {"coefficient": 0.2, "source": 1.0},
    )
    assert "source is throttle, not force" in sentence


def test_infinite_number_of_the_car_file_has_a_finite_coordinate(nominal: SimulatorConfig) -> None:
    """``rate = inf`` states that the servo is not limited."""
    (rate,) = effect_parameters(
        "steering_rate_limit", replace(nominal, effects={"steering_rate_limit": {"rate": np.inf}})
    )
    assert np.isfinite(rate.coordinate(np.inf))
    assert np.isfinite(rate.value(np.array(0.0)))


def test_tyre_curve_of_the_car_file_is_a_base_parameter(nominal: SimulatorConfig, windows: PredictionWindows) -> None:
    """It replaces the tyres of the car file, so another floor changes its numbers."""
    linear = replace(nominal, kind="linear_tyre")
    problem = SearchProblem(with_effect(linear, "tyre_saturation"), windows, np.ones(6), np.ones(6), {})
    assert "effects.tyre_saturation.mu_front" in {f.name for f in problem.free_parameters(())}
    assert not problem.is_candidate("tyre_saturation")
    assert SearchProblem(linear, windows, np.ones(6), np.ones(6), {}).is_candidate("tyre_saturation")


@pytest.mark.parametrize(("name", "values", "number"), [
    ("friction_ellipse", {"scale": 0.8, "action": 0.0}, "scale"),
    ("low_friction_patch", {"x": 0.5, "y": 0.2, "radius": 0.8, "loss": 0.5}, "loss"),
])  # fmt: skip
def test_screening_moves_stated_numbers_to_both_sides(
    nominal: SimulatorConfig, windows: PredictionWindows, name: str, values: dict[str, float], number: str
) -> None:
    config = replace(nominal, effects={name: values})
    fitter = Fitter(windows, Scale(np.array([1, windows.steps]), np.full((2, 6), 0.01)))
    screen = Screen(fitter, config, Fit(config, (), np.zeros(0), 0.0, np.zeros(0)))
    free = effect_parameters(name, config)
    column = [f.name for f in free].index(f"effects.{name}.{number}")
    coordinates = screen.points(name, free)[:, column]
    assert coordinates.min() < 0.0 < coordinates.max()


def test_stated_effect_that_a_curve_contains_is_omitted(nominal: SimulatorConfig, windows: PredictionWindows) -> None:
    stated = {"throttle_deadband": {"width": 0.05}, MISALIGNMENT: {"angle": 0.02}}
    problem = SearchProblem(replace(nominal, effects=stated), windows, np.ones(6), np.ones(6), {})
    for curve in ("drive_map", "throttle_curve"):
        assert curve in EFFECTS["throttle_deadband"].represented_by
        assert set(problem.config_with((curve,)).effects) == {MISALIGNMENT, curve}
    assert problem.config_with(("aerodynamic_drag",)).effects.items() >= stated.items()


def test_model_has_the_standard_deviations_of_values_that_stay(nominal: SimulatorConfig) -> None:
    model = replace(nominal, effects={"motor_lag": {"time_constant": 0.05}})
    model = replace(model, parameter_std={"effects.motor_lag.time_constant": 0.004, "motor.drive_gain": 0.3})
    fitted = {"motor.drive_gain": Estimate(8.0, 0.1, 7.8, 8.2, "N")}
    diagnosis = Diagnosis("none", "", (), fitted, 1.0, {}, None, (), (), 0, 0.0)
    assert with_parameter_std(diagnosis, model).parameter_std == {
        "effects.motor_lag.time_constant": 0.004,
        "motor.drive_gain": 0.1,
    }


@pytest.mark.parametrize("is_opposite", [False, True])
def test_requested_effect_that_increases_the_held_out_error_is_withdrawn(
    case: Case, tmp_path: Path, nominal: SimulatorConfig, is_opposite: bool
) -> None:
    """The held-out recording has the misalignment of the fitted one, or the opposite one.

    The base parameters are known, so that a refit does not imitate the misalignment.
    """
    known = replace(nominal, parameter_std={f.name: 0.01 * f.origin for f in base_parameters(nominal) if f.logarithmic})
    fit = imported(rotated(case.fit, 0.06), tmp_path / "fit.csv")
    hold = imported(rotated(case.hold, -0.06 if is_opposite else 0.06), tmp_path / "hold.csv")
    outcome = diagnose(fit, hold, known, settings=FEWER, effects=(MISALIGNMENT,))
    assert [effect.id for effect in outcome.diagnosis.effects] == ([] if is_opposite else [MISALIGNMENT])


def test_sentence_counts_missing_and_wrong_effects_apart() -> None:
    def finding(name: str, values: dict[str, float]) -> EffectFinding:
        lag = {"time_constant": Estimate(0.11, 0.01, 0.1, 0.12, "s")}
        nowhere, no_evidence = ErrorLocation((), "", None, None, None), Evidence(0.0, 0.0, 0.0, {})
        return EffectFinding(name, 0.9, lag, nowhere, no_evidence, "", car_file_values=values)

    effects = (finding("steering_lag", {}), finding("motor_lag", {"time_constant": 0.05}))
    diagnosis = Diagnosis("mismatch", "", effects, {}, 1.0, {}, None, (), (), 0, 0.0)
    assert verdict_sentence(diagnosis) == (
        "The simulator leaves out one effect: a lag of the steering servo. "
        "One effect of the car file has wrong numbers: a lag of the motor."
    )
    assert with_texts(diagnosis).effects[1].sentence == (
        "Wrong in the car file: a lag of the motor: time_constant is 0.11 s (0.1 to 0.12 at 90 %), not 0.05 s."
    )
