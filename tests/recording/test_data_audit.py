"""The audit finds injected faults and proposes the option that repairs them."""

import json
import math

import foreign_drive as foreign
import numpy as np
import pytest

from carlab.core.angles import wrap
from carlab.recording.audit.report import Finding, RefusedError, Severity
from carlab.recording.csv.foreign import import_csv
from carlab.recording.faults.fault import Fault
from carlab.recording.faults.pose import rows_off_path
from carlab.recording.layouts import CANONICAL, ETH
from carlab.recording.pose_velocity import pose_jumps

RNG = np.random.default_rng(5)
UNEVEN = np.arange(1200) / 40.0 + RNG.uniform(-0.002, 0.002, 1200)


@pytest.fixture(scope="module")
def clean():
    """A drive with measurement noise on pose and velocities."""
    columns = foreign.drive(UNEVEN)
    rng = np.random.default_rng(6)
    noise = {"x": 3e-4, "y": 3e-4, "yaw": 2e-3, "vx": 0.01, "vy": 0.01, "yaw_rate": 0.03}
    return {
        name: column + rng.normal(0.0, noise.get(name, 0.0) or 1e-12, len(column)) for name, column in columns.items()
    }


def warnings_of(report):
    return {(f.id, f.channel): f for f in report.findings if f.severity >= Severity.WARNING}


def import_drive(tmp_path, drive, **options):
    return import_csv(foreign.write(tmp_path / "run.csv", drive), mapping=CANONICAL.with_options(**options))


def test_clean_recording_has_no_warning(clean, tmp_path):
    report = import_drive(tmp_path, clean).report
    assert warnings_of(report) == {}
    (steering,) = report.of("command_delay", "steering")
    assert steering.evidence["delay_s"] == pytest.approx(foreign.DELAY_S, abs=0.03)
    (throttle,) = report.of("command_delay", "throttle")
    assert throttle.evidence["delay_s"] == pytest.approx(foreign.DELAY_S, abs=0.03)
    assert json.loads(json.dumps(report.to_dict()))["schema"] == "carlab.audit/1"
    assert len(report.rows()) == len(report.findings)


def test_pose_that_stands_still_is_a_warning(clean, tmp_path):
    rng = np.random.default_rng(7)
    at_rest = {name: rng.normal(0.0, 3e-4, len(UNEVEN)) for name in ("x", "y", "yaw")}
    report = import_drive(tmp_path, {**clean, **at_rest}).report
    (finding,) = report.of("standing_pose", "x, y, yaw")
    assert finding.severity is Severity.WARNING
    assert "in only 0 of 1196 rows" in finding.sentence
    assert "check that x, y and yaw are those of the car" in finding.sentence
    assert not report.of("too_little_motion")


def test_straight_drive_is_no_standing_pose(clean, tmp_path):
    straight = {"x": UNEVEN, "y": 0.0 * UNEVEN, "yaw": 0.0 * UNEVEN}
    report = import_drive(tmp_path, {**clean, **straight}).report
    (finding,) = report.of("too_little_motion")
    assert finding.severity is Severity.INFO
    assert finding.sentence.startswith("The car always moves in one direction: unit and sign of yaw")
    assert not report.of("standing_pose")


@pytest.mark.parametrize("rate_hz", [30, 100, 120])
@pytest.mark.parametrize("count", range(1, 13))
def test_rows_off_the_path_are_single_rows_or_left_to_the_jumps(rate_hz, count):
    """One wrong row is found; a run of wrong rows is a pair of jumps, whatever its length."""
    t_s = np.arange(20 * rate_hz) / rate_hz
    circle = np.column_stack([2.0 * np.cos(t_s), 2.0 * np.sin(t_s), t_s + 0.5 * np.pi])
    pose = circle + 3e-4 * np.random.default_rng(count).normal(size=circle.shape)
    pose[300 : 300 + count, 0] += 0.5
    found = np.flatnonzero(rows_off_path(t_s, pose))
    if count == 1:
        assert found.tolist() == [300]
    else:
        assert set(found) <= set(range(296, 304 + count))
        assert {300, 300 + count} <= set(pose_jumps(t_s, *pose.T).tolist())


