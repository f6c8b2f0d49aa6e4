"""Velocities of imported recordings: which columns are used, and by which clock the pose is differentiated."""

import tracemalloc

import foreign_drive as foreign
import numpy as np
import pytest

from carlab.core.errors import ConfigError
from carlab.recording.audit.report import Severity
from carlab.recording.csv.foreign import import_csv
from carlab.recording.faults import robust
from carlab.recording.layouts import CANONICAL, DART_ONBOARD
from carlab.recording.pose_velocity import pose_motion
from sim_backends.array_ops import FLOATS
from sim_backends.measurement import windowed


@pytest.mark.parametrize("option", [{"velocities": "pose"}, {}])
def test_velocities_from_the_pose_have_the_rebuilt_clock(tmp_path, option):
    """The stamps say 30 Hz, but every fifth row comes 67 ms after the one before."""
    step_s = np.where(np.arange(1499) % 5 == 0, 2.0, 1.0) / 30.0
    true_t = np.concatenate([[0.0], np.cumsum(step_s)])
    columns = foreign.drive(true_t)
    along = np.concatenate([[0.0], np.hypot(np.diff(columns["x"]), np.diff(columns["y"])) / step_s])
    columns["vx"] = np.copysign(along, foreign.speed(true_t))
    del columns["yaw_rate"]
    columns["t"] = np.arange(1500) / 30.0
    path = foreign.write(tmp_path / "run.csv", columns)
    imported = import_csv(path, mapping=CANONICAL.with_options(clock="velocity", **option))
    # Below 0.3 m/s the distance gives no period; compare the rows whose neighbours are all faster.
    rows = np.convolve(np.abs(foreign.speed(true_t)) < 0.4, np.ones(11), mode="same") == 0
    states = imported.episode.states[rows]
    np.testing.assert_allclose(states[5:-5, 5], foreign.yaw_rate(true_t[rows])[5:-5], atol=0.05)
    np.testing.assert_allclose(states[5:-5, 3], foreign.speed(true_t[rows])[5:-5], atol=0.05)
    (finding,) = imported.report.of("clock_drift")
    assert finding.severity is Severity.REPAIRED
    assert finding.option is None


@pytest.mark.parametrize(("present", "absent"), [("vx", "vy"), ("vy", "vx")])
def test_velocity_column_without_the_other_is_kept_as_extra(tmp_path, present, absent):
    t_s = np.arange(900) / 50.0
    columns = foreign.drive(t_s)
    columns["wheel"] = 1.5 * columns.pop("vx")  # a wheel sensor that slips
    del columns["vy"]
    path = foreign.write(tmp_path / "run.csv", columns)
    mapping = CANONICAL.with_options(columns={present: {"name": "wheel"}}, velocity_lag_s=0.02)
    imported = import_csv(path, mapping=mapping)
    np.testing.assert_array_equal(imported.episode.extra["wheel"], columns["wheel"])
    np.testing.assert_allclose(imported.episode.states[5:-5, 3], foreign.speed(t_s)[5:-5], atol=0.05)
    np.testing.assert_array_equal(imported.episode.states[:, 5], columns["yaw_rate"])
    (estimated,) = imported.report.of("estimated_velocity")
    assert estimated.channel == "vx, vy"
    assert f"vx, vy (the file has no {absent}), by a" in estimated.sentence
    (finding,) = imported.report.of("unused_column")
    assert "Column 'wheel' stays an extra column and is not used for the state" in finding.sentence
    assert finding.sentence.endswith(f"the file has no {absent}.")


@pytest.mark.parametrize(
    "option",
    [
        {"swap_xy": True},
        {"yaw_offset_rad": 1.0},
        {"velocity_frame": "world"},
        {"velocity_lag_s": 0.1},
        {"velocities": "pose"},
        {"repair_yaw_rate": True},
    ],
    ids=lambda option: next(iter(option)),
)
def test_option_without_effect_is_refused_for_dead_reckoning(option):
    (name,) = option
    with pytest.raises(ConfigError, match=rf"'dart on-board' has no pose, so {name} has no effect; remove {name}\."):
        DART_ONBOARD.with_options(**option)


