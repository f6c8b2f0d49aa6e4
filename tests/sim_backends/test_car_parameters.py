"""Test car files: valid and invalid tables, and round trips."""

import re
import tomllib

import pytest
import tomli_w

from carlab.core.errors import ConfigError
from sim_backends.car_parameters import SimulatorConfig, preset_names
from sim_backends.effects import EFFECTS
from sim_backends.registry import REGISTRY

CAR_FILE = """
[vehicle]
mass = 1.65
yaw_inertia = 0.06
front_axle = 0.13
rear_axle = 0.17
[tyre.front]
B = 2.75
C = 1.45
mu = 0.43
[tyre.rear]
B = 5.0
C = 1.3
mu = 0.42
[motor]
drive_gain = 8.2
damping = 1.56
[steering]
max_angle = 0.6
[timing]
control_period = 0.0333333333
command_delay = 0.08
[model]
kind = "dynamic"
[mocap]
rate = 120.0
position_std = 0.0003
yaw_std = 0.002
latency = 0.008
dropout = 0.0
"""


def test_documented_car_file_equals_the_default():
    assert SimulatorConfig.from_tables(tomllib.loads(CAR_FILE)) == SimulatorConfig()
    assert SimulatorConfig.from_tables({}) == SimulatorConfig()


def test_default_preset_has_the_default_numbers_and_a_range_for_each_tyre_number():
    preset = SimulatorConfig.from_preset()
    assert preset.values() == SimulatorConfig().values()
    assert preset.priors["tyre.front.B"] == (2.0, 4.0)
    assert "rc_car" in preset_names()
    for name in preset_names():
        SimulatorConfig.from_preset(name)


def test_toml_round_trip_keeps_effects_and_priors():
    tables = tomllib.loads(CAR_FILE)
    tables["effects"] = {
        "steering_lag": {"time_constant": 0.11},
        "marker_offset": {"left": {"value": 0.01, "low": -0.1, "high": 0.1}},
    }
    tables["motor"]["drive_gain"] = {"value": 8, "low": 6.0, "high": 10.0}
    config = SimulatorConfig.from_tables(tables)
    assert config.effects["marker_offset"] == {"ahead": 0.0, "left": 0.01}
    assert config.priors == {"motor.drive_gain": (6.0, 10.0), "effects.marker_offset.left": (-0.1, 0.1)}
    reread = SimulatorConfig.from_tables(tomllib.loads(tomli_w.dumps(config.to_tables())))
    assert reread == config
    assert reread.values()["motor.drive_gain"] == 8.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vehicle": {"mas": 1.0}}, "Unknown key 'mas' in [vehicle] of car.toml; did you mean 'mass'?"),
        ({"tire": {}}, "did you mean 'tyre'?"),
        ({"tyre": {"frnt": {}}}, "did you mean 'front'?"),
        ({"effects": {"stering_lag": {}}}, "did you mean 'steering_lag'?"),
        ({"effects": {"steering_lag": {"tau": 0.1}}}, "known keys: time_constant"),
        ({"effects": {"steering_lag": {"time_constants": 0.1}}}, "did you mean 'time_constant'?"),
        ({"hardware": {}}, "Unknown key 'hardware'"),
        ({"vehicle": {"mass": 0.0}}, "vehicle.mass is 0 kg; it must be greater than 0"),
        ({"vehicle": {"mass": -1.0}}, "it must be greater than 0"),
        ({"vehicle": {"mass": 0.00165}}, "vehicle.mass is 0.00165 kg; it must be greater than 0.05 (SI units"),
        ({"vehicle": {"mass": "heavy"}}, "must be a number"),
        ({"vehicle": {"mass": True}}, "must be a number"),
        ({"vehicle": {"mass": float("nan")}}, "give a finite number in kg"),
        ({"motor": {"damping": float("inf")}}, "give a finite number"),
        ({"steering": {"max_angle": 30.0}}, "another unit"),
        ({"timing": {"control_period": 0}}, "greater than 0"),
        ({"mocap": {"dropout": 1.5}}, "at most 1"),
        ({"model": {"kind": "dynamik"}}, "dynamic, linear_tyre, kinematic, blend"),
        ({"model": {"kinds": "dynamic"}}, "did you mean 'kind'?"),
        ({"motor": {"drive_gain": {"value": 8.2, "low": 9.0, "high": 10.0}}}, "must lie between"),
        ({"motor": {"drive_gain": {"value": 8.2, "low": 9.0}}}, "'high' is missing"),
        ({"effects": {"steering_lag": {"time_constant": -0.1}}}, "at least 0"),
        ({"effects": {"command_delay": {"extra_delay": -0.09}}}, "adds up to -0.01 s"),
        ({"vehicle": 3}, "must be a table"),
    ],
)
def test_invalid_file_is_refused_with_the_remedy(change, message):
    with pytest.raises(ConfigError, match=re.escape(message)) as caught:
        SimulatorConfig.from_tables(change, "car.toml")
    assert "car.toml" in str(caught.value)


