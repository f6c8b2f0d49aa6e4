"""Test properties of each effect: identity, engines, gradients, files, symmetries."""

import cmath
import functools
import math
import tomllib

import numpy as np
import pytest
import tomli_w
import torch

from carlab.core.errors import ConfigError
from carlab.core.quantities import Action, CarState
from sim_backends.batch.rollout import rollout
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CATALOGUE, EFFECTS, MeasuredCurve
from sim_backends.plant import Plant
from tests.helpers.effect_inputs import NAMES, past, some, typical
from tests.helpers.measured_rollout import measured_rollout

IDS = [
    "command_delay",
    "steering_delay",
    "throttle_delay",
    "steering_lag",
    "steering_rate_limit",
    "steering_deadband",
    "steering_backlash",
    "steering_offset",
    "steering_asymmetry",
    "steering_nonlinearity",
    "throttle_deadband",
    "throttle_nonlinearity",
    "throttle_asymmetry",
    "motor_lag",
    "motor_saturation",
    "traction_limit",
    "all_wheel_drive",
    "speed_controller",
    "drag_brake",
    "brake_asymmetry",
    "battery_sag",
    "rolling_resistance",
    "aerodynamic_drag",
    "cornering_drag",
    "wheelbase",
    "centre_of_mass",
    "tyre_saturation",
    "front_wheel_play",
    "friction_ellipse",
    "combined_slip",
    "longitudinal_slip",
    "tyre_relaxation",
    "load_transfer",
    "roll_dynamics",
    "friction_drift",
    "low_friction_patch",
    "aerodynamic_downforce",
    "yaw_damping",
    "torque_steer",
    "lateral_bias",
    "road_slope",
    "mocap_latency",
    "marker_offset",
    "mocap_yaw_misalignment",
    "velocity_filter_lag",
]


def test_catalogue_is_complete():
    assert list(CATALOGUE) == IDS
    assert all(effect.catalogued == (name in IDS) for name, effect in EFFECTS.items())
    assert all(bool(effect.class_statement) != effect.catalogued for effect in EFFECTS.values())
    for effect in EFFECTS.values():
        assert {c.effect for c in effect.confusable} <= set(EFFECTS)
        parts = [EFFECTS[part] for group in effect.split_into for part in group]
        assert all(each.lag_parameter for each in (effect, *parts) if parts)


OTHERS = [name for name in NAMES if name != "tyre_saturation"]  # which turns a kinematic car into a dynamic one
GROUPS = [("tyre_saturation",), *(tuple(OTHERS[k::6]) for k in range(6))]
"""Sets of effects of which none hides another one. Each set of effects is compiled, so a set is faster than its parts.
"""


@functools.cache
def with_gradients(names, engine):
    """Return the rollout with effects at their identity, and its leaves and values with gradients."""
    config = SimulatorConfig(effects={name: {} for name in names})
    numbers = {k: v for k, v in config.values().items() if k != "timing.control_period"}
    # The latency effect replaces the base model's latency, so their gradients differ.
    numbers = {k: v for k, v in numbers.items() if not k.startswith("mocap.")}
    values = {k: torch.full((4,), v, dtype=torch.float64, requires_grad=True) for k, v in numbers.items()}
    # Gradients of a long chain of operators take long: 6 s for 6 ticks.
    (start, commands), history = some(ticks=3 if engine == "operators" else 6), past()
    # Commands act 0.08 s late, so one of the history is at the kink of a dead band and a power too.
    commands[:, 1] = history[:, -1] = 0.0
    leaves = [t.requires_grad_() for t in (start, commands, history)]
    options = {"t0_s": 2.0, "max_step_s": 0.02, "engine": engine}
    out = measured_rollout(config, start, commands, history=history, values=values, **options)
    (out.states.square().sum() + out.measured.square().sum()).backward()
    return out, leaves, values


