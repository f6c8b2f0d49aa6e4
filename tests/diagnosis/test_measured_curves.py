"""Measured curves of a car with a motor controller that is not in the catalogue, and their report."""

import itertools
import json
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from carlab.cars import load_car_file
from carlab.diagnosis.curves.curve_fit import fit_curves
from carlab.diagnosis.curves.simulator_with_curves import simulator_with_curves
from carlab.diagnosis.curves.support import curve_findings, driving_time_s
from carlab.diagnosis.diagnose import diagnose
from carlab.diagnosis.findings import CurveAxis, CurveFinding, CurveTrial, FigureData, RejectedCurves
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fitter
from carlab.diagnosis.report.curves import curve_sentences, readings_of_drive
from carlab.diagnosis.report.html_page import render_page
from carlab.diagnosis.report.numbers import with_unit
from carlab.diagnosis.report.write import write_report
from carlab.diagnosis.selection.problem import RunControl, SearchProblem
from carlab.diagnosis.selection.search import search
from carlab.diagnosis.settings import DEFAULT, IDENTIFICATION, CurveSettings
from carlab.prediction.errors import prediction_errors
from carlab.prediction.predict import SimulatorModel
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import EFFECTS, SimulatorConfig, registered
from sim_backends.effects import CURVES, DynamicsEffect, EffectParameter
from tests.diagnosis.report_material import changed, no_mismatch
from tests.helpers.recorded_drives import PERIOD_S, drive

CAR = SimulatorConfig(control_period_s=PERIOD_S)
GAIN, TOP_SPEED, LIMIT = 4.0, 3.0, 4.0
SETTINGS = replace(
    DEFAULT,
    curves=CurveSettings(max_windows=36, first_iterations=2, iterations=1, last_iterations=1),
    selection=replace(DEFAULT.selection, folds=3),
    windows=replace(DEFAULT.windows, max_fit_windows=40),
)


