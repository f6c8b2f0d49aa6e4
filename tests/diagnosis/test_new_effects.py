"""Test that a registered effect is simulated, diagnosed, reported, saved and used as a prior of learning.

Three effects, one of each kind, are defined here and registered for these tests only.
"""

import json
from collections.abc import Iterator
from html import escape
from pathlib import Path

import numpy as np
import pytest
import torch

from carlab.cars import load_car_file
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError
from carlab.core.manoeuvres import MANOEUVRES
from carlab.core.quantities import Action, CarState
from carlab.diagnosis.diagnose import Outcome, diagnose
from carlab.diagnosis.report.sentences import (
    effect_noun,
    refutation_sentence,
    separating_drive,
    separating_reason,
)
from carlab.diagnosis.report.write import write_report
from carlab.prediction.initial_states import as_recorded
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import cut_windows, segments_of
from learning.priors.domain_models import draw_parameters
from learning.priors.simulator_model import CarModel, known_ranges
from sim_backends import EFFECTS, REGISTRY, SimulatedCar, SimulatorConfig, registered, rollout
from sim_backends.effects import (
    CATALOGUE,
    ActuatorEffect,
    Confusable,
    DelayEffect,
    DynamicsEffect,
    Effect,
    EffectParameter,
    ObservationEffect,
    confusable_effects,
)
from sim_backends.plant import Plant
from tests.helpers.measured_rollout import measured_rollout


class CubicSteering(ActuatorEffect):
    """``d = d_cmd (1 + gain d_cmd^2)``."""

    id = "cubic_steering"
    command = "steering"
    order = 55
    parameters = (EffectParameter("gain", "1/rad2", 0.0, -2.0, 5.0, 0.5),)
    confusable = (Confusable("steering_nonlinearity", "slow_circle", "one widens a circle and the other tightens it"),)
    name = "a steering that yields more towards full lock"
    summary = "The wheel angle grows more than the command towards full lock."
    sentence = "the wheel angle grows with the cube of the command, with a gain of {gain}"
    refuted_if = "a slow circle at full lock is no tighter than the linear steering says"

    def apply(self, ops, command, values):
        return command * (1.0 + values["gain"] * command * command)


class SpinMoment(DynamicsEffect):
    """``M += coefficient vx^2``."""

    id = "spin_moment"
    parameters = (EffectParameter("coefficient", "N m s2/m2", 0.0, -1.0, 1.0, 0.03),)
    name = "a moment that grows with speed"
    summary = "A moment turns the car in proportion to the square of its speed."
    sentence = "a moment of {coefficient:size} times speed squared turns the car to the {coefficient:left|right}"
    refuted_if = "the car drives straight at high speed"

    def on_body(self, ops, forces, values):
        forces.moment = forces.moment + values["coefficient"] * forces.vx * forces.vx


class MarkerAhead(ObservationEffect):
    """``p_meas = p + R(yaw) [ahead, 0]``, so that ``vy_meas = vy + ahead r``; without a closed-form inverse here."""

    id = "marker_ahead"
    parameters = (EffectParameter("ahead", "m", 0.0, -1.0, 1.0, 0.03),)
    name = "a tracked point ahead of the centre of mass"
    summary = "Motion capture tracks a point on the car's axis that is not the centre of mass."
    sentence = "the tracked point is {ahead:size} {ahead:ahead of|behind} the centre of mass"
    refuted_if = "on a slow circle the tracked point has the lateral velocity of the centre of mass"

    def observe(self, ops, state, values):
        x, y, yaw, vx, vy, yaw_rate = state
        ahead = values["ahead"]
        return x + ahead * ops.cos(yaw), y + ahead * ops.sin(yaw), yaw, vx, vy + ahead * yaw_rate, yaw_rate


class SpeedGain(ObservationEffect):
    """``vx_meas = (1 + gain) vx`` on the velocity columns only."""

    id = "speed_gain"
    velocities_only = True
    parameters = (EffectParameter("gain", "1", 0.0, -0.5, 0.5, 0.05),)
    summary = "The recorded forward speed is in proportion to the true one, not equal to it."

    def observe(self, ops, state, values):
        x, y, yaw, vx, vy, yaw_rate = state
        return x, y, yaw, (1.0 + values["gain"]) * vx, vy, yaw_rate