@pytest.mark.parametrize("names", GROUPS, ids="-".join)
@pytest.mark.parametrize("engine", ["fastest", "operators"])
def test_effects_at_their_identity_change_neither_states_nor_gradients(names, engine):
    plain, plain_leaves, plain_values = with_gradients((), engine)
    same, leaves, values = with_gradients(names, engine)
    assert (plain.states - same.states).abs().max() <= 1e-12
    assert (plain.measured - same.measured).abs().max() <= 1e-12
    for key, value in values.items():
        assert value.grad is None or torch.isfinite(value.grad).all(), key
        if key in plain_values and not (key.startswith("tyre.") and "tyre_saturation" in names):
            assert torch.allclose(value.grad, plain_values[key].grad, rtol=1e-9, atol=1e-9), key
    for with_effects, without in zip(leaves, plain_leaves, strict=True):
        assert torch.allclose(with_effects.grad, without.grad, rtol=1e-9, atol=1e-9)


@functools.cache
def without_effects(kind):
    """Return the rollout of a car without effects."""
    return measured_rollout(SimulatorConfig(kind=kind), *some())


def is_changed(kind, names):
    """Whether effects at their identity change the rollout of a car."""
    plain = without_effects(kind)
    same = measured_rollout(SimulatorConfig(kind=kind, effects={name: {} for name in names}), *some())
    return bool(max((getattr(plain, k) - getattr(same, k)).abs().max() for k in ("states", "measured")) > 1e-12)


@pytest.mark.parametrize("catalogued", [True, False])
@pytest.mark.parametrize("kind", ["kinematic", "linear_tyre", "blend"])
def test_effects_at_their_identity_change_nothing_for_other_model_kinds(kind, catalogued):
    """All effects at once, since each set of effects is compiled; none hides another value of another one."""
    names = [name for name in NAMES if EFFECTS[name].catalogued == catalogued]
    if kind != "blend":  # tyre saturation turns such a car into one with Pacejka tyres
        names = [name for name in names if name != "tyre_saturation"]
    assert not is_changed(kind, names), [name for name in names if is_changed(kind, [name])]


CHOICES = [
    (name, p.name, word)
    for name in NAMES
    for p in EFFECTS[name].parameters
    for word in p.choices[1:]
]  # fmt: skip


@pytest.mark.parametrize(("name", "choice", "word"), CHOICES)
@pytest.mark.parametrize("kind", ["dynamic", "kinematic", "linear_tyre", "blend"])
def test_identity_of_the_numbers_holds_for_each_choice(name, choice, word, kind):
    plain = without_effects(kind)
    same = measured_rollout(SimulatorConfig(kind=kind, effects={name: {choice: word}}), *some())
    assert (plain.states - same.states).abs().max() <= 1e-12


def at_typical_values(names):
    """Return effects without delay at their typical values; a delay effect is at its identity."""
    delays = [name for name in names if EFFECTS[name].kind == "input" and "delay" in name]
    return {name: {} if name in delays else typical(name) for name in names}