def test_dead_reckoning_keeps_vy_as_extra(tmp_path):
    t_s = np.arange(301) / 30.0
    drive = foreign.drive(t_s)
    columns = {source.name: drive[channel] for channel, source in DART_ONBOARD.columns.items()}
    vy = np.sin(t_s)
    path = foreign.write(tmp_path / "run.csv", {**columns, "vy": vy, "safety_value": np.ones(301)})
    episode = import_csv(path, mapping=DART_ONBOARD.with_options(columns={"vy": {"name": "vy"}})).episode
    np.testing.assert_array_equal(episode.extra["vy"], vy)
    np.testing.assert_array_equal(episode.states[:, 4], 0.0)


def test_reference_that_is_not_compared_is_reported(tmp_path):
    columns = foreign.drive(np.arange(900) / 50.0)
    columns["encoder"] = 1.1 * columns["vx"]
    path = foreign.write(tmp_path / "run.csv", columns)

    def findings(name):
        return import_csv(path, mapping=CANONICAL.with_options(references={name: "vx"})).report.of("unused_column")

    for name in ("encodr", "vx"):
        (finding,) = findings(name)
        assert f"Reference '{name}' is not compared with vx" in finding.sentence
    assert not findings("encoder")
    with pytest.raises(ConfigError, match="Unknown key 'steering' in the references of mapping"):
        CANONICAL.with_options(references={"encoder": "steering"})


@pytest.mark.parametrize("rows", [2, 3, 4, 400])
@pytest.mark.parametrize("for_states", [False, True])
def test_velocities_are_slopes_of_local_quadratics(rows, for_states):
    rng = np.random.default_rng(3)
    t_s = np.cumsum(rng.uniform(0.002, 0.03, rows))
    x_m, y_m = rng.normal(size=(2, rows))
    motion = pose_motion(t_s, x_m, y_m, np.zeros(rows), np.zeros(rows), for_states=for_states)
    width = min(2 * motion.half_rows + 1, rows)
    for row in range(rows):
        first = min(max(row - motion.half_rows, 0), rows - width)
        window = slice(first, first + width)
        slope = np.polyfit(t_s[window] - t_s[row], x_m[window], min(2, width - 1))[-2]
        assert motion.vx[row] == pytest.approx(slope, rel=1e-8, abs=1e-8)


@pytest.mark.parametrize("frequency_hz", [0.5, 2.0, 4.0, 7.0])
@pytest.mark.parametrize("rate_hz", [30.0, 40.0, 50.0, 60.0])
def test_measurement_model_describes_velocities_of_poses(rate_hz, frequency_hz):
    """A quadratic through five poses at 30 Hz has less than half of the velocity at 5 Hz; the model predicts more."""
    period_s, omega = 1.0 / rate_hz, 2.0 * np.pi * frequency_hz
    t_s = period_s * np.arange(300)
    zeros = np.zeros(300)
    motion = pose_motion(t_s, np.sin(omega * t_s) / omega, zeros, zeros, zeros, for_states=True)
    states = [(0.0, 0.0, 0.0, v, 0.0, 0.0) for v in np.cos(omega * t_s).tolist()]
    offsets_s = period_s * np.arange(1, motion.half_rows + 1)
    variance_s2 = float(np.sum(offsets_s**4) / (3.0 * np.sum(offsets_s**2)))
    modelled = [
        windowed(FLOATS, now, (before, now, after), period_s, variance_s2)[3]
        for before, now, after in zip(states, states[1:], states[2:], strict=False)
    ]
    inner = slice(motion.half_rows - 1, 1 - motion.half_rows or None)
    np.testing.assert_allclose(motion.vx[1:-1][inner], modelled[inner], atol=0.03)


