"""Names that are withdrawn from physics outside the catalogue, on cases of the independent generator."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from carlab.benchmark.cases.case import Case, CaseKind, make_case
from carlab.benchmark.effects.catalogue import FormName
from carlab.benchmark.effects.random_physics import MonotoneMap
from carlab.diagnosis.decisions import Decision
from carlab.diagnosis.diagnose import Outcome, diagnose
from carlab.diagnosis.settings import DEFAULT
from sim_backends import EFFECTS, SimulatorConfig
from sim_backends.array_ops import ARRAYS
from sim_backends.effects import CATALOGUE, MeasuredCurve
from tests.helpers.case_files import car_in, episodes_in, write_case

FEWER = replace(DEFAULT, windows=replace(DEFAULT.windows, fit_stride_s=0.6, held_out_stride_s=0.5))
"""Half as many windows as by default. They overlap less, so they have nearly as much information."""
STATIC = ("steering_deadband", "steering_asymmetry", "steering_nonlinearity", "steering_offset", "yaw_damping")
STATIC_THROTTLE = ("throttle_deadband", "throttle_nonlinearity", "throttle_asymmetry", "motor_saturation")
DYNAMIC = ("steering_lag", "steering_delay", "yaw_damping")


def made(kind: CaseKind, effect: str, form: FormName) -> Case:
    return make_case(kind, 3, effects=(effect,), form=form, excess=2.0, fit_s=60, hold_s=30)


def found(case: Case, folder: Path, candidates: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> Outcome:
    """Diagnose a case with few candidates, because the whole catalogue takes long."""
    monkeypatch.setattr("carlab.diagnosis.diagnose.CATALOGUE", {name: CATALOGUE[name] for name in candidates})
    write_case(case, folder)
    fit, hold = episodes_in(folder / "fit.csv"), episodes_in(folder / "hold.csv")
    return diagnose(fit, hold, car_in(folder), settings=FEWER)


def decisions_by(outcome: Outcome, setting: str) -> list[Decision]:
    """Decisions in which a threshold was used."""
    return [d for d in outcome.figure_data.decisions if any(c.setting == setting for cs in d.alternatives for c in cs)]


def wheel_angle(model: SimulatorConfig, command: np.ndarray) -> np.ndarray:
    """Wheel angle [rad] over the steering command by the measured curve and its offset."""
    curve, values = EFFECTS["steering_curve"], model.values()
    assert isinstance(curve, MeasuredCurve)
    angle = model.parameters.max_angle_rad * command
    return np.asarray(curve.apply(ARRAYS, angle, curve.numbers(values))) + values["effects.steering_offset.angle"]


@pytest.mark.slow
def test_steering_map_that_no_effect_has_is_unexplained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A random increasing map of the steering command resembles an offset, which all other checks accept."""
    case = made("outside", "random_steering_map", "outside")
    outcome = found(case, tmp_path, STATIC, monkeypatch)
    refused = [(d.effect, d.alternatives[0][0].setting) for d in outcome.figure_data.decisions if not d.passed]
    assert outcome.diagnosis.verdict == "unexplained"
    assert outcome.diagnosis.effects == ()
    assert [each for each in refused if each[0] == "steering_offset"] == [("steering_offset", "rivals.curve_z_min")]
    assert outcome.diagnosis.unexplained is not None
    assert "a map of the steering command" in outcome.diagnosis.unexplained.kind

    drawn = case.concealed[0].parameters
    command = np.linspace(-0.9, 0.9, 37)
    true = case.true_car.max_angle * np.array([MonotoneMap(int(drawn["seed"]), drawn["size"])(u) for u in command])
    linear = command * float(command @ true) / float(command @ command)
    error = np.sqrt(np.mean((wheel_angle(outcome.model, command) - true) ** 2))
    assert error < 0.5 * np.sqrt(np.mean((linear - true) ** 2))


@pytest.mark.slow
def test_throttle_map_that_no_effect_has_is_unexplained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A random increasing map of the throttle resembles a non-linear throttle, which all other checks accept."""
    case = make_case("outside", 23, effects=("random_throttle_map",), excess=3.0, fit_s=60, hold_s=30)
    outcome = found(case, tmp_path, STATIC_THROTTLE, monkeypatch)
    assert [(d.effect, d.passed) for d in decisions_by(outcome, "rivals.curve_z_min")] == [
        ("throttle_nonlinearity", False)
    ]
    assert outcome.diagnosis.verdict == "unexplained"
    assert outcome.diagnosis.effects == ()
    assert outcome.diagnosis.unexplained is not None
    assert "a map of the throttle command" in outcome.diagnosis.unexplained.kind


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "form"),
    [
        ("steering_deadband", "other"),
        ("steering_asymmetry", "catalogue"),
        ("throttle_deadband", "other"),
        ("throttle_asymmetry", "catalogue"),
    ],
)
def test_effect_that_a_curve_contains_is_named(
    effect: str, form: FormName, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    candidates = STATIC if effect.startswith("steering") else STATIC_THROTTLE
    outcome = found(made("single", effect, form), tmp_path, candidates, monkeypatch)
    assert [e.id for e in outcome.diagnosis.effects] == [effect]
    assert {(d.effect, d.passed) for d in decisions_by(outcome, "rivals.curve_z_min")} == {(effect, True)}


@pytest.mark.slow
def test_servo_that_sags_under_load_is_no_lag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A lag explains most of the excess; terms of steering rate and throttle explain a part of the rest."""
    outcome = found(made("outside", "sagging_servo", "outside"), tmp_path, DYNAMIC, monkeypatch)
    assert outcome.diagnosis.verdict == "unexplained"
    assert outcome.diagnosis.effects == ()
    assert outcome.diagnosis.unexplained is not None
    assert "follows the rate of steering where there is throttle" in outcome.diagnosis.unexplained.kind
    [decision] = decisions_by(outcome, "rivals.min_explained_share_of_most")
    assert (decision.effect, decision.passed) == ("steering_lag", False)