@pytest.mark.parametrize(
    ("fault", "finding", "options"),
    [
        (lambda c: {"steering": -c["steering"]}, ("wrong_sign", "steering"), {"columns": {"steering": {"sign": -1}}}),
        (lambda c: {"throttle": -c["throttle"]}, ("wrong_sign", "throttle"), {"columns": {"throttle": {"sign": -1}}}),
        (lambda c: {"yaw_rate": -c["yaw_rate"]}, ("wrong_sign", "yaw_rate"), {"columns": {"yaw_rate": {"sign": -1}}}),
        (lambda c: {"vx": -c["vx"]}, ("wrong_sign", "vx"), {"columns": {"vx": {"sign": -1}}}),
        (
            lambda c: {"yaw_rate": 1.4 * c["yaw_rate"]},
            ("column_scale", "yaw_rate"),
            {"columns": {"yaw_rate": {"scale": 0.714}}},
        ),
        (
            lambda c: {"vx": 0.9 * c["vx"], "vy": 0.9 * c["vy"]},
            ("column_scale", "vx, vy"),
            {"columns": {"vx": {"scale": 1.111}, "vy": {"scale": 1.111}}},
        ),
        (
            lambda c: {"vx": np.cos(c["yaw"]) * c["vx"], "vy": np.sin(c["yaw"]) * c["vx"]},
            ("wrong_frame", "vx, vy"),
            {"velocity_frame": "world"},
        ),
        (
            lambda c: {"yaw": -c["yaw"], "yaw_rate": -c["yaw_rate"]},
            ("wrong_sign", "yaw"),
            {"columns": {"yaw": {"sign": -1}, "yaw_rate": {"sign": -1}}},
        ),
        (lambda c: {"x": c["y"], "y": c["x"]}, ("wrong_frame", "yaw"), {"swap_xy": True}),
        (lambda c: {"vx": 0 * c["vx"], "vy": 0 * c["vy"]}, ("column_scale", "vx, vy"), {"velocities": "pose"}),
        (lambda c: {"yaw": c["yaw"] - 0.8}, ("wrong_frame", "yaw"), {"yaw_offset_rad": 0.8}),
        (lambda c: {"yaw": c["yaw"] - 2.5}, ("wrong_frame", "yaw"), {"yaw_offset_rad": 2.5}),
        (lambda c: {"yaw": c["yaw"] + np.pi}, ("wrong_frame", "yaw"), {"yaw_offset_rad": np.pi}),
    ],
    ids=[
        "steering sign",
        "throttle sign",
        "yaw rate sign",
        "vx sign",
        "gyro scale",
        "speed scale",
        "world frame",
        "clockwise yaw",
        "swapped axes",
        "zero speed",
        "yaw offset",
        "yaw of another axis",
        "yaw to the rear",
    ],
)
def test_fault_is_found_and_repaired_by_its_option(clean, fault, finding, options, tmp_path):
    columns = {**clean, **fault(clean)}
    report = import_drive(tmp_path, columns).report
    assert finding in warnings_of(report)
    assert warnings_of(report)[finding].option.startswith("--")
    repaired = import_drive(tmp_path, columns, **options)
    assert warnings_of(repaired.report) == {}
    truth = foreign.drive(UNEVEN)
    np.testing.assert_allclose(repaired.episode.states[:, 3], truth["vx"], atol=0.1)
    found, true = repaired.episode.states[:, 5], truth["yaw_rate"]
    if "velocities" in options:  # from three poses; the mean of three rows is from five poses
        found, true = (np.convolve(rate, np.full(3, 1.0 / 3.0), mode="valid") for rate in (found, true))
    np.testing.assert_allclose(found, true, atol=0.2)