@contextmanager
def only_curve(curve_id):
    """Fit this curve only, because all four have some two hundred parameters."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("carlab.diagnosis.curves.curve_fit.CURVES", tuple(c for c in CURVES if c.id == curve_id))
        yield


def controller_acceleration(throttle, speed):
    """A controller that holds the speed 3 m/s times throttle, with at most 4 m/s2."""
    return np.clip(GAIN * (TOP_SPEED * np.asarray(throttle) - np.asarray(speed)), -LIMIT, LIMIT)


class HeldSpeed(DynamicsEffect):
    """``F_x = m clip(4 /s (3 m/s u - vx), -4 m/s2, 4 m/s2)``, with the strength 1."""

    id = "held_speed"
    catalogued = False
    summary = "The motor controller holds a speed."
    class_statement = "holds a speed"
    parameters = (EffectParameter("strength", "1", 0.0, 0.0, 1.0, 1.0),)

    def on_drive(self, ops, forces, values):
        held = ops.clip(GAIN * (TOP_SPEED * forces.throttle - forces.vx), -LIMIT, LIMIT)
        damped = forces.mass * held + 1.56 * forces.vx  # the base model subtracts its damping
        forces.drive = forces.drive + values["strength"] * (damped - forces.drive)


@pytest.fixture(scope="module")
def drives():
    with registered(HeldSpeed()):
        config = replace(CAR, effects={"held_speed": {"strength": 1.0}})
        return drive(config, 70.0, 1), drive(config, 25.0, 2)


@pytest.fixture(scope="module")
def outcome(drives):
    fit, held_out = drives
    with only_curve("drive_map"):
        return diagnose([fit], [held_out], CAR, effects=("steering_lag",), settings=SETTINGS, curves=True)


def test_measured_curves_lower_the_held_out_error(outcome):
    held_out = outcome.diagnosis.held_out
    assert held_out["with_curves"].position_m < 0.35 * held_out["with_effects"].position_m
    assert held_out["with_curves"].score < 0.35 * held_out["with_effects"].score
    assert "drive_map" in [curve.id for curve in outcome.diagnosis.curves]


def test_drive_map_agrees_with_the_controller_where_it_is_supported(outcome):
    curve = next(c for c in outcome.diagnosis.curves if c.id == "drive_map")
    throttle, speed = np.meshgrid(*(a.knots for a in curve.axes), indexing="ij")
    expected = controller_acceleration(throttle, speed)
    supported = curve.support_s > 1.5
    error = np.abs(curve.measured - expected)[supported]
    assert supported.sum() >= 12
    assert np.median(error) < 0.35
    assert np.median(np.abs(curve.car_file - expected)[supported]) > 3.0 * np.median(error)


def test_curves_end_where_the_recordings_end(outcome, drives):
    curve = next(c for c in outcome.diagnosis.curves if c.id == "drive_map")
    never = np.array(curve.axes[0].knots) <= -0.6  # no drive brakes harder than -0.3
    assert np.isnan(curve.measured[never]).all()
    assert np.isnan(curve.std[never]).all()
    seconds = len(drives[0].times_s) * PERIOD_S
    assert curve.support_s.sum() == pytest.approx(seconds, rel=0.01)


def test_model_does_not_extrapolate_beyond_the_recordings(outcome):
    """Knots without data have the deviation of the nearest knot with data."""
    curve = next(c for c in outcome.diagnosis.curves if c.id == "drive_map")
    effect, values = EFFECTS["drive_map"], outcome.model.values()
    deviations = np.array(effect.table({p.name: values[f"effects.drive_map.{p.name}"] for p in effect.parameters}))
    driven = curve.support_s >= SETTINGS.curves.min_fitted_s
    assert (~driven).sum() > 10
    for place in np.argwhere(~driven):
        distance = np.linalg.norm(np.argwhere(driven) - place, axis=1)
        nearest = np.argwhere(driven)[distance <= distance.min() + 1e-9]
        assert any(deviations[tuple(place)] == pytest.approx(deviations[tuple(k)]) for k in nearest)


def test_report_and_model_file_contain_the_curves(outcome, tmp_path):
    write_report(outcome.diagnosis, outcome.figure_data, tmp_path, outcome.model)
    report = json.loads((tmp_path / "report.json").read_text())
    table = next(c for c in report["curves"] if c["id"] == "drive_map")
    assert np.shape(table["measured"]) == tuple(len(axis["knots"]) for axis in table["axes"])
    assert None in itertools.chain(*table["measured"])
    page = (tmp_path / "report.html").read_text()
    assert "Measured curves" in page
    assert "The motor holds a speed rather than a force" in page
    model = load_car_file(tmp_path / "model.toml").simulator
    assert model.values() == pytest.approx(outcome.model.values())
    assert any(name.startswith("effects.drive_map.") for name in model.parameter_std)


def test_penalty_of_a_curve_is_that_of_its_roughness():
    windows = cut_windows(segments_of([drive(CAR, 15.0, 3)]), 0.8, 0.5)
    problem = SearchProblem(CAR, windows, np.full(6, 1e-2), np.full(6, 1e-2), {}, ())
    free = problem.free_parameters(("front_tyre_map",))
    fitter = Fitter(windows, Scale(np.array([1]), np.ones((1, 6))))
    z = np.zeros((1, len(free)))
    own = [k for k, f in enumerate(free) if f.name.startswith("effects.front_tyre_map.")]
    z[0, own] = np.random.default_rng(0).normal(size=len(own))
    bends = EFFECTS["front_tyre_map"].roughness() @ z[0, own]
    expected = 0.5 * (bends**2).sum() / IDENTIFICATION.curve_roughness_std**2
    expected += 0.5 * (z[0, own] ** 2).sum() / IDENTIFICATION.curve_std**2
    assert fitter.prior(free, z)[0] == pytest.approx(expected)


def test_driving_time_counts_rows_near_each_knot():
    curve = next(c for c in CURVES if c.id == "steering_curve")
    episode = drive(CAR, 10.0, 4)
    segments = tuple(segments_of([episode]))
    total = driving_time_s(curve, replace(CAR, command_delay_s=0.0), segments)
    angle = CAR.parameters.max_angle_rad * np.concatenate([t.commands[:, 0] for t in segments])
    knots = np.array(curve.axes[0].knots)
    expected = [np.interp(angle, knots, np.eye(len(knots))[k]).sum() * PERIOD_S for k in range(len(knots))]
    assert total == pytest.approx(np.array(expected))


def finding(measured, std=0.05):
    """A drive map of the given accelerations on the knots of the simulator, with a car file that only accelerates."""
    axes = tuple(CurveAxis(a.name, a.unit, a.knots) for a in EFFECTS["drive_map"].axes)
    throttle, speed = np.meshgrid(*(a.knots for a in axes), indexing="ij")
    shape = measured.shape
    return CurveFinding(
        "drive_map", "acceleration by the motor", "m/s2", axes, 5.0 * throttle - speed, measured,
        np.full(shape, std), np.full(shape, 5.0),
    )  # fmt: skip


def test_readings_of_a_controller_that_holds_a_speed():
    axes = EFFECTS["drive_map"].axes
    throttle, speed = np.meshgrid(*(a.knots for a in axes), indexing="ij")
    sentences = readings_of_drive(finding(controller_acceleration(throttle, speed)))
    assert any("With the throttle released, the motor brakes with 2 to 4 m/s²" in s for s in sentences)
    assert any("0.3 m/s at throttle 0.1" in s for s in sentences)
    assert any("saturates" in s for s in sentences)


def test_readings_of_the_car_file_itself_are_empty(outcome):
    axes = EFFECTS["drive_map"].axes
    throttle, speed = np.meshgrid(*(a.knots for a in axes), indexing="ij")
    same = finding(5.0 * throttle - speed)
    assert readings_of_drive(same) == []
    braking = finding(5.0 * throttle - speed - 0.6 * speed * (throttle == 0.0))  # a motor that brakes while coasting
    assert [s.partition(",")[0] for s in readings_of_drive(braking)] == ["With the throttle released"]
    assert curve_sentences(replace(outcome.diagnosis, curves=())) == []


def test_curve_that_the_recordings_do_not_need_is_rejected_with_its_test():
    """The drive is that of the car file, so no curve improves the prediction."""
    windows = cut_windows(segments_of([drive(CAR, 20.0, 5)]), 0.8, 0.8)
    problem = SearchProblem(CAR, windows, np.full(6, 1e-2), np.full(6, 1e-2), {}, (), SETTINGS)
    found = search(problem, RunControl())
    with only_curve("steering_curve"):
        accepted, rejected = fit_curves(problem, found, RunControl())
    assert accepted is None
    assert [each.curves for each in rejected] == [("steering_curve",)]
    assert rejected[0].standard_errors < rejected[0].min_standard_errors


@pytest.mark.parametrize(
    ("trial", "expected"),
    [
        (
            CurveTrial(True, (RejectedCurves(("steering_curve",), -0.8, 0.0),)),
            "The measured curve of the wheel angle is fitted but not accepted: it raises the loss on left-out blocks "
            "by 0.8 standard errors.",
        ),
        (
            CurveTrial(True, (RejectedCurves(("drive_map", "front_tyre_map"), 1.94, 3.0),)),
            "The measured curves of the acceleration by the motor and side force of the front axle per load are fitted "
            "but not accepted: together they lower the loss on left-out blocks by 1.94 standard errors, less than the "
            "required 3.",
        ),
        (
            CurveTrial(is_fitted=False),
            "Measured curves are not fitted: the model leaves less than 10 % of the refit's squared excess over the "
            "noise floor.",
        ),
    ],
)
def test_report_states_why_curves_are_not_accepted(trial, expected):
    without = changed(no_mismatch(), curve_trial=trial)
    assert curve_sentences(without) == [expected]
    page = render_page(without, FigureData())
    assert expected.replace("'", "&#39;") in page
    assert without.to_dict()["curve_trial"]["is_fitted"] == trial.is_fitted


@pytest.mark.parametrize("curve", CURVES, ids=lambda c: c.id)
def test_curve_findings_of_the_car_file_equal_its_curve(curve):
    """Without deviations, the measured curve is the base model's."""
    from carlab.diagnosis.curves.curve_fit import CurveFit
    from carlab.diagnosis.identification.fit import Fit

    config = replace(CAR, effects={curve.id: {}})
    windows = cut_windows(segments_of([drive(CAR, 15.0, 3)]), 0.8, 0.5)
    free = SearchProblem(CAR, windows, np.full(6, 1e-2), np.full(6, 1e-2), {}, ()).free_parameters((curve.id,))
    fit = Fit(config, free, np.zeros(len(free)), 0.0, np.zeros(1), np.eye(len(free)))
    found = curve_findings(CurveFit((curve.id,), fit), CAR, tuple(segments_of([drive(CAR, 30.0, 7)])), DEFAULT.curves)
    seen = np.isfinite(found[0].measured)
    assert seen.any()
    assert found[0].measured[seen] == pytest.approx(found[0].car_file[seen])