def test_values_by_dotted_name_cover_the_registry_and_can_be_changed():
    config = SimulatorConfig(effects={name: {} for name in EFFECTS})
    assert set(config.values()) == set(REGISTRY)
    for name, info in REGISTRY.items():
        if info.default is not None:
            assert config.values()[name] == info.default, name
    changed = config.with_values({"tyre.front.mu": 0.5, "mocap.rate": 240.0, "timing.command_delay": 0.1})
    assert changed.parameters.front_mu == 0.5
    assert (changed.mocap.rate_hz, changed.command_delay_s) == (240.0, 0.1)
    assert SimulatorConfig().with_values({"effects.motor_lag.time_constant": 0.2}).effects == {
        "motor_lag": {"time_constant": 0.2}
    }


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("tyre.front.muu", "Unknown key 'muu' in [tyre.front]; did you mean 'mu'?"),
        ("motor.gain", "Unknown key 'gain' in [motor]; did you mean 'drive_gain'?"),
        ("effects.steering_lag.tau", "Unknown key 'tau' in [effects.steering_lag]; known keys: time_constant."),
        ("effects.steering_lag", "did you mean 'effects.steering_lag.time_constant'?"),
        ("mass", "did you mean 'vehicle.mass'?"),
    ],
)
def test_unknown_name_is_refused_with_the_nearest_name_of_its_table(name, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        SimulatorConfig().with_values({"vehicle.mass": 2.0, name: 0.5})


def test_message_about_an_unknown_name_lists_the_nearest_of_many():
    with pytest.raises(ConfigError) as refused:
        SimulatorConfig().with_values({"grip": 0.5})
    message = str(refused.value)
    assert message.startswith(f"Unknown key 'grip' in the parameters; the nearest of {len(REGISTRY)} names are ")
    assert "effects.grip_change.share" in message
    assert message.count(",") == 4


def test_effect_that_is_not_registered_is_refused_with_the_remedy():
    with pytest.raises(ConfigError, match=r"'cubic_drag' in \[effects\].* Register an effect of your own at the top"):
        SimulatorConfig.from_tables({"effects": {"cubic_drag": {"coefficient": 0.5}}})


def test_latency_effect_without_a_number_uses_the_car_file():
    config = SimulatorConfig.from_tables({"mocap": {"latency": 0.013}, "effects": {"mocap_latency": {}}})
    assert config.effects["mocap_latency"]["latency"] == 0.013


def test_delays_add_up_per_channel():
    config = SimulatorConfig(effects={"command_delay": {"extra_delay": -0.03}, "steering_delay": {"delay": 0.02}})
    assert config.delays_s() == pytest.approx((0.07, 0.05))


def test_number_may_have_a_standard_deviation_with_or_without_a_range():
    tables = {
        "motor": {
            "drive_gain": {"value": 8.2, "std": 0.5},
            "damping": {"value": 1.5, "low": 1.0, "high": 2.0, "std": 0.1},
        },
        "effects": {"steering_lag": {"time_constant": {"value": 0.1, "std": 0.02}}},
    }
    found = SimulatorConfig.from_tables(tables)
    assert found.parameter_std == {
        "motor.drive_gain": 0.5,
        "motor.damping": 0.1,
        "effects.steering_lag.time_constant": 0.02,
    }
    assert found.priors == {"motor.damping": (1.0, 2.0)}
    assert SimulatorConfig.from_tables(tomllib.loads(tomli_w.dumps(found.to_tables()))) == found
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match=r"std of motor\.drive_gain is"):
            SimulatorConfig.from_tables({"motor": {"drive_gain": {"value": 8.2, "std": wrong}}})
    with pytest.raises(ConfigError, match="'low' is missing"):
        SimulatorConfig.from_tables({"motor": {"drive_gain": {"value": 8.2, "high": 9.0, "std": 0.1}}})


def test_latency_missing_in_the_car_file_is_unknown_until_set() -> None:
    """The simulator uses the default latency; written files omit it."""
    silent = SimulatorConfig.from_tables({"mocap": {"rate": 100.0}})
    assert silent.unknown == {"mocap.latency"}
    assert silent.mocap.latency_s == SimulatorConfig().mocap.latency_s
    assert "latency" not in silent.to_tables()["mocap"]
    assert SimulatorConfig.from_tables(silent.to_tables()).unknown == {"mocap.latency"}
    assert silent.with_values({"motor.damping": 2.0}).unknown == {"mocap.latency"}
    known = silent.with_values({"mocap.latency": 0.02})
    assert not known.unknown
    assert known.to_tables()["mocap"]["latency"] == 0.02
    for stated in ({"mocap": {"latency": 0.008}}, {"effects": {"mocap_latency": {"latency": 0.01}}}):
        assert not SimulatorConfig.from_tables(stated).unknown
    assert not SimulatorConfig().unknown
    assert not SimulatorConfig.from_preset().unknown