@pytest.mark.parametrize(
    ("options", "finding", "proposed"),
    [
        ({"columns": {"steering": {"sign": -1}}}, ("wrong_sign", "steering"), "--steering-sign 1"),
        ({"columns": {"throttle": {"sign": -1}}}, ("wrong_sign", "throttle"), "--throttle-sign 1"),
        ({"columns": {"vx": {"sign": -1}}}, ("wrong_sign", "vx"), "--vx-sign 1"),
        ({"columns": {"yaw": {"sign": -1}}}, ("wrong_sign", "yaw"), "--yaw-sign 1"),
        ({"swap_xy": True}, ("wrong_frame", "yaw"), "--no-swap-xy"),
    ],
    ids=["steering sign", "throttle sign", "vx sign", "yaw sign", "swap"],
)
def test_wrong_option_of_the_import_is_withdrawn_by_the_proposed_one(clean, options, finding, proposed, tmp_path):
    """An option replaces the declared sign, scale or swap: the same option again would change nothing."""
    found = warnings_of(import_drive(tmp_path, clean, **options).report)[finding]
    assert found.option == proposed
    assert proposed in found.sentence


@pytest.mark.parametrize(("largest", "declared", "proposed"), [(1.0, 5.0, 1.0), (40.0, 0.05, 0.025)])
def test_proposed_command_scale_replaces_the_declared_one(clean, largest, declared, proposed, tmp_path):
    columns = {**clean, "steering": largest * clean["steering"] / np.abs(clean["steering"]).max()}
    with pytest.raises(RefusedError) as refusal:
        import_drive(tmp_path, columns, columns={"steering": {"scale": declared}})
    option, scale = refusal.value.findings[0].option.split()
    assert option == "--steering-scale"
    assert float(scale) == pytest.approx(proposed, rel=0.01)


def test_proposed_scale_contains_the_declared_scale_and_unit(clean, tmp_path):
    columns = {**clean, "yaw_rate": 0.5 * clean["yaw_rate"], "vx": 360 * clean["vx"], "vy": 360 * clean["vy"]}
    declared = {"yaw_rate": {"scale": 4.0}, "vx": {"unit": "km/h"}, "vy": {"unit": "km/h"}}
    warnings = warnings_of(import_drive(tmp_path, columns, columns=declared).report)
    options = f"{warnings['column_scale', 'yaw_rate'].option} {warnings['wrong_unit', 'vx, vy'].option}".split()
    scales = dict(zip(options[::2], (float(value) for value in options[1::2]), strict=True))
    assert scales == pytest.approx({"--yaw-rate-scale": 2.0, "--vx-scale": 0.01, "--vy-scale": 0.01}, rel=0.01)


@pytest.mark.parametrize("offset_rad", [0.8, 1.57, 2.5, 3.14159, -1.2, -2.9])
@pytest.mark.parametrize("declared_rad", [0.0, 0.4])
def test_options_for_another_axis_of_yaw_lead_to_its_angle_and_accuse_no_other_column(
    clean, offset_rad, declared_rad, tmp_path
):
    """Within 30 degrees of the rear, the car seems to slip in reverse gear; the second import shows the rear."""
    columns = {**clean, "yaw": clean["yaw"] - offset_rad}
    found_rad = declared_rad
    for _ in range(2):
        warnings = warnings_of(import_drive(tmp_path, columns, yaw_offset_rad=found_rad).report)
        if warnings:
            assert list(warnings) == [("wrong_frame", "yaw")]
            option, value = warnings["wrong_frame", "yaw"].option.split()
            assert option == "--yaw-offset"
            found_rad = float(value)
    assert abs(wrap(found_rad - offset_rad)) < math.radians(10.0)