NEW = (CubicSteering(), SpinMoment(), MarkerAhead())
TRUE = {"cubic_steering": {"gain": 1.2}, "spin_moment": {"coefficient": 0.05}, "marker_ahead": {"ahead": 0.06}}
IDS = tuple(TRUE)


pytestmark = pytest.mark.timeout(900)
"""Time limit of a diagnosis on a busy machine."""


@pytest.fixture(scope="module", autouse=True)
def _registered() -> Iterator[None]:
    with registered(*NEW):
        yield


def recording(seed: int, seconds: float = 16.0) -> EpisodeData:
    """Simulate a drive with all three effects at 30 Hz, with motion-capture noise."""
    rng = np.random.default_rng(seed)
    ticks = round(30 * seconds)
    sent = np.repeat(rng.uniform([-0.9, 0.1], [0.9, 0.4], (ticks // 10, 2)), 10, axis=0)
    config = SimulatorConfig(effects=TRUE, control_period_s=1.0 / 30.0)
    start = torch.tensor([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]], dtype=torch.float64)
    measured = measured_rollout(config, start, torch.from_numpy(sent)[None]).measured
    states = measured[0].numpy() + rng.normal(size=(ticks + 1, 6)) * [3e-4, 3e-4, 1e-3, 6e-3, 6e-3, 1e-2]
    return EpisodeData(np.arange(ticks + 1) / 30.0, states, sent, sent, np.zeros(ticks))


@pytest.fixture(scope="module")
def found(_registered: None) -> Outcome:
    """Diagnose the nominal car with the three candidate effects."""
    return diagnose([recording(1)], [recording(2, 8.0)], SimulatorConfig(), effects=IDS)


@pytest.fixture(scope="module")
def report(found: Outcome, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_report(found.diagnosis, found.figure_data, folder, found.model)
    return folder


@pytest.mark.parametrize("name", IDS)
def test_all_engines_agree_on_a_new_effect(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim_backends.plant.wrap", lambda yaw: yaw)
    config = SimulatorConfig(effects={name: TRUE[name]}, command_delay_s=0.0)
    start = torch.tensor([[0.2, 0.1, 0.3, 1.5, 0.1, 0.4]], dtype=torch.float64)
    commands = torch.tensor(np.random.default_rng(0).uniform(-0.8, 0.8, (1, 8, 2)))
    arrays = rollout(config, start, commands).states
    operators = rollout(config, start, commands, engine="operators").states
    compiled = rollout(config, start, commands.clone().requires_grad_()).states
    for other in (operators, compiled):
        assert torch.allclose(arrays, other.detach(), rtol=0, atol=1e-12)
    plant = Plant(config)
    plant.reset(CarState(*start[0].tolist()), 0.0)
    for k, (steering, throttle) in enumerate(commands[0].tolist()):
        plant.command(k * config.control_period_s, Action(steering, throttle))
        state = plant.advance((k + 1) * config.control_period_s)
        assert np.allclose(state.to_array(), arrays[0, k + 1].numpy(), rtol=0, atol=1e-10)
    with_effect, plain = (
        measured_rollout(each, start, commands).measured for each in (config, SimulatorConfig(command_delay_s=0.0))
    )
    assert (with_effect - plain).abs().max() > 1e-3


def test_gradients_of_new_effects_equal_finite_differences() -> None:
    start = torch.tensor([[0.0, 0.0, 0.0, 1.5, 0.1, 0.4]], dtype=torch.float64)
    commands = torch.full((1, 6, 2), 0.5, dtype=torch.float64)
    for name, own in TRUE.items():
        (parameter, value), step = next(iter(own.items())), 1e-6
        key = f"effects.{name}.{parameter}"

        def loss(number: torch.Tensor, key: str = key) -> torch.Tensor:
            found = measured_rollout(SimulatorConfig(), start, commands, values={key: number}).measured
            return found.square().sum()

        leaf = torch.tensor([value], dtype=torch.float64, requires_grad=True)
        torch.autograd.backward(loss(leaf))
        up, down = (float(loss(torch.tensor([value + d], dtype=torch.float64))) for d in (step, -step))
        assert leaf.grad is not None
        assert float(leaf.grad) == pytest.approx((up - down) / (2 * step), rel=1e-5)


class ShiftedHeading(ObservationEffect):
    """``yaw_meas = yaw + angle``."""

    id = "shifted_heading"
    parameters = (EffectParameter("angle", "rad", 0.0, -1.0, 1.0, 0.1),)
    summary = "The recorded heading is shifted."

    def observe(self, ops, state, values):
        return (*state[:2], state[2] + values["angle"], *state[3:])


def test_simulated_car_applies_observation_effects() -> None:
    effects = {"shifted_heading": {"angle": 0.2}, "speed_gain": {"gain": 0.25}}
    with registered(ShiftedHeading(), SpeedGain()):
        for more in ({}, {"velocity_filter_lag": {"time_constant": 0.01}}):
            config = SimulatorConfig(effects={**effects, **more})
            with SimulatedCar(config, start=CarState(vx_mps=2.0)) as car:
                measured = car.observe().state
            assert measured.yaw_rad == pytest.approx(0.2, abs=0.01)
            # The estimator resolves the velocity along the shifted heading.
            assert measured.vx_mps == pytest.approx(1.25 * 2.0 * np.cos(0.2), abs=0.02)
    assert "shifted_heading" not in EFFECTS


def test_diagnosis_names_and_estimates_all_three_effects(found: Outcome) -> None:
    named = {e.id: e for e in found.diagnosis.effects}
    assert set(named) == set(IDS)
    for name, own in TRUE.items():
        for parameter, value in own.items():
            assert named[name].parameters[parameter].value == pytest.approx(value, rel=0.15), name
    assert set(found.model.effects) == set(IDS)


def test_report_contains_the_texts_of_new_effects(found: Outcome, report: Path) -> None:
    written = json.loads((report / "report.json").read_text())
    page = (report / "report.html").read_text()
    for effect in written["effects"]:
        own = EFFECTS[effect["id"]]
        assert effect["sentence"].startswith("Left out: " + own.sentence.split("{")[0])
        assert escape(effect["sentence"]) in page
        assert escape(own.refuted_if) in page
    assert effect_noun("spin_moment") == SpinMoment.name
    assert refutation_sentence("spin_moment") == "This would be wrong if the car drives straight at high speed."


def test_confusable_effects_and_separating_drives_are_symmetric() -> None:
    pairs = confusable_effects()
    assert "steering_nonlinearity" in pairs["cubic_steering"]
    assert "cubic_steering" in pairs["steering_nonlinearity"]
    for one, other in (("cubic_steering", "steering_nonlinearity"), ("steering_nonlinearity", "cubic_steering")):
        assert separating_drive(one, (other,)) == "slow_circle"
        assert separating_reason(one, (other,)) == "One widens a circle and the other tightens it."
    assert "slow_circle" in MANOEUVRES


def test_windows_with_a_velocity_effect_start_from_true_velocities() -> None:
    """Velocities from poses are not inverted; recorded ones are."""
    with registered(SpeedGain()):
        config = SimulatorConfig(effects={"speed_gain": {"gain": 0.3}}, control_period_s=1.0 / 30.0)
        ticks = 120
        sent = np.tile([0.2, 0.4], (ticks, 1))
        start = torch.tensor([[0.0, 0.0, 0.0, 1.0, 0.0, 0.3]], dtype=torch.float64)
        measured = measured_rollout(config, start, torch.from_numpy(sent)[None]).measured
        episode = EpisodeData(np.arange(ticks + 1) / 30.0, measured[0].numpy(), sent, sent, np.zeros(ticks))
        windows = cut_windows(segments_of([episode]), 0.5, 0.5)
        for variant in (windows, as_recorded(windows)):
            error = simulate_windows(variant, config)[0, -2:] - variant.measured[-2:]
            assert np.abs(error[..., :2]).max() < 2e-3
            assert np.abs(error[..., 3]).max() < 1e-2


def test_car_file_and_prior_contain_the_effects(found: Outcome, report: Path) -> None:
    config = load_car_file(report / "model.toml").simulator
    assert {name: dict(own) for name, own in config.effects.items()} == {
        name: dict(own) for name, own in found.model.effects.items()
    }
    ranges = known_ranges(config)
    numbers = {f"effects.{name}.{parameter}" for name, own in TRUE.items() for parameter in own}
    assert numbers <= set(ranges)
    model = CarModel(config, 6, {name: ranges[name] for name in sorted(numbers)})
    draws = draw_parameters(model, 4, torch.Generator().manual_seed(0)).double()
    rows = torch.tensor(np.random.default_rng(3).uniform(-0.5, 0.5, (5, 3 + 2 * 7))) + torch.eye(1, 17)[0] * 1.5
    batched = model(rows, draws)
    assert torch.isfinite(batched).all()
    for k in range(len(numbers)):  # each parameter has an influence
        changed = draws.clone()
        changed[:, k] *= 1.1
        assert (model(rows, changed) - batched).abs().max() > 1e-6, model.names[k]


def test_prior_with_the_effects_predicts_recorded_rows_better() -> None:
    from learning.transitions import transitions_of

    config = SimulatorConfig(effects=TRUE, control_period_s=1.0 / 30.0)
    rows = transitions_of([recording(3, 10.0)], 8)
    mass = torch.tensor([[config.parameters.mass_kg]], dtype=torch.float64)
    errors = [
        (
            CarModel(c, 8, {"vehicle.mass": (1.0, 2.0)})(torch.from_numpy(rows.inputs), mass)[0]
            - torch.from_numpy(rows.targets)
        ).square()
        for c in (config, SimulatorConfig(control_period_s=1.0 / 30.0))
    ]
    assert errors[0][:, [0, 2, 5]].mean() < 0.5 * errors[1][:, [0, 2, 5]].mean()


def test_temporary_registration_ends_and_duplicates_raise_an_error() -> None:
    class Other(SpinMoment):
        id = "other_moment"

    class Nameless(SpinMoment):
        id = "nameless"
        parameters = ()

    with registered(Other()):
        assert "other_moment" in CATALOGUE
        assert "effects.other_moment.coefficient" in REGISTRY
        with pytest.raises(ConfigError, match="other_moment"), registered(Other()):
            pass
        assert "other_moment" in EFFECTS
    assert "other_moment" not in {**EFFECTS, **CATALOGUE}
    assert not [name for name in REGISTRY if "other_moment" in name]
    with pytest.raises(ConfigError, match="no parameters"), registered(Nameless()):
        pass


def test_compiled_step_is_not_reused_for_a_new_class_with_the_same_id() -> None:
    start = torch.tensor([[0.0, 0.0, 0.0, 1.5, 0.0, 0.0]], dtype=torch.float64)
    commands = torch.zeros((1, 5, 2), dtype=torch.float64)

    def yaw_after(sign: float) -> float:
        class Moment(SpinMoment):
            id = "moment"

            def on_body(self, ops, forces, values):
                forces.moment = forces.moment + sign * values["coefficient"]

        effect: Effect = Moment()
        with registered(effect):
            config = SimulatorConfig(effects={"moment": {"coefficient": 0.1}})
            return float(rollout(config, start, commands).states[0, -1, 2])

    assert yaw_after(1.0) == pytest.approx(-yaw_after(-1.0))
    assert yaw_after(1.0) > 0.01


@pytest.mark.parametrize(
    ("kind", "method", "settings"),
    [
        (DelayEffect, "extra_delays_s", {}),
        (ActuatorEffect, "apply", {}),
        (ActuatorEffect, "step", {"has_state": True}),
        (DynamicsEffect, "stiff_step", {"stiff": True}),
    ],
)
def test_effect_without_a_required_method_is_refused(
    kind: type[Effect], method: str, settings: dict[str, bool]
) -> None:
    content = {"id": "incomplete", "parameters": CubicSteering.parameters, **settings}
    incomplete = type("Incomplete", (kind,), content)
    with pytest.raises(ConfigError, match=f"has no method '{method}'"), registered(incomplete()):
        pass
    assert "incomplete" not in EFFECTS
    complete = type("Complete", (kind,), {**content, method: lambda *arguments: None})
    with registered(complete()):
        assert "incomplete" in EFFECTS
