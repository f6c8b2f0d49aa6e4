"""The presets of public cars: loading by name, and the published numbers."""

import tomllib
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from carlab.cars import choose_car, load_car_file
from carlab.cli import run
from carlab.core.clock import Pacer
from carlab.core.errors import ConfigError
from carlab.core.quantities import Action, CarState, Reality
from sim_backends.car_parameters import SimulatorConfig

CARS = ("eth_rc_car", "dart_jetracer", "dart_jetracer_linear", "f1tenth")
ALL_CARS = (*CARS, "eth_rc_car_effects")
MEASURED_PARAMETERS = (
    "vehicle.mass",
    "vehicle.front_axle",
    "vehicle.rear_axle",
    "timing.control_period",
    "timing.command_delay",
)


@pytest.mark.parametrize("name", ALL_CARS)
def test_preset_is_loaded_by_name_and_by_path(name):
    by_name = load_car_file(Path(name))
    with resources.as_file(resources.files("sim_backends") / "presets" / f"{name}.toml") as path:
        by_path = load_car_file(path)
    assert by_name == by_path
    assert by_name.simulator == SimulatorConfig.from_preset(name)
    assert tomllib.loads(by_name.text)["model"]["kind"] == by_name.simulator.kind


@pytest.mark.parametrize("name", CARS)
def test_measured_parameters_are_fixed_and_unknown_ones_have_a_range(name):
    config = SimulatorConfig.from_preset(name)
    for parameter in MEASURED_PARAMETERS:
        assert parameter not in config.priors
    uncertain = {n for n in config.values() if n.startswith(("tyre.", "motor.", "steering."))} | {"vehicle.yaw_inertia"}
    assert uncertain == {n for n in config.priors if not n.startswith("effects.")}
    for low, high in config.priors.values():
        assert high > 1.5 * low


def test_preset_parameters_equal_the_published_values():
    eth = SimulatorConfig.from_preset("eth_rc_car").parameters
    assert (eth.mass_kg, eth.front_axle_m, eth.rear_axle_m) == (1.65, 0.13, 0.17)
    dart = SimulatorConfig.from_preset("dart_jetracer").parameters
    # 0.847 of 1.58 kg on the front axle: the lever rule about either axle of a wheelbase of 0.1735 m.
    assert dart.wheelbase_m == pytest.approx(0.1735, abs=1e-9)
    assert dart.mass_kg * dart.rear_axle_m / dart.wheelbase_m == pytest.approx(0.847, abs=0.001)


def test_linear_preset_differs_only_in_its_tyre_model():
    dynamic, linear = (SimulatorConfig.from_preset(n) for n in ("dart_jetracer", "dart_jetracer_linear"))
    assert (dynamic.kind, linear.kind) == ("dynamic", "linear_tyre")
    assert dynamic.values() == linear.values()
    assert dynamic.priors == linear.priors


def test_preset_with_effects_is_the_eth_car_with_a_range_for_each_effect():
    plain, uncertain = (SimulatorConfig.from_preset(n) for n in ("eth_rc_car", "eth_rc_car_effects"))
    assert uncertain.parameters == plain.parameters
    assert uncertain.mocap == plain.mocap
    assert {n for n, r in plain.priors.items() if uncertain.priors[n] != r} == {"motor.drive_gain", "motor.damping"}
    of_effects = set(uncertain.priors) - set(plain.priors)
    assert {name.split(".")[1] for name in of_effects} == set(uncertain.effects)
    assert len(uncertain.effects) == 9


@pytest.mark.parametrize("name", ALL_CARS)
def test_preset_can_be_driven_as_a_simulated_car(name):
    choice = choose_car(name)
    assert choice.car.reality is Reality.SIMULATED
    with choice.car as car:
        car.place(CarState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        car.arm()
        for _ in range(3 * round(1.0 / choice.control_period_s)):
            car.command(Action(0.3, 0.5))
            car.clock.sleep_until(car.clock.now_s() + choice.control_period_s)
        state = car.observe().state
    assert state.vx_mps > 0.5
    assert state.yaw_rate_radps > 0.2


def test_f1tenth_car_turns_and_holds_its_speed_as_published():
    """Steady turn of the single-track model with the axle stiffness mu C_S load of f1tenth_gym."""
    mass, front, rear, mu, stiffness = 3.74, 0.15875, 0.17145, 1.0489, (4.718, 5.4562)
    speed, angle = 2.0, 0.1 * 0.4189
    loads = [mass * 9.81 * arm / (front + rear) for arm in (rear, front)]
    front_axle, rear_axle = (mu * slope * load for slope, load in zip(stiffness, loads, strict=True))
    understeer = mass / (front + rear) ** 2 * (rear / front_axle - front / rear_axle)
    states = []
    with choose_car("f1tenth").car as car:
        car.place(CarState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        car.arm()
        for _ in range(160):
            car.command(Action(0.1, speed / 5.04))
            car.clock.sleep_until(car.clock.now_s() + 0.025)
            states.append(car.observe().state)
    settled = states[80:]
    assert np.mean([s.vx_mps for s in settled]) == pytest.approx(speed, rel=0.01)
    yaw_rate = speed * angle / (front + rear) / (1.0 + understeer * speed**2)
    assert np.mean([s.yaw_rate_radps for s in settled]) == pytest.approx(yaw_rate, rel=0.02)


def test_unknown_name_is_refused_with_the_available_names(capfd):
    with pytest.raises(
        ConfigError, match="dart_jetracer, dart_jetracer_linear, eth_rc_car, eth_rc_car_effects, f1tenth, rc_car"
    ):
        load_car_file(Path("dart_jetracr"))
    with pytest.raises(
        ConfigError,
        match=r"dart_jetracer, dart_jetracer_linear, eth_rc_car, eth_rc_car_effects, f1tenth, rc_car, or a FILE\.toml",
    ):
        choose_car("dart_jetracr")
    assert run(["replay", "nothing.csv", "--car", "dart_jetracr"]) == 2
    assert "eth_rc_car" in " ".join(capfd.readouterr().err.split())


def test_file_has_priority_over_a_preset_of_the_same_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("eth_rc_car").write_text("[vehicle]\nmass = 9.0\n")
    assert load_car_file(Path("eth_rc_car")).simulator.parameters.mass_kg == 9.0


def test_frames_of_a_different_reality_follow_the_control_period_of_the_car_file(tmp_path):
    file = tmp_path / "reality.toml"
    file.write_text("[timing]\ncontrol_period = 0.05\n")
    choice = choose_car("sim", reality=file)
    with choice.car as car:
        pacer = Pacer(car.clock, choice.control_period_s)
        pacer.start()
        sequences = []
        for _ in range(100):
            pacer.wait()
            sequences.append(car.observe().sequence)
    assert np.diff(sequences).tolist() == [4] * 99
