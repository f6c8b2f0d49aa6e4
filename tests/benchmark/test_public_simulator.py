"""Test the scaling of the public simulator, and the input files and page of the study."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest

from carlab.benchmark.effects.catalogue import EFFECT_IDS
from carlab.benchmark.public_simulators import commonroad as public_simulator
from carlab.benchmark.public_simulators.commonroad import SCALE, Model, PublicCar, drive_public, parameters
from carlab.benchmark.public_simulators.commonroad_effects import PHYSICS, physics_of
from carlab.benchmark.public_simulators.study import activity, nominal_text, study, write_inputs
from carlab.benchmark.world.measurement import read_csv
from carlab.cars import load_car_file
from carlab.core.errors import CarlabError, ConfigError

pytest.importorskip("vehiclemodels", reason="commonroad-vehicle-models is not installed: pip install -e '.[studies]'")

FAKE_DIAGNOSIS = (sys.executable, str(Path(__file__).with_name("fake_public_diagnosis.py")))
MODELS: tuple[Model, ...] = ("multi_body", "drift")

# Powers of the length scale of the package's states: lengths 1, speeds 1/2, angles 0, rates of angles -1/2.
STATE_POWERS = {
    "drift": [1, 1, 0, 0.5, 0, -0.5, 0, -0.5, -0.5],
    "multi_body": [
        *(1, 1, 0, 0.5, 0, -0.5), *(0, -0.5, 0, -0.5, 0.5, 1, 0.5),
        *(0, -0.5, 0.5, 1, 0.5), *(0, -0.5, 0.5, 1, 0.5), *(-0.5,) * 4, 1, 1,
    ],
}  # fmt: skip


def settled(car: PublicCar, speed: float, steering: float, seconds: float, throttle_mps2: float = 0.0) -> np.ndarray:
    from scipy.integrate import solve_ivp

    def rates(_: float, x: np.ndarray) -> list[float]:
        return car.rates(x, ((steering - x[2]) * 30.0, throttle_mps2))

    solved = solve_ivp(rates, (0.0, seconds), car.start(0.0, 0.0, 0.0, speed), "LSODA", rtol=1e-8, atol=1e-9)
    assert solved.success
    return np.asarray(solved.y)


@pytest.mark.parametrize("model", MODELS)
def test_scaled_car_is_dynamically_similar_to_the_original(model: Model) -> None:
    car = PublicCar(model)
    full = PublicCar(model)
    full.p = parameters(1.0)
    powers = np.array(STATE_POWERS[model], dtype=float)
    rng = np.random.default_rng(4)
    for _ in range(20):
        x = full.start(1.0, 2.0, 0.7, 8.0)
        x *= 1.0 + rng.uniform(-0.05, 0.05, len(x))
        x += rng.uniform(-0.02, 0.02, len(x)) * (powers <= 0.5)
        inputs = rng.uniform((-0.3, -4.0), (0.3, 4.0))
        rates = np.array(full.rates(x, inputs))
        scaled = np.array(car.rates(x * SCALE**powers, (inputs[0] * SCALE**-0.5, inputs[1])))
        expected = rates * SCALE ** (powers - 0.5)
        assert scaled == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize(("model", "wheels"), [("multi_body", 4), ("drift", 2)])
def test_acceleration_includes_the_wheel_inertia(model: Model, wheels: int) -> None:
    car = PublicCar(model)
    p = car.p
    speed = settled(car, 1.0, 0.0, 0.5, throttle_mps2=1.0)[3, -1]
    expected_gain = 0.5 / (1.0 + wheels * p.I_y_w / (p.m * p.R_w**2))
    assert speed - 1.0 == pytest.approx(expected_gain, rel=0.02)


def test_steady_cornering_equals_that_of_a_neutral_car() -> None:
    # The tyre's slope is K = F_z |p_ky1| at both axles, so that understeer cancels: r = v d / L, and the rear axle's
    # slip a_y / (g |p_ky1|) gives the side slip angle.
    car = PublicCar("drift")
    p, steering = car.p, 0.02
    state = settled(car, 2.0, steering, 2.0)[:, -1]
    speed = state[3]
    rate = speed * math.tan(steering) / (p.a + p.b)
    assert state[5] == pytest.approx(rate, rel=0.02)
    assert state[6] == pytest.approx(p.b * rate / speed - speed * rate / (9.81 * abs(p.tire.p_ky1)), rel=0.03)


def test_roll_angle_of_the_multi_body_car() -> None:
    # Body roll over the axles (roll axes at the ground), without the tyres: K_phi phi = m_s a_y h_s + m_s g h_s phi.
    car = PublicCar("multi_body")
    p = car.p
    state = settled(car, 2.0, 0.08, 2.0)[:, -1]
    push = p.m_s * state[3] * state[5]
    stiffness = 0.5 * (p.K_sf * p.T_f**2 + p.K_sr * p.T_r**2) - p.K_tsf - p.K_tsr
    body_roll = abs(state[6] - 0.5 * (state[13] + state[18]))
    assert body_roll == pytest.approx((push + p.m_s * 9.81 * abs(state[6])) * p.h_s / stiffness, rel=0.15)


@pytest.mark.parametrize("model", MODELS)
def test_locked_wheel_rolls_again(model: Model) -> None:
    from scipy.integrate import solve_ivp

    car = PublicCar(model)
    spins = [23, 24, 25, 26] if model == "multi_body" else [7, 8]
    x = car.start(0.0, 0.0, 0.0, 2.0)
    x[spins] = -1e-9
    x = solve_ivp(lambda _, s: car.rates(s, (0.0, 0.0)), (0.0, 0.2), x, "LSODA").y[:, -1]
    assert x[spins] * car.p.R_w == pytest.approx(x[3], rel=0.02)


def test_noise_rates_and_bounds_of_a_recording() -> None:
    car = PublicCar("drift")
    public_drive = drive_public(car, 3, 0, 5.0)
    rows = len(public_drive.recording.t_s)
    assert rows == 151
    assert np.diff(public_drive.recording.t_s) == pytest.approx(1.0 / 30.0)
    std = public_drive.recording.error[:, :3].std(axis=0)
    assert std == pytest.approx([0.0006, 0.0006, 0.002], rel=4.0 / math.sqrt(2 * rows))
    assert public_drive.recording.clean[:, :3] == pytest.approx(public_drive.drive.rows[:, :3], abs=1e-9)
    max_steering_rate = np.abs(np.gradient(public_drive.states[:, 2], public_drive.drive.capture_s)).max()
    assert max_steering_rate <= 0.4 / math.sqrt(SCALE) * (1.0 + 1e-6)
    # Distance travelled is the integral of the package's speed.
    step = np.hypot(*np.diff(public_drive.drive.captures[:, :2], axis=0).T).sum()
    speed = np.hypot(public_drive.drive.captures[:, 3], public_drive.drive.captures[:, 4])
    assert step == pytest.approx(np.trapezoid(speed, public_drive.drive.capture_s), rel=2e-3)
    repeated = drive_public(PublicCar("drift"), 3, 0, 5.0)
    assert np.array_equal(repeated.recording.measured, public_drive.recording.measured)


def test_commands_reach_the_wheels_after_the_delay() -> None:
    car = PublicCar("drift")
    public_drive = drive_public(car, 3, 0, 5.0)
    acting_s = public_drive.drive.row_s + 0.05
    seconds, angle = public_drive.drive.capture_s, public_drive.states[:, 2]
    assert np.abs(angle[seconds < acting_s[0] - 1e-6]).max() < 1e-12
    assert np.abs(angle[(seconds > acting_s[0] + 0.01) & (seconds < acting_s[1])]).min() > 1e-6


def test_nominal_car_file_contains_the_measured_values(tmp_path: Path) -> None:
    for model in MODELS:
        path = tmp_path / f"{model}.toml"
        car = PublicCar(model)
        path.write_text(nominal_text(car))
        spec = load_car_file(path)
        assert spec is not None
        text = path.read_text()
        assert f"mass = {car.p.m:.3f}" in text
        for given in ("yaw_inertia", "mu", "drive_gain", "damping", "max_angle"):
            assert f"{given} = {{ value" in text


def test_each_effect_has_a_statement_for_both_models() -> None:
    assert set(PHYSICS) == set(EFFECT_IDS)
    for effect, statements in PHYSICS.items():
        assert sorted(m for s in statements for m in s.models) == sorted(MODELS), effect
    assert physics_of("roll_dynamics", "multi_body").presence == "yes"
    assert physics_of("roll_dynamics", "drift").presence == "no"


def test_study_writes_results_and_page(tmp_path: Path) -> None:
    rows = study(tmp_path / "study", "drift", [0], command=FAKE_DIAGNOSIS, lengths_s=(4.0, 2.0))
    assert rows[0]["ratio"] == pytest.approx(1.5 / 4.0)
    inputs = json.loads((tmp_path / "study" / "seed_0" / "report.json").read_text())["seen"]
    assert inputs["files"] == ["car.toml", "fit.csv", "hold.csv", "out"]
    assert str(tmp_path) not in " ".join(inputs["arguments"])
    assert len(read_csv(tmp_path / "study" / "seed_0" / "fit.csv")["t"]) == 121
    seed_rows = json.loads((tmp_path / "study" / "study.json").read_text())["seeds"]
    assert seed_rows == json.loads(json.dumps(rows))
    assert [(e["id"], e["in_equations"]) for e in seed_rows[0]["named"]] == [
        ("steering_rate_limit", "yes"), ("battery_sag", "no"),
    ]  # fmt: skip
    page = (tmp_path / "study" / "study.md").read_text()
    for words in ("Met for 1 of 1 seeds", "0.38", "Left out: steering_rate_limit.", "nothing depends on time",
                  "steering_lag (in the equations)", "1.25 rad/s (1.2 to 1.3); in the package 1.26"):  # fmt: skip
        assert words in page


def test_study_states_a_missing_report(tmp_path: Path) -> None:
    failing_diagnosis = (sys.executable, "-c", "raise SystemExit('no idea')")
    rows = study(tmp_path, "drift", [0], command=failing_diagnosis, lengths_s=(3.0, 2.0))
    assert rows[0]["verdict"] is None
    page = (tmp_path / "study.md").read_text()
    assert "Met for 0 of 1 seeds" in page
    assert "No report (exit status 1): no idea" in page


def test_stopped_study_writes_its_present_results(tmp_path: Path) -> None:
    assert study(tmp_path, "drift", [0, 1], command=FAKE_DIAGNOSIS, lengths_s=(3.0, 2.0), abandon=lambda: True) == []
    assert json.loads((tmp_path / "study.json").read_text())["seeds"] == []


def test_activity_of_a_drive_at_the_steering_rate_limit(tmp_path: Path) -> None:
    car = PublicCar("multi_body")
    shares = activity(car, write_inputs(car, 1, tmp_path, (2.0, 1.0)))
    assert 0.0 <= shares["share of time at the steering-rate limit"] <= 1.0
    assert shares["speed [m/s], 95th percentile"] > 0.7


def test_missing_package_raises_config_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(public_simulator, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"-e '\.\[studies\]'") as caught:
        parameters()
    assert isinstance(caught.value, CarlabError)
