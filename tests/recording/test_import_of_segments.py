"""The column ``segment`` of a recording numbers the parts between gaps; a column of a file keeps its own values."""

import foreign_drive as foreign
import numpy as np
import pytest

from carlab.recording.csv.export import write_csv
from carlab.recording.csv.foreign import import_csv
from carlab.recording.layouts import CANONICAL

KEEP = CANONICAL.with_options(gaps="keep")
SPLIT = CANONICAL.with_options(gaps="split")
LAPS = np.repeat([3.0, 4.0], [200, 670])


@pytest.fixture
def with_gap():
    """30 s at 30 Hz with a gap of 1 s after row 400, and the number of the lap in the column ``segment``."""
    rows = np.r_[0:400, 430:900]
    drive = foreign.drive(np.arange(900) / 30.0)
    return {**{name: column[rows] for name, column in drive.items()}, "segment": LAPS}


def test_column_of_the_file_gets_another_name(with_gap, tmp_path):
    path = foreign.write(tmp_path / "run.csv", with_gap)
    imported = import_csv(path, mapping=KEEP)
    np.testing.assert_array_equal(imported.episode.extra["segment_of_file"], LAPS)
    np.testing.assert_array_equal(imported.episode.extra["segment"], np.repeat([0.0, 1.0], [400, 470]))
    (finding,) = imported.report.of("renamed_column", "segment")
    assert "renamed 'segment_of_file'" in finding.sentence
    first, second = import_csv(path, mapping=SPLIT).episodes
    np.testing.assert_array_equal(first.extra["segment_of_file"], LAPS[:400])
    np.testing.assert_array_equal(second.extra["segment_of_file"], LAPS[400:])
    assert "segment" not in first.extra


def test_free_name_is_chosen(with_gap, tmp_path):
    path = foreign.write(tmp_path / "run.csv", {**with_gap, "segment_of_file": np.arange(870.0)})
    extra = import_csv(path, mapping=KEEP).episode.extra
    np.testing.assert_array_equal(extra["segment_of_file"], np.arange(870.0))
    np.testing.assert_array_equal(extra["segment_of_file_"], LAPS)


def test_exported_recording_is_imported_with_the_same_columns(with_gap, tmp_path):
    first = import_csv(foreign.write(tmp_path / "run.csv", with_gap), mapping=KEEP).episode
    write_csv(first, tmp_path / "export.csv")
    second = import_csv(tmp_path / "export.csv", mapping=KEEP)
    assert not second.report.of("renamed_column")
    assert set(second.episode.extra) == set(first.extra) == {"segment", "segment_of_file"}
    for name, column in first.extra.items():
        np.testing.assert_array_equal(second.episode.extra[name], column)
