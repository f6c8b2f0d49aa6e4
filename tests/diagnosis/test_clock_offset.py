"""Commands whose clock differs by seconds from that of the poses are found and shifted; other drives are not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from carlab.core.episode_data import EpisodeData
from carlab.diagnosis.diagnose import diagnose
from carlab.diagnosis.recording_faults.find import check
from sim_backends.car_parameters import SimulatorConfig
from tests.helpers.recorded_drives import drive

NOMINAL = SimulatorConfig.from_preset()
DELAY_S = NOMINAL.command_delay_s + NOMINAL.mocap.latency_s
STEP_S, STEPS_PER_ROW = 3e-3, 11
PERIOD_S = STEP_S * STEPS_PER_ROW


def random_signal(t_s: np.ndarray, period_s: float, rng: np.random.Generator) -> np.ndarray:
    knots = np.arange(t_s[0], t_s[-1] + 2 * period_s, period_s)
    return np.interp(t_s, knots, rng.uniform(-1, 1, len(knots)))


def kinematic_drive(t_s: np.ndarray, steering: np.ndarray, throttle: np.ndarray, late_s: float = 0.0) -> EpisodeData:
    """A kinematic car, integrated in steps of 3 ms; the log has each command ``late_s`` after it was sent."""
    delay, late = round(DELAY_S / STEP_S), round(late_s / STEP_S)
    margin = round(10.0 / STEP_S)  # rows before and after the recording
    drive, wheel = (np.roll(u, delay) for u in (throttle, steering))
    speed = lfilter([STEP_S], [1.0, 1.2 * STEP_S - 1.0], 5.0 * drive)
    yaw = np.cumsum(lfilter([STEP_S / 0.06], [1.0, STEP_S / 0.06 - 1.0], speed * np.tan(0.4 * wheel) / 0.3)) * STEP_S
    x, y = (np.cumsum(speed * direction(yaw)) * STEP_S for direction in (np.cos, np.sin))
    rows = np.arange(margin, len(t_s) - margin, STEPS_PER_ROW)
    states = np.column_stack([x, y, yaw, speed, 0 * x, np.gradient(yaw, STEP_S)])[rows]
    states += np.random.default_rng(0).normal(size=states.shape) * [5e-4, 5e-4, 2e-3, 8e-3, 8e-3, 2e-2]
    states[:, 2] = (states[:, 2] + np.pi) % (2 * np.pi) - np.pi
    commands = np.column_stack([steering, throttle])[rows - late][:-1]
    metadata = {"velocity_source": "vx, vy: columns in the body frame; yaw_rate: column"}
    return EpisodeData(t_s[rows], states, commands, commands, np.full(len(commands), np.nan), metadata=metadata)


def random_drive(seconds: float, late_s: float = 0.0) -> EpisodeData:
    rng = np.random.default_rng(1)
    t_s = np.arange(-10.0, seconds + 10.0, STEP_S)
    steering = 0.5 * random_signal(t_s, 0.7, rng) + 0.3 * random_signal(t_s, 2.5, rng)
    throttle = 0.4 + 0.35 * random_signal(t_s, 0.9, rng) + 0.15 * random_signal(t_s, 3.0, rng)
    return kinematic_drive(t_s, steering, throttle, late_s)


def periodic_drive(lap_s: float, late_s: float = 0.0) -> EpisodeData:
    t_s = np.arange(-10.0, 70.0, STEP_S)
    phase = 2 * np.pi * t_s / lap_s
    return kinematic_drive(t_s, 0.4 + 0.4 * np.sin(phase), 0.4 + 0.2 * np.sin(2 * phase), late_s)


def offsets(faults) -> list[str]:
    return [fault.action for fault in faults if fault.id == "clock_offset"]


@pytest.mark.parametrize(("seconds", "late_s"), [(60, 1), (60, -1), (30, 2), (30, -4), (60, 8)])
def test_commands_are_shifted_to_the_clock_of_the_poses(seconds, late_s):
    true, late = random_drive(seconds), random_drive(seconds, late_s)
    (repaired,), _, faults = check([late], [], NOMINAL)
    (action,) = offsets(faults)
    assert action.startswith(f"repaired: the motion {'precedes' if late_s > 0 else 'follows'} the commands by ")
    assert {fault.id for fault in faults} == {"clock_offset"}
    assert true.ticks - repaired.ticks <= abs(late_s) / PERIOD_S + 4
    first = round(float(repaired.times_s[0] - true.times_s[0]) / PERIOD_S)
    row_errors = []
    for shift in range(-4, 5):  # the shift of the repaired commands that remains
        rows = slice(first + 4, first + repaired.ticks - 4)
        repaired_rows = slice(4 + shift, repaired.ticks - 4 + shift)
        row_errors.append(np.abs(repaired.sent[repaired_rows] - true.sent[rows]).mean())
    assert abs(int(np.argmin(row_errors)) - 4) <= 1


def test_report_names_the_recordings_whose_clock_is_not_measured():
    """An offset of more than a third of a recording is not found."""
    _, _, faults = check([random_drive(60, 4.0), random_drive(10, 4.0)], [], NOMINAL)
    (action,) = offsets(faults)
    assert action.endswith("the audit finds no offset in 1 of 2 recordings: check their clocks too.")


@pytest.mark.parametrize("seconds", [10, 60])
def test_one_clock_is_not_reported(seconds):
    episode = random_drive(seconds)
    (same,), _, faults = check([episode], [], NOMINAL)
    assert same is episode
    assert not faults


@pytest.mark.parametrize("late_s", [0.0, 4.0])
@pytest.mark.parametrize("lap_s", [1.0, 4.0, 9.0])
def test_periodic_drive_does_not_show_the_clock(lap_s, late_s):
    _, _, faults = check([periodic_drive(lap_s, late_s)], [], NOMINAL)
    assert not offsets(faults)


def test_slow_commands_do_not_show_the_clock():
    """The response has the largest correlation at a wrong lag where commands change every 15 s."""
    t_s = np.arange(-10.0, 70.0, STEP_S)
    steps = np.floor(t_s / 15.0) % 4
    drive = kinematic_drive(t_s, 0.2 + 0.15 * steps, 0.4 + 0.0 * t_s)
    _, _, faults = check([drive, replace(drive, sent=np.roll(drive.sent, 100, axis=0))], [], NOMINAL)
    assert not offsets(faults)


def test_delay_after_an_offset_is_fitted_and_no_finding():
    """A servo with a lag of 0.1 s: neither the offset nor the lag of the servo is reported as a delay."""
    true = replace(NOMINAL, effects={"steering_lag": {"time_constant": 0.1}})
    driven = drive(true, seconds=120.0, seed=3)
    late = replace(driven, sent=np.roll(driven.sent, -90, axis=0))
    diagnosis = diagnose([late], [], NOMINAL, effects=["command_delay", "mocap_latency", "steering_lag"]).diagnosis
    assert [fault.id for fault in diagnosis.data_faults] == ["clock_offset"]
    (effect,) = diagnosis.effects
    assert effect.id == "steering_lag"
    assert effect.parameters["time_constant"].value == pytest.approx(0.1, abs=0.01)
    assert diagnosis.parameters["timing.command_delay"].value >= 0.0