def test_band_of_a_curve_includes_the_covariance_of_base_parameters():
    """The band of ``gain u / m + a`` with opposite errors of gain and deviation is narrower than either."""
    from carlab.diagnosis.curves.curve_fit import CurveFit
    from carlab.diagnosis.identification.fit import Fit

    config = replace(CAR, effects={"drive_map": {}})
    windows = cut_windows(segments_of([drive(CAR, 15.0, 3)]), 0.8, 0.5)
    free = SearchProblem(CAR, windows, np.full(6, 1e-2), np.full(6, 1e-2), {}, ()).free_parameters(("drive_map",))
    names = [f.name for f in free]
    gain, knot = names.index("motor.drive_gain"), names.index("effects.drive_map.value_12_6")  # throttle 1
    covariance = np.zeros((len(free), len(free)))
    slope = 0.1 * CAR.parameters.drive_gain_n / CAR.parameters.mass_kg  # change of the curve per unit of z
    covariance[gain, gain], covariance[knot, knot] = 1.0, slope**2
    covariance[gain, knot] = covariance[knot, gain] = -0.9 * slope
    fit = Fit(config, free, np.zeros(len(free)), 0.0, np.zeros(1), covariance)
    segments = tuple(segments_of([drive(CAR, 60.0, 7)]))
    settings = replace(DEFAULT.curves, min_support_s=0.0)
    found = curve_findings(CurveFit(("drive_map",), fit), CAR, segments, settings)[0]
    assert found.std[12, 6] == pytest.approx(slope * np.sqrt(2.0 - 1.8), rel=0.02)
    assert found.std[12, 7] == pytest.approx(slope, rel=0.02)
    assert found.std[6, 7] == pytest.approx(0.0, abs=1e-9)  # no throttle


