"""Summary pictures of episodes, and export to CSV and Parquet."""

import csv
import dataclasses
import gzip
import json
import math

import numpy as np
import pyarrow.parquet as pq
import pytest
from matplotlib.image import imread

from carlab.api.recordings import Recording
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.recording.atomic_files import write_text
from carlab.recording.csv.export import table_of, write_csv, write_parquet
from carlab.recording.episode_builder import episode_from_documents, goal_of, polygon_of
from carlab.recording.picture import outline, save_summary
from tests.helpers.episode_documents import make_documents


@pytest.fixture
def episode():
    return episode_from_documents(make_documents(60))


def test_outline_has_the_size_and_heading_of_the_car():
    shape = outline(1.0, 2.0, math.pi / 2)
    nose = shape[np.argmax(shape[:, 1])]
    np.testing.assert_allclose(nose, (1.0, 2.21), atol=1e-12)
    np.testing.assert_allclose(np.ptp(shape, axis=0), (0.19, 0.42), atol=1e-12)
    np.testing.assert_array_equal(shape[0], shape[-1])


def test_picture_shows_the_goal_only_if_the_metadata_has_one(tmp_path, episode):
    save_summary([episode], tmp_path / "one.png")
    pixels = imread(tmp_path / "one.png")[:, :, :3]
    assert pixels.shape[1] > 1200
    goal_green = (np.abs(pixels - np.array([0, 158, 115]) / 255) < 0.06).all(axis=2)
    assert goal_green.sum() > 100
    without_metadata = dataclasses.replace(episode, metadata={})
    save_summary([without_metadata], tmp_path / "bare.png", "No surroundings")
    plan = imread(tmp_path / "bare.png")[:, : pixels.shape[1] // 2, :3]
    assert not (np.abs(plan - np.array([0, 158, 115]) / 255) < 0.02).all(axis=2).sum() > 100


def test_legend_has_the_limits_of_a_task(tmp_path, episode):
    discs = json.dumps([[[0.0, 0.0], [0.1, 0.0], [0.1, 0.1]], [[1.0, 0.0], [1.1, 0.0], [1.1, 0.1]]])
    limited = dataclasses.replace(episode, metadata={**episode.metadata, "outlines_m": discs})
    for data, count in ((episode, 0), (limited, 1)):
        save_summary([data], tmp_path / "drive.svg")
        assert (tmp_path / "drive.svg").read_text().count("<!-- limit -->") == count


@pytest.mark.parametrize("count", [2, 12])
def test_picture_of_several_episodes_accepts_missing_data(tmp_path, episode, count):
    incomplete = dataclasses.replace(
        episode,
        rewards=np.full(episode.ticks, np.nan),
        requested=np.full_like(episode.requested, np.nan),
        metadata={},
        extra={},
    )
    save_summary([episode] * (count - 1) + [incomplete], tmp_path / "many.svg", "Many")
    assert (tmp_path / "many.svg").read_text().startswith("<?xml")
    save_summary([incomplete], tmp_path / "odd.png")


@pytest.mark.parametrize("name", ["x.png", "x.csv", "x.csv.gz", "x.parquet", "x.mcap", "x.rrd"])
def test_saved_recording_gets_its_folder(tmp_path, episode, name):
    path = Recording(tmp_path / "0001.mcap", (episode,)).save(tmp_path / "new" / "folder" / name)
    assert path.stat().st_size > 100


def test_picture_or_table_that_cannot_be_written_is_reported(tmp_path, episode):
    with pytest.raises(DataError, match="no episode"):
        save_summary([], tmp_path / "x.png")
    with pytest.raises(DataError, match=r"use \.png"):
        save_summary([episode], tmp_path / "x.docx")
    with pytest.raises(DataError, match="its folder does not exist; create the folder or choose another one"):
        write_text(tmp_path / "nowhere" / "x.json", "{}")
    (tmp_path / "file").touch()
    for write in (write_csv, write_parquet, lambda episode, path: save_summary([episode], path.with_suffix(".png"))):
        with pytest.raises(DataError, match="a file has the path of its folder"):
            write(episode, tmp_path / "file" / "x")


def test_goal_and_arena_are_read_from_the_metadata(episode):
    assert goal_of(episode.metadata) == (0.0, 0.0, math.pi)
    np.testing.assert_array_equal(polygon_of(episode.metadata, "arena_m")[2], (2.8, 1.5))
    assert goal_of({}) is None
    assert polygon_of({}, "path_m").shape == (0, 2)


def test_csv_has_the_documented_columns_with_exact_numbers(tmp_path, episode):
    write_csv(episode, tmp_path / "episode.csv")
    with (tmp_path / "episode.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert header[:9] == ["t", "x", "y", "yaw", "vx", "vy", "yaw_rate", "steering", "throttle"]
    assert {"requested_steering", "reward", "pose_age_s", "late_s"} <= set(header)
    assert len(rows) == 61
    columns = {name: [row[k] for row in rows] for k, name in enumerate(header)}
    np.testing.assert_array_equal([float(v) for v in columns["t"]], episode.times_s)
    np.testing.assert_array_equal([float(v) for v in columns["yaw_rate"]], episode.states[:, 5])
    np.testing.assert_array_equal([float(v) for v in columns["steering"][:-1]], episode.sent[:, 0])
    assert columns["steering"][-1] == columns["steering"][-2]  # nothing was sent after the last row
    assert columns["reward"][-1] == ""
    assert columns["requested_throttle"][2] == ""
    assert list(tmp_path.iterdir()) == [tmp_path / "episode.csv"]


def test_compressed_csv_has_the_same_text_and_reproducible_bytes(tmp_path, episode):
    write_csv(episode, tmp_path / "plain.csv")
    write_csv(episode, tmp_path / "a.csv.gz")
    write_csv(episode, tmp_path / "b.csv.gz")
    assert gzip.decompress((tmp_path / "a.csv.gz").read_bytes()) == (tmp_path / "plain.csv").read_bytes()
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()


def test_parquet_contains_units_and_metadata(tmp_path, episode):
    write_parquet(episode, tmp_path / "episode.parquet")
    table = pq.read_table(tmp_path / "episode.parquet")
    units = {field.name: field.metadata[b"unit"].decode() for field in table.schema}
    assert (units["t"], units["yaw_rate"], units["throttle"], units["pose_age_s"]) == ("s", "rad/s", "1", "s")
    assert json.loads(table.schema.metadata[b"carlab"]) == dict(episode.metadata)
    np.testing.assert_array_equal(table["vy"].to_numpy(), episode.states[:, 4])
    assert table.column_names == list(table_of(episode))


def test_extra_column_does_not_replace_a_standard_one(episode):
    table = table_of(dataclasses.replace(episode, extra={"yaw": np.ones(61)}))
    np.testing.assert_array_equal(table["yaw"], episode.states[:, 2])
    np.testing.assert_array_equal(table["extra_yaw"], np.ones(61))


def test_extra_columns_do_not_replace_each_other(episode):
    extra = {"extra_yaw": np.full(61, 2.0), "yaw": np.full(61, 1.0)}
    table = table_of(dataclasses.replace(episode, extra=extra))
    assert {float(column[0]) for name, column in table.items() if name.startswith("extra_")} == {1.0, 2.0}


@pytest.mark.parametrize(
    ("write", "name"), [(write_csv, "x.csv"), (write_csv, "x.csv.gz"), (write_parquet, "x.parquet")]
)
def test_export_that_fails_leaves_no_file(tmp_path, episode, write, name):
    (tmp_path / name).mkdir()
    with pytest.raises(DataError, match=f"{name} could not be written: Is a directory"):
        write(episode, tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_episode_is_printed_in_one_line() -> None:
    """Its arrays would fill pages of a Python session."""
    states = np.zeros((91, 6))
    commands = np.zeros((90, 2))
    episode = EpisodeData(np.arange(91) / 30.0, states, commands, commands, np.zeros(90))
    assert repr(episode) == "<EpisodeData: 90 commands in 3.0 s>"