def test_stamps_that_coincide_but_for_rounding_have_finite_velocities():
    t_s = np.array([0.0, 1e-17, 0.02])
    motion = pose_motion(t_s, np.array([0.0, 0.0, 0.02]), np.zeros(3), np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(motion.vx, 1.0)


def test_velocities_of_a_fast_log_need_little_memory():
    """Of 60 000 rows at 1 kHz, all windows of 101 poses together would take 200 MB."""
    t_s = np.arange(60_000) / 1000.0
    tracemalloc.start()
    motion = pose_motion(t_s, np.sin(t_s), np.cos(t_s), np.unwrap(t_s), np.zeros(len(t_s)))
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_allclose(motion.yaw_rate, 1.0, rtol=1e-9)
    assert peak_bytes < 60e6


def test_fit_of_a_long_column_by_every_kth_row_is_the_same(monkeypatch):
    t_s = np.arange(20_000) / 1000.0
    reference = foreign.yaw_rate(t_s)
    column = 1.1 * np.interp(t_s - 0.05, t_s, reference) + np.random.default_rng(0).normal(0.0, 0.02, len(t_s))

    def fit():
        return robust.fit_column(t_s, reference, column, t_s > 1.0, lags_s=robust.LAGS_S, time_constants_s=(0.0,))

    by_all_rows = fit()
    monkeypatch.setattr(robust, "MAX_FIT_ROWS", 4000)
    by_every_fifth_row = fit()
    assert by_every_fifth_row.scale == pytest.approx(by_all_rows.scale, rel=1e-3)
    assert by_every_fifth_row.lag_s == pytest.approx(by_all_rows.lag_s, abs=3e-3)
    assert by_every_fifth_row.unexplained == pytest.approx(by_all_rows.unexplained, rel=0.1)
    assert by_every_fifth_row.prediction.shape == t_s.shape
    assert by_every_fifth_row.scale != by_all_rows.scale


@pytest.mark.parametrize("rate_hz", [30.0, 100.0])
def test_velocities_from_a_noisy_pose_have_the_expected_error_and_no_delay(rng, rate_hz, tmp_path):
    count = int(25.0 * rate_hz)
    t = (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / rate_hz
    columns = foreign.drive(t)
    for name, std in (("x", 3e-4), ("y", 3e-4), ("yaw", 1e-3)):
        columns[name] = columns[name] + rng.normal(0.0, std, len(t))
    columns["yaw"] = (columns["yaw"] + np.pi) % (2 * np.pi) - np.pi
    assert np.sum(np.abs(np.diff(columns["yaw"])) > 5) >= 2
    for name in ("vx", "vy", "yaw_rate"):
        del columns[name]
    episode = import_csv(foreign.write(tmp_path / "run.csv", columns)).episode
    inner = slice(5, -5)
    truth = np.column_stack([foreign.speed(t), np.zeros_like(t), foreign.yaw_rate(t)])
    error = (episode.states[:, 3:] - truth)[inner]
    # Slope of a least-squares line through W samples at spacing dt: std * sqrt(12 / (W (W^2 - 1))) / dt.
    width = 3 if rate_hz == 30.0 else 7
    gain = np.sqrt(12 / (width * (width**2 - 1))) * rate_hz
    assert np.std(error[:, 0]) < 1.5 * 3e-4 * gain + 0.002
    assert np.std(error[:, 2]) < 1.5 * 1e-3 * gain + 0.002
    assert np.abs(error).max() < 0.2
    # A delayed estimate correlates with the derivative of the true velocity.
    delay_s = np.dot(error[:, 0], foreign.acceleration(t)[inner]) / np.sum(foreign.acceleration(t)[inner] ** 2)
    assert abs(delay_s) < 2e-3
    assert "no delay" in episode.metadata["velocity_source"]
    assert episode.metadata["velocity_delay_s"] == "0"