def test_clockwise_yaw_accuses_no_other_column(clean, tmp_path):
    report = import_drive(tmp_path, {**clean, "yaw": -clean["yaw"]}).report
    assert list(warnings_of(report)) == [("wrong_sign", "yaw")]
    assert report.of("unchecked")


def test_suspected_fault_is_reported_but_not_repaired(clean, tmp_path):
    columns = {**clean, "steering": -clean["steering"]}
    np.testing.assert_array_equal(import_drive(tmp_path, columns).episode.sent[:, 0], -clean["steering"][:-1])


@pytest.mark.parametrize("cut", [0.0, np.pi])
def test_spikes_of_a_differentiated_wrapped_angle_are_found_and_repaired(clean, cut, tmp_path):
    """A logger differentiates an angle with a branch cut at ``cut``: the rate there is off by 2 pi / period."""
    angle = (foreign.yaw(UNEVEN) - cut) % (2 * np.pi)
    logged_rate = np.diff(angle, prepend=angle[0]) / np.diff(UNEVEN, prepend=UNEVEN[0] - 0.025)
    truth = foreign.yaw_rate(UNEVEN)
    spike_rows = np.flatnonzero(np.abs(logged_rate - truth) > 50)
    assert len(spike_rows) >= 3
    columns = {**clean, "yaw_rate": logged_rate}
    imported = import_drive(tmp_path, columns)
    (finding,) = imported.report.of("yaw_wrap_spikes", "yaw_rate")
    assert finding.rows == tuple(spike_rows + 1)
    assert finding.severity is Severity.FAULT
    np.testing.assert_array_equal(imported.episode.states[:, 5], logged_rate)
    repaired = import_drive(tmp_path, columns, repair_yaw_rate=True)
    assert repaired.report.of("yaw_wrap_spikes")[0].severity is Severity.REPAIRED
    np.testing.assert_allclose(repaired.episode.states[spike_rows, 5], truth[spike_rows], atol=0.15)
    other_rows = np.setdiff1d(np.arange(len(UNEVEN)), spike_rows)
    np.testing.assert_array_equal(repaired.episode.states[other_rows, 5], logged_rate[other_rows])


def test_lag_of_filtered_velocities_is_estimated(clean, tmp_path):
    delayed_t = UNEVEN - 0.06
    columns = {**clean, "vx": foreign.speed(delayed_t), "yaw_rate": foreign.yaw_rate(delayed_t)}
    report = import_drive(tmp_path, columns).report
    for channel in ("vx, vy", "yaw_rate"):
        (finding,) = report.of("column_shift", channel)
        assert finding.evidence["lag_s"] == pytest.approx(0.06, abs=0.01)
    from_pose = import_drive(tmp_path, columns, velocities="pose").episode
    assert from_pose.metadata["velocity_delay_s"] == "0"
    np.testing.assert_array_equal(from_pose.extra["vx"], columns["vx"])


def test_poses_of_another_body_are_found_and_split_off(clean, tmp_path):
    x, y = clean["x"].copy(), clean["y"].copy()
    x[500:560], y[500:560] = -4.0, 1.0
    imported = import_drive(tmp_path, {**clean, "x": x, "y": y})
    (finding,) = imported.report.of("outliers", "x, y, yaw")
    assert finding.rows == (501, 561)
    assert finding.option == "--gaps split"
    # The velocities are correct up to the rows next to the jump.
    pose_only = import_drive(tmp_path, {**clean, "x": x, "y": y}, velocities="pose").episode
    rows = np.r_[490:500, 560:570]
    np.testing.assert_allclose(pose_only.states[rows, 3], foreign.speed(UNEVEN)[rows], atol=0.1)
    parts = import_drive(tmp_path, {**clean, "x": x, "y": y}, gaps="split").episodes
    assert [part.ticks + 1 for part in parts] == [500, 60, 640]