def test_verdict_states_the_error_with_measured_curves(outcome):
    from carlab.diagnosis.report.numbers import number
    from carlab.diagnosis.report.sentences import verdict_sentence

    found = outcome.diagnosis.held_out["with_curves"]
    assert (
        f"position error is {with_unit(found.position_m, 'm')} (all channels: {number(found.score)} noise floors)"
        in verdict_sentence(outcome.diagnosis)
    )
    assert "measured curve" not in verdict_sentence(replace(outcome.diagnosis, curves=()))


def position_rms(config, windows):
    """Root mean square of the position errors [m] at the end of windows."""
    error = prediction_errors(SimulatorModel(config).predict(windows), windows)[:, -1]
    return float(np.sqrt(np.mean(error[:, 0] ** 2 + error[:, 1] ** 2)))


@pytest.mark.slow
def test_all_curves_together_predict_a_drive_that_they_were_not_fitted_to(drives):
    fit, held_out = drives
    found = simulator_with_curves([fit], CAR, settings=SETTINGS)
    windows = cut_windows(segments_of([held_out]), 1.0, 0.5)
    assert position_rms(found, windows) < 0.35 * position_rms(CAR, windows)
    assert "drive_map" in found.effects


def test_simulator_with_a_curve_predicts_a_drive_that_it_was_not_fitted_to():
    """The steering saturates; a gain of the steering explains a part of this."""
    true = replace(CAR, effects={"steering_nonlinearity": {"saturation": 0.2}})
    with only_curve("steering_curve"):
        found = simulator_with_curves([drive(true, 30.0, 5)], CAR, settings=SETTINGS)
    windows = cut_windows(segments_of([drive(true, 20.0, 6)]), 1.0, 0.5)
    assert position_rms(found, windows) < 0.35 * position_rms(CAR, windows)
    assert "steering_curve" in found.effects


@pytest.mark.slow
def test_simulator_without_missing_physics_has_none_of_all_curves():
    found = simulator_with_curves([drive(CAR, 40.0, 5)], CAR, settings=SETTINGS)
    assert not any(curve.id in found.effects for curve in CURVES)


def test_simulator_without_missing_physics_has_no_curve():
    with only_curve("steering_curve"):
        found = simulator_with_curves([drive(CAR, 30.0, 5)], CAR, settings=SETTINGS)
    assert "steering_curve" not in found.effects
