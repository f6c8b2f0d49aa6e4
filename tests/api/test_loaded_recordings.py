"""Faults of CSV files that a diagnosis reports."""

from __future__ import annotations

from pathlib import Path

from carlab.api.loaded_recordings import load_recordings
from carlab.recording.csv.export import write_csv
from sim_backends.car_parameters import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive


def test_rows_that_are_left_out_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "drive.csv"
    write_csv(drive(SimulatorConfig(control_period_s=PERIOD_S), 10.0, 1), path)
    header, *lines = path.read_text(encoding="utf-8").splitlines()
    cells = lines[100].split(",")
    lines[100] = ",".join([cells[0], "", *cells[2:]])
    lines[200:200] = lines[190:200]
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
    loaded = load_recordings([path], "fit", 0.0)
    assert [(f.id, f.channel, f.rows) for f in loaded.faults] == [("not_a_number", "x", 1), ("stamp_order", "t", 10)]
    assert all("were left out" in f.action for f in loaded.faults)
    assert loaded.episodes[0].ticks == 299
