"""The audit finds the known faults of real recordings."""

import numpy as np
import pytest

from carlab.recording.audit.report import Severity
from carlab.recording.csv.export import write_csv
from carlab.recording.csv.foreign import import_csv
from carlab.recording.layouts import CANONICAL, DART, ETH


def test_exported_real_recording_is_read_back_in_the_canonical_layout(shared, tmp_path):
    for path in ("eth_rc_car/train_2.csv.gz", "dart/70_racetrack_lap_v_1_racetrack_lap_v_1.csv.gz"):
        episode = import_csv(shared / "data" / path).episode
        write_csv(episode, tmp_path / "export.csv")
        reimported = import_csv(tmp_path / "export.csv")
        assert reimported.mapping is CANONICAL
        np.testing.assert_array_equal(reimported.episode.states, episode.states)
        np.testing.assert_array_equal(reimported.episode.sent, episode.sent)


class TestRealRecordings:
    """Known properties of the files, determined by hand; see the comments of the presets."""

    @pytest.mark.parametrize(
        ("name", "rows", "n_spikes", "n_spike_rows"), [("train_1", 9029, 14, 22), ("train_2", 3791, 9, 16)]
    )
    def test_eth_recording_has_its_known_faults(self, shared, name, rows, n_spikes, n_spike_rows):
        imported = import_csv(shared / "data" / "eth_rc_car" / f"{name}.csv.gz")
        episode, report = imported.episode, imported.report
        assert imported.mapping is ETH
        assert episode.ticks == rows - 1
        (finding,) = report.of("yaw_wrap_spikes")
        assert (finding.evidence["spikes"], finding.count) == (n_spikes, n_spike_rows)
        assert finding.evidence["share_ccw"] == 1.0
        assert np.abs(episode.states[:, 5]).max() < 12.0
        assert report.of("clock_drift")[0].evidence["mean_s"] == pytest.approx(0.0337, abs=1e-4)
        assert report.of("column_shift", "vx, vy")[0].evidence["rows"] == pytest.approx(0.5, abs=0.1)
        steering = report.of("command_delay", "steering")[0].evidence
        assert steering["correlation"] > 0.6
        assert steering["correlation_yaw_rate_forward"] > 0.6
        assert steering["correlation_yaw_rate_reverse"] < -0.5
        assert report.of("command_delay", "throttle")[0].evidence["gain"] > 5.0
        assert report.worst is Severity.WARNING

    def test_wrong_velocity_frame_is_found_with_both_residuals(self, shared):
        mapping = ETH.with_options(velocity_frame="body", repair_yaw_rate=False)
        report = import_csv(shared / "data" / "eth_rc_car" / "train_1.csv.gz", mapping=mapping).report
        (finding,) = report.of("wrong_frame", "vx, vy")
        assert finding.option == "--velocity-frame world"
        assert finding.evidence["remainder_world_mps"] < 0.1 < finding.evidence["remainder_body_mps"]
        assert report.of("yaw_wrap_spikes")[0].option == "--repair-yaw-rate"

    def test_dart_recordings_have_their_known_faults(self, shared):
        files = sorted((shared / "data" / "dart").glob("*.csv.gz"))
        assert len(files) == 9
        for path in files:
            imported = import_csv(path)
            episode, report = imported.episode, imported.report
            assert np.isfinite(episode.states).all()
            assert np.isfinite(episode.sent).all()
            if path.name.startswith("30_"):
                assert imported.mapping.dead_reckoning
                continue
            assert imported.mapping is DART
            held = report.of("held_samples")[0]
            assert held.evidence["rows"] == 10
            assert "vel encoder" in held.channel
            gyro = report.of("reference_column", "yaw_rate")[0].evidence
            assert gyro["scale"] == pytest.approx(1.03, abs=0.02)
            assert 0.08 < gyro["lag_s"] < 0.11
            assert not report.of("wrong_sign")
            assert not report.of("wrong_frame")
            if not path.name.startswith("81_"):
                assert report.of("command_delay", "steering")[0].evidence["correlation"] > 0.9
            assert bool(report.of("outliers")) == path.name.startswith("70_")
            assert report.worst == (Severity.FAULT if path.name.startswith("70_") else report.worst)

    def test_dart_lap_has_pose_jumps_and_a_frozen_pose(self, shared):
        path = next((shared / "data" / "dart").glob("70_*.csv.gz"))
        report = import_csv(path).report
        (jumps,) = report.of("outliers")
        assert jumps.count == 12
        assert jumps.evidence["largest_m"] == pytest.approx(7.76, abs=0.01)
        (frozen,) = report.of("frozen_pose")
        assert 12.0 < frozen.evidence["seconds"] < 15.0
        assert report.of("gated_throttle")[0].count == 676
        split = import_csv(path, mapping=DART.with_options(gaps="split"))
        parts = split.episodes
        assert sum(part.ticks + 1 for part in parts) + split.report.of("short_part")[0].count == 4831
        for part in parts:
            assert np.abs(part.states[:, 3]).max() < 3.0
