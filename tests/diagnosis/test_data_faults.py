"""Test detection and repair of recording faults, and the absence of faults for unusual physics."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.diagnosis.recording_faults.find import check
from carlab.diagnosis.recording_faults.integration_step import check_integration
from carlab.recording.audit.report import RefusedError
from carlab.recording.csv.export import write_csv
from carlab.recording.csv.foreign import import_csv
from carlab.recording.csv.repairing_import import import_repaired
from carlab.recording.faults.robust import first_order_lag, held_means
from tests.helpers.kinematic_drives import DELAY_S, NOMINAL, Car, with_sent, with_states, without_rows

X, Y, YAW, VX, VY, RATE = range(6)


@pytest.fixture(scope="module")
def circling() -> EpisodeData:
    return Car(seed=2, mean_steering=0.4).drive()


def channels_of(faults, identity: str) -> list[str]:
    return [f.channel for f in faults if f.id == identity]


@pytest.mark.parametrize(
    "car",
    [
        Car(seed=3),
        Car(seed=4, rate_hz=100.0, seconds=40.0),
        Car(seed=5, steering_delay_s=DELAY_S + 0.18),
        Car(seed=6, throttle_delay_s=DELAY_S + 0.2, motor_lag_s=0.15),
        Car(seed=7, steering_delay_s=0.02, throttle_delay_s=0.02),
        Car(seed=8, steering_delay_s=DELAY_S + 0.1, throttle_delay_s=DELAY_S + 0.1),
        Car(seed=9, velocity_lag_s=0.15),
        Car(seed=10, drag=2.5),
    ],
    ids=["plain", "100 Hz", "steering late", "motor late", "early", "latency", "filtered velocities", "drag"],
)
def test_physics_is_not_reported_as_a_fault(car):
    episode = car.drive()
    (fit,), held, faults = check([episode], [], NOMINAL)
    assert faults == []
    assert fit is episode
    assert held == []


SIGNS_AND_SCALES = [
    ("wrong_unit", "yaw_rate", RATE, 180 / np.pi),
    ("wrong_unit", "vx", VX, 100.0),
    ("column_scale", "vx", VX, 0.8),
    ("column_scale", "vx", VX, 1.1),
    ("column_scale", "yaw_rate", RATE, 2.0),
    ("wrong_sign", "yaw_rate", RATE, -1.0),
    ("wrong_sign", "vy", VY, -1.0),
]


@pytest.mark.parametrize(("identity", "name", "column", "factor"), SIGNS_AND_SCALES)
def test_unit_scale_and_sign_of_a_velocity_column_are_repaired(clean, identity, name, column, factor):
    def change(states):
        states[:, column] *= factor

    (fit,), _, faults = check([with_states(clean, change)], [], NOMINAL)
    assert channels_of(faults, identity) == [name]
    assert len(faults) == 1
    assert faults[0].action.startswith("repaired")
    assert faults[0].rows == len(clean.states)
    np.testing.assert_allclose(fit.states[:, column], clean.states[:, column], rtol=0.03, atol=1e-6)


def test_velocities_in_the_world_frame_are_rotated_to_the_body_frame(clean):
    def change(states):
        c, s = np.cos(states[:, YAW]), np.sin(states[:, YAW])
        vx, vy = states[:, VX].copy(), states[:, VY].copy()
        states[:, VX], states[:, VY] = c * vx - s * vy, s * vx + c * vy

    (fit,), _, faults = check([with_states(clean, change)], [], NOMINAL)
    assert [(f.id, f.channel) for f in faults] == [("wrong_frame", "vx, vy")]
    np.testing.assert_allclose(fit.states[:, 3:5], clean.states[:, 3:5], atol=0.01)


@pytest.mark.parametrize(("channel", "name"), [(0, "steering"), (1, "throttle")])
def test_wrong_command_sign_is_repaired_in_each_recording(clean, held, channel, name):
    def change(sent):
        sent[:, channel] *= -1

    fit, out, faults = check([with_sent(clean, change)], [with_sent(held, change)], NOMINAL)
    assert [(f.id, f.channel) for f in faults] == [("wrong_sign", name)]
    np.testing.assert_array_equal(fit[0].sent, clean.sent)
    np.testing.assert_array_equal(out[0].sent, held.sent)


@pytest.mark.parametrize(("channel", "name"), [(0, "steering"), (1, "throttle")])
def test_command_column_recorded_too_late_is_shifted(clean, held, channel, name):
    rows = 7

    def change(sent):
        sent[:, channel] = np.roll(sent[:, channel], rows)

    fit, _, faults = check([with_sent(clean, change)], [with_sent(held, change)], NOMINAL)
    assert [(f.id, f.channel) for f in faults] == [("column_shift", name)]
    assert f"{rows} rows" in faults[0].action
    n_ticks = fit[0].ticks
    assert clean.ticks - n_ticks <= rows + 1
    np.testing.assert_allclose(fit[0].sent[:, channel], clean.sent[:n_ticks, channel], atol=1e-9)
    np.testing.assert_array_equal(fit[0].states, clean.states[: n_ticks + 1])


@pytest.mark.parametrize("rate", [0.003, -0.002])
def test_commands_of_another_clock_are_converted(clean, held, rate):
    def drifting(episode: EpisodeData) -> EpisodeData:
        held_rows = np.searchsorted(episode.times_s[:-1], episode.times_s[:-1] * (1 + rate), side="right") - 1
        return replace(episode, sent=episode.sent[np.clip(held_rows, 0, episode.ticks - 1)])

    fit, out, faults = check([drifting(clean)], [drifting(held)], NOMINAL)
    assert [(f.id, f.channel) for f in faults] == [("clock_drift", "steering, throttle")]
    for repaired, true in ((fit[0], clean), (out[0], held)):
        last = repaired.ticks - 20
        before = np.abs(drifting(true).sent[last - 300 : last] - true.sent[last - 300 : last]).mean()
        after = np.abs(repaired.sent[last - 300 : last] - true.sent[last - 300 : last]).mean()
        assert after < 0.4 * before


def test_spikes_of_a_wrapped_angle_are_replaced(circling):
    clean = circling
    raw = np.gradient(clean.states[:, YAW], clean.times_s)
    is_spike = np.abs(raw) > 40.0
    assert is_spike.sum() >= 8

    def change(states):
        states[is_spike, RATE] = raw[is_spike]

    (fit,), _, faults = check([with_states(clean, change)], [], NOMINAL)
    assert [(f.id, f.channel) for f in faults] == [("yaw_wrap_spikes", "yaw_rate")]
    assert faults[0].rows >= is_spike.sum()
    np.testing.assert_allclose(fit.states[:, RATE], clean.states[:, RATE], atol=0.3)


def test_poses_of_another_marker_are_interpolated(clean):
    rng = np.random.default_rng(0)
    rows = np.sort(rng.choice(np.arange(20, len(clean.states) - 20, 6), 15, replace=False))

    def change(states):
        states[rows, :2] += rng.uniform(0.08, 0.5, (15, 2))

    (fit,), _, faults = check([with_states(clean, change)], [], NOMINAL)
    assert channels_of(faults, "outliers") == ["x, y, yaw"]
    assert len(faults) == 1
    assert faults[0].rows == 15
    assert "segment" not in fit.extra
    np.testing.assert_allclose(fit.states[:, :2], clean.states[:, :2], atol=0.01)


def test_lost_tracking_cuts_the_recording(clean):
    def change(states):
        states[900:, X] += 3.0

    (fit,), _, faults = check([with_states(clean, change)], [], NOMINAL)
    assert channels_of(faults, "outliers") == ["x, y, yaw"]
    assert np.flatnonzero(np.diff(fit.extra["segment"])).tolist() == [899]


def test_repeated_rows_are_interpolated(clean):
    stale = np.zeros(len(clean.states), dtype=bool)
    source = np.arange(len(stale))
    for first, run in zip(range(300, 1900, 60), [1, 2, 3, 4] * 10, strict=False):
        source[first : first + run] = first - 1
        stale[first : first + run] = True
    (fit,), _, faults = check([replace(clean, states=clean.states[source])], [], NOMINAL)
    (fault,) = faults
    assert fault.id == "stale_samples"
    assert 0.9 * stale.sum() <= fault.rows <= stale.sum()  # the car stands at times
    error = np.abs(fit.states - clean.states)[stale]
    assert np.median(error[:, :2]) < 2e-3
    assert error[:, :2].max() < 0.03
    np.testing.assert_array_equal(fit.states[~stale], clean.states[~stale])


def test_missing_rows_are_counted_and_long_gaps_cut(clean):
    keep = np.ones(len(clean.states), dtype=bool)
    keep[300:306] = keep[700] = keep[1200:1208] = False
    (fit,), _, faults = check([without_rows(clean, ~keep)], [], NOMINAL)
    assert [(f.id, f.rows) for f in faults] == [("dropouts", 15)]
    assert np.flatnonzero(np.diff(fit.extra["segment"])).tolist() == [299, 1192]


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("ns", 1e9)])
def test_stamps_in_another_unit_are_converted(clean, unit, factor):
    (fit,), _, faults = check([replace(clean, times_s=clean.times_s * factor)], [], NOMINAL)
    assert [(f.id, f.channel) for f in faults] == [("wrong_unit", "t")]
    assert f" {unit} " in faults[0].action
    np.testing.assert_allclose(fit.times_s, clean.times_s, rtol=1e-12)


def test_yaw_in_degrees_and_positions_in_millimetres_are_converted(clean):
    def change(states):
        states[:, YAW] = np.rad2deg(states[:, YAW])

    (fit,), _, faults = check([with_states(clean, change)], [], NOMINAL)
    assert ("wrong_unit", "yaw") in [(f.id, f.channel) for f in faults]
    np.testing.assert_allclose(fit.states, clean.states, atol=1e-9)

    def millimetres(states):
        states[:, :2] *= 1e3

    (fit,), _, faults = check([with_states(clean, millimetres)], [], NOMINAL)
    assert [(f.id, f.channel) for f in faults] == [("wrong_unit", "x, y")]
    np.testing.assert_allclose(fit.states, clean.states, atol=1e-9)


def test_velocity_columns_reveal_clock_jitter_of_even_stamps():
    """Backward-difference velocities, as in a public data set, determine the true periods."""
    fine = Car(seed=12, rate_hz=500.0, seconds=90.0).drive()
    rng = np.random.default_rng(2)
    steps = np.where(rng.random(2500) < 0.06, 20, 17)  # 34 or 40 ms
    rows = np.cumsum(steps)
    rows = rows[rows < len(fine.states) - 1]
    true_s = fine.times_s[rows]
    pose = fine.states[rows, :3]
    pose[:, :2] += rng.normal(size=(len(rows), 2)) * 1e-5
    yaw = np.unwrap(pose[:, 2])
    velocity = np.diff(pose[:, :2], axis=0, prepend=pose[:1, :2]) / np.diff(true_s, prepend=true_s[0] - 0.034)[:, None]
    rate = np.diff(yaw, prepend=yaw[0]) / np.diff(true_s, prepend=true_s[0] - 0.034)
    middle = yaw - 0.5 * np.diff(yaw, prepend=yaw[0])
    c, s = np.cos(middle), np.sin(middle)
    ahead, left = c * velocity[:, 0] + s * velocity[:, 1], c * velocity[:, 1] - s * velocity[:, 0]
    sent = fine.sent[rows[:-1]]
    episode = replace(
        fine,
        times_s=np.arange(len(rows)) * 0.034,
        states=np.column_stack([pose, ahead, left, rate]),
        sent=sent,
        requested=sent,
        rewards=np.full(len(sent), np.nan),
    )
    (fit,), _, faults = check([episode], [], NOMINAL)
    assert {(f.id, f.channel) for f in faults} == {("clock_drift", "t"), ("column_shift", "vx, vy, yaw_rate")}
    drift = (true_s - true_s[0]) - episode.times_s
    remaining_drift = (true_s - true_s[0]) - (fit.times_s - fit.times_s[0])
    assert np.abs(drift).max() > 0.5
    assert np.abs(remaining_drift).max() < 0.2 * np.abs(drift).max()
    # The repaired velocities are centred: they have no delay of half a row.
    np.testing.assert_allclose(fit.states[50:-50, VX], fine.states[rows, VX][50:-50], atol=0.25)


def test_short_recordings_are_unchanged(clean):
    short = without_rows(clean, np.arange(len(clean.states)) >= 30)
    parked = with_states(clean, lambda states: states.__setitem__(slice(None), states[0]))
    fit, _, faults = check([short, parked], [], NOMINAL)
    assert fit[0] is short
    assert fit[1] is parked
    assert faults == []


def test_too_coarse_integration_step_is_reported(clean):
    assert check_integration([clean], NOMINAL) == []
    # With a 24th of the yaw inertia the steps are shorter. With a 600th the shortest step is unstable.
    light = replace(NOMINAL, priors={}).with_values({"vehicle.yaw_inertia": 0.0025})
    assert check_integration([clean], light) == []
    stiff = light.with_values({"vehicle.yaw_inertia": 0.0001})
    found = check_integration([clean], stiff)
    assert "yaw_rate" in {f.channel for f in found}
    assert {f.id for f in found} == {"integration_error"}
    assert all(f.action.startswith("reported") for f in found)


def test_held_values_are_averaged_and_a_lag_has_its_own_delay_only():
    t = np.array([0.0, 1.0, 2.0, 3.0])
    means = held_means(t, np.array([1.0, 5.0, 2.0, 7.0]), np.array([0.5, 1.0, 2.9]), 1.0)
    np.testing.assert_allclose(means, [3.0, 5.0, 0.1 * 2.0 + 0.9 * 7.0])
    grid = np.arange(0.0, 20.0, 0.03)
    followed = first_order_lag(grid, 0.03, 0.2)
    np.testing.assert_allclose((grid - followed)[200:], 0.2, atol=1e-6)


class TestRepairedImport:
    def test_import_repairs_degrees_and_a_gap(self, clean, tmp_path):
        keep = np.ones(len(clean.states), dtype=bool)
        keep[500:520] = False
        states = clean.states[keep].copy()
        states[:, YAW] = np.rad2deg(states[:, YAW])
        write_csv(without_rows(clean, ~keep, states), tmp_path / "drive.csv")
        with pytest.raises(RefusedError):
            import_csv(tmp_path / "drive.csv")
        read = import_repaired(tmp_path / "drive.csv")
        assert {f.id for f in read.repaired} == {"wrong_unit", "dropouts"}
        episode = read.episode
        np.testing.assert_allclose(np.cos(episode.states[:, YAW]), np.cos(clean.states[keep, YAW]), atol=1e-6)
        assert np.ptp(episode.extra["segment"]) == 1

    def test_what_has_no_safe_remedy_is_refused_as_before(self, clean, tmp_path):
        write_csv(with_sent(clean, lambda sent: np.multiply(sent, 30.0, out=sent)), tmp_path / "drive.csv")
        with pytest.raises(DataError, match="say what full command is"):
            import_repaired(tmp_path / "drive.csv")