def check_engines(config, monkeypatch):
    """Assert that plant, arrays, operators and compiled gradients have equal states; without delay steps are equal."""
    start, commands = some()
    arrays = rollout(config, start, commands).states
    operators = rollout(config, start, commands, engine="operators").states
    leaf = commands.clone().requires_grad_()
    compiled = rollout(config, start, leaf).states
    for other in (operators, compiled.detach()):
        assert torch.allclose(arrays, other, rtol=0, atol=1e-10)
    single = rollout(config, start.float(), commands.float()).states
    assert (single.double() - arrays).abs().max() < 2e-3
    monkeypatch.setattr("sim_backends.plant.wrap", lambda yaw: yaw)
    for i in range(2):
        plant = Plant(config)
        plant.reset(CarState(*start[i].tolist()), 0.0)
        for k in range(commands.shape[1]):
            plant.command(k * config.control_period_s, Action(*commands[i, k].tolist()))
            plant.advance((k + 1) * config.control_period_s)
            assert np.allclose(plant.state.to_array(), arrays[i, k + 1].numpy(), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_plant_arrays_operators_and_compiled_gradients_agree(name, monkeypatch):
    check_engines(SimulatorConfig(command_delay_s=0.0, effects=at_typical_values([name])), monkeypatch)


@pytest.mark.parametrize("names", GROUPS, ids="-".join)
def test_plant_arrays_operators_and_compiled_gradients_of_a_kinematic_car_agree(names, monkeypatch):
    """Half of the effects change no kinematic car."""
    check_engines(SimulatorConfig(kind="kinematic", command_delay_s=0.0, effects=at_typical_values(names)), monkeypatch)


@pytest.mark.parametrize("name", NAMES)
def test_per_car_effect_parameters_equal_single_rollouts(name):
    start, commands = some()
    shares = (0.4, 0.7, 1.0, 1.3)
    values = {}
    for p in EFFECTS[name].parameters:
        each = [p.typical * s for s in shares] if not p.choices else [0.0, 1.0, 1.0, 0.0]
        values[f"effects.{name}.{p.name}"] = torch.tensor(each, dtype=torch.float64)
    drawn = {"t0_s": torch.tensor([0.0, 5.0, 10.0, 0.0], dtype=torch.float64)}
    together = measured_rollout(SimulatorConfig(), start, commands, values=values, max_step_s=0.005, **drawn)
    for i in range(4):
        config = SimulatorConfig().with_values({k: float(v[i]) for k, v in values.items()})
        t0_s = float(drawn["t0_s"][i])
        alone = measured_rollout(config, start[i : i + 1], commands[i : i + 1], max_step_s=0.005, t0_s=t0_s)
        assert torch.allclose(alone.states[0], together.states[i], atol=1e-6)
        assert torch.allclose(alone.measured[0], together.measured[i], atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_gradients_by_the_effects_numbers_equal_finite_differences(name):
    base = SimulatorConfig(kind="linear_tyre" if name == "tyre_saturation" else "dynamic")
    (start, commands), history = some(cars=1), past(cars=1)
    keys = [f"effects.{name}.{p.name}" for p in EFFECTS[name].parameters if not p.choices]
    numbers = {f"effects.{name}.{k}": v for k, v in typical(name).items()}
    if name == "low_friction_patch":  # on its rim, where the position matters
        x, y = float(start[0, 0]), float(start[0, 1])
        numbers |= {f"effects.{name}.x": x - 0.5, f"effects.{name}.y": y - 0.4, f"effects.{name}.radius": 0.65}
    if name in ("coast_brake", "drag_brake"):
        commands[:, 2:, 1] *= 0.05

    def losses(values):
        copies = len(next(iter(values.values())))
        repeated = (t.repeat(copies, *[1] * (t.ndim - 1)) for t in (start, commands, history))
        s, c, h = repeated
        out = measured_rollout(base, s, c, history=h, values=values, parts=7, t0_s=3.0)
        weights = torch.linspace(0.5, 1.5, 42, dtype=torch.float64).reshape(7, 6)
        return ((out.states + 0.6 * out.measured) * weights).sum(dim=(1, 2))

    leaves = {k: torch.full((1,), v, dtype=torch.float64, requires_grad=True) for k, v in numbers.items()}
    losses(leaves).sum().backward()
    step = 1e-6
    perturbed = {k: torch.full((2 * len(keys),), v, dtype=torch.float64) for k, v in numbers.items()}
    for i, key in enumerate(keys):
        perturbed[key][2 * i : 2 * i + 2] += torch.tensor([step, -step], dtype=torch.float64)
    for key, (up, down) in zip(keys, losses(perturbed).reshape(-1, 2).tolist(), strict=True):
        assert float(leaves[key].grad) == pytest.approx((up - down) / (2 * step), rel=5e-4, abs=1e-6), key
        if not isinstance(EFFECTS[name], MeasuredCurve):  # a short drive does not reach all knots of a curve
            assert abs(up - down) > 1e-12, key


@pytest.mark.parametrize("name", NAMES)
def test_toml_round_trip(name):
    for given in ({}, typical(name)):
        config = SimulatorConfig(effects={name: given})
        reread = SimulatorConfig.from_tables(tomllib.loads(tomli_w.dumps(config.to_tables())))
        assert reread == config
        assert set(reread.effects[name]) == {p.name for p in EFFECTS[name].parameters}


def test_choice_is_a_word_in_car_files_and_a_position_elsewhere():
    tables = {"effects": {"traction_limit": {"share": 0.8, "axle": "all"}}}
    config = SimulatorConfig.from_tables(tables)
    assert config.values()["effects.traction_limit.axle"] == 1.0
    assert config.to_tables()["effects"]["traction_limit"]["axle"] == "all"
    assert SimulatorConfig(effects={"traction_limit": {"axle": "rear"}}).effects["traction_limit"]["axle"] == 0.0
    assert config == SimulatorConfig(effects=tables["effects"])
    for wrong in ("front", 0.5, True, 3):
        with pytest.raises(ConfigError, match="rear"):
            SimulatorConfig.from_tables({"effects": {"traction_limit": {"axle": wrong}}})
    with pytest.raises(ConfigError, match="must be a number"):
        SimulatorConfig(effects={"steering_lag": {"time_constant": "rear"}})


# Parameters that change sign under the mirror symmetry.
MIRRORED = {
    "steering_offset": ("angle",),
    "steering_asymmetry": ("gain",),
    "torque_steer": ("coefficient",),
    "lateral_bias": ("force",),
    "low_friction_patch": ("y",),
    "road_slope": ("direction",),
    "marker_offset": ("left",),
    "wind": ("direction",),
    "front_side_force": ("force",),
    "rear_side_force": ("force",),
    "braking_pull": ("coefficient",),
    "mocap_yaw_misalignment": ("angle",),
    "heading_error": ("mean", "cos_1", "cos_2", "cos_3"),
    "steering_trim": ("angle",),
    "body_force": ("left", "moment"),
}
FLIP = torch.tensor([1, -1, -1, 1, -1, -1], dtype=torch.float64)


@pytest.mark.parametrize("name", NAMES)
def test_mirror_symmetry(name):
    start, commands = some()
    original = measured_rollout(SimulatorConfig(effects={name: typical(name)}), start, commands, history=past())
    other = {k: -v if k in MIRRORED.get(name, ()) else v for k, v in typical(name).items()}
    if name in ("side_force_over_speed", "yaw_moment_over_speed"):
        other = {k: -v for k, v in other.items()}
    if name in ("steering_curve", "side_force_over_slip", "yaw_moment_over_slip"):
        other = {k: -v for k, v in zip(other, reversed(other.values()), strict=True)}
    mirror = torch.tensor([-1.0, 1.0], dtype=torch.float64)
    image = measured_rollout(
        SimulatorConfig(effects={name: other}),
        start * FLIP,
        commands * mirror,
        history=past() * mirror,
    )
    assert torch.allclose(original.states, image.states * FLIP, rtol=0, atol=1e-11)
    assert torch.allclose(original.measured, image.measured * FLIP, rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", NAMES)
def test_rigid_motion_of_the_world_with_its_fixed_objects(name):
    start, commands = some()
    angle, east, north = 1.1, 4.0, -7.0
    c, s = math.cos(angle), math.sin(angle)

    def transformed(states):
        x, y, yaw, *rest = states.unbind(-1)
        return torch.stack([east + c * x - s * y, north + s * x + c * y, yaw + angle, *rest], dim=-1)

    numbers = typical(name)
    moved_parameters = dict(numbers)
    if name == "low_friction_patch":
        moved_parameters["x"], moved_parameters["y"] = (
            east + c * numbers["x"] - s * numbers["y"],
            north + s * numbers["x"] + c * numbers["y"],
        )
    if name in ("road_slope", "wind"):
        moved_parameters["direction"] += angle
    if name == "heading_error":
        for k in (1, 2, 3):
            wave = complex(numbers[f"cos_{k}"], numbers[f"sin_{k}"]) * cmath.exp(1j * k * angle)
            moved_parameters[f"cos_{k}"], moved_parameters[f"sin_{k}"] = wave.real, wave.imag
    original = measured_rollout(SimulatorConfig(effects={name: numbers}), start, commands)
    image = measured_rollout(SimulatorConfig(effects={name: moved_parameters}), transformed(start), commands)
    assert torch.allclose(transformed(original.states), image.states, rtol=0, atol=1e-10)
    assert torch.allclose(transformed(original.measured), image.measured, rtol=0, atol=1e-10)