def test_hard_driving_is_not_a_pose_jump():
    """Accelerations of 20 m/s^2 and 100 rad/s^2, far above those of a tyre, at 30 and at 100 Hz."""
    for rate in (30.0, 100.0):
        t = np.arange(0, 4, 1 / rate)
        x = 5 * np.sin(2 * t)
        yaw = 4 * np.sin(5 * t)
        assert len(pose_jumps(t, x, np.zeros_like(t), yaw)) == 0


def test_columns_with_held_samples_are_found_with_their_rate(tmp_path):
    t = np.arange(3000) / 100.0
    columns = foreign.drive(t)
    held = (np.arange(3000) // 10) * 10
    columns["throttle"] = columns["throttle"][held]
    columns["encoder"] = columns["vx"][held]
    (finding,) = import_drive(tmp_path, columns).report.of("held_samples")
    assert finding.channel == "throttle, encoder"
    assert finding.evidence["rows"] == 10
    assert finding.evidence["rate_hz"] == pytest.approx(10.0, rel=1e-3)
    assert finding.sentence.startswith("New values come only every 10 rows")
    assert "encoder" not in finding.sentence, "the channel of the finding lists the columns"


def test_sentence_that_begins_with_a_column_keeps_its_spelling():
    lag = Fault("column_shift", "vx, vy", "vx, vy lag the differentiated pose by 9 ms")
    assert Finding.of_fault(lag).sentence == "Columns vx, vy lag the differentiated pose by 9 ms."
    spikes = Fault("outliers", "yaw_rate", "yaw_rate has 3 spikes", option="--repair-yaw-rate")
    assert Finding.of_fault(spikes).sentence == "Column yaw_rate has 3 spikes; use --repair-yaw-rate."
    other = Fault("wrong_sign", "steering", "with positive steering the car turns right")
    assert Finding.of_fault(other).sentence == "With positive steering the car turns right."


def test_stamps_that_an_even_clock_replaces_are_not_called_unchanged(clean, tmp_path):
    for clock, is_unchanged in (("column", True), ("even", False)):
        imported = import_drive(tmp_path, clean, clock=clock)
        (jitter,) = imported.report.of("stamp_jitter")
        assert ("does not change the stamps" in jitter.sentence) is is_unchanged
        assert ("stamps of an even clock" in imported.announcement) is not is_unchanged


def test_nominal_clock_over_uneven_rows_is_found_and_rebuilt(tmp_path):
    rng = np.random.default_rng(8)
    step = rng.choice([4, 5], p=[0.9, 0.1], size=1199) / 120.0
    true_t = np.concatenate([[0.0], np.cumsum(step)])
    columns = foreign.drive(true_t)
    for name, axis in (("vx_world", columns["x"]), ("vy_world", columns["y"])):
        columns[name] = np.concatenate([[0.0], np.diff(axis) / step])
    columns["t"] = np.arange(1200) / 30.0
    path = foreign.write(tmp_path / "run.csv", columns)
    report = import_csv(path).report
    assert report.of("nominal_clock")
    (finding,) = report.of("clock_drift")
    assert finding.evidence["mean_s"] == pytest.approx(np.mean(step), rel=0.01)
    rebuilt = import_csv(path, mapping=ETH.with_options(clock="velocity")).episode
    fast = np.abs(foreign.speed(true_t))[1:] > 0.4
    np.testing.assert_allclose(np.diff(rebuilt.times_s)[fast], step[fast], atol=1e-4)


def test_constant_command_and_stale_rows_are_found(clean, tmp_path):
    columns = {name: column.copy() for name, column in clean.items()}
    columns["steering"] = np.full_like(columns["steering"], 0.25)
    for name in ("x", "y", "yaw"):
        columns[name][[600, 601]] = columns[name][599]
    assert np.abs(foreign.speed(UNEVEN[599])) > 0.5
    report = import_drive(tmp_path, columns).report
    assert ("constant_command", "steering") in warnings_of(report)
    (stale,) = report.of("stale_samples")
    assert stale.rows == (601, 602)
