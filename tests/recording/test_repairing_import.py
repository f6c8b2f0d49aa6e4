"""Automatic repair of a CSV with several faults that have the same remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

from carlab.recording.csv.export import write_csv
from carlab.recording.csv.repairing_import import import_repaired
from sim_backends import SimulatorConfig
from tests.helpers.recorded_drives import drive


@pytest.mark.parametrize("cells", [{"steering": ("", "1e30")}, {"steering": ("",), "yaw": ("",)}])
def test_rows_with_missing_and_with_too_large_cells_are_dropped(
    tmp_path: Path, cells: dict[str, tuple[str, ...]]
) -> None:
    """Several faults have one remedy, which is applied once."""
    path = tmp_path / "drive.csv"
    write_csv(drive(SimulatorConfig(), 20.0, seed=0), path)
    header, *lines = path.read_text(encoding="utf-8").splitlines()
    names, rows = header.split(","), [line.split(",") for line in lines]
    row = 100
    for name, values in cells.items():
        for value in values:
            rows[row][names.index(name)] = value
            row += 50
    path.write_text("\n".join([header, *(",".join(r) for r in rows)]) + "\n", encoding="utf-8")
    read = import_repaired(path)
    assert [f.id for f in read.repaired] == ["not_a_number", "not_a_number"]
    assert len(read.episode.times_s) == len(rows) - 2


def test_drives_that_are_years_apart_are_read_as_one_file(tmp_path: Path) -> None:
    """The response to the commands is the same as without the years between the drives."""
    path = tmp_path / "drive.csv"
    write_csv(drive(SimulatorConfig(), 40.0, seed=0), path)
    header, *lines = path.read_text(encoding="utf-8").splitlines()
    column = header.split(",").index("t")
    delays = []
    for gap_s in (10.0, 1.7e9):
        rows = [line.split(",") for line in lines]
        for row in rows[len(rows) // 2 :]:
            row[column] = repr(float(row[column]) + gap_s)
        path.write_text("\n".join([header, *(",".join(r) for r in rows)]) + "\n", encoding="utf-8")
        report = import_repaired(path).report
        assert len(report.of("dropouts")) == 1
        delays.append([finding.evidence["delay_s"] for finding in report.of("command_delay")])
    assert len(delays[0]) == 2
    assert delays[1] == pytest.approx(delays[0], abs=0.01)
