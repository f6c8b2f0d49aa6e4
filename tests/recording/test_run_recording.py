"""A run as one rerun recording, read back with the reader of rerun."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from carlab.core.documents import EpisodeStarted
from carlab.core.quantities import STATE_NAMES
from carlab.recording.atomic_files import rerun_file
from carlab.recording.episode_builder import episode_from_documents
from carlab.recording.rerun.blueprint import send_blueprint
from carlab.recording.rerun.run_recording import PAUSE_S, RunRecording
from tests.helpers.episode_documents import make_documents
from tests.helpers.rerun_files import cells, tabs, views

TICKS = 12
WINDOW = np.array([[1, 2, 3]])


def numbered(documents, number):
    first, *others = documents
    assert isinstance(first, EpisodeStarted)
    return [dataclasses.replace(first, episode=number), *others]


@pytest.fixture(scope="module")
def mean_and_std():
    rng = np.random.default_rng(0)
    return rng.normal(size=(1, 3, 6)), rng.uniform(0.1, 1.0, (1, 3, 6))


@pytest.fixture
def run_file(tmp_path: Path, mean_and_std) -> Path:
    """Two episodes; the second has predictions, figures and a check."""
    documents = make_documents(TICKS)
    with rerun_file(tmp_path / "run.rrd") as stream:
        recording = RunRecording(stream, 2)
        for number in (1, 2):
            for document in numbered(documents, number):
                recording.write(document)
        episode = episode_from_documents(documents)
        straight = np.zeros((3, 6))
        straight[:, 0] = [0.0, 1.0, 2.0]
        recording.add_predicted_path(episode.times_s[4], 4, straight, np.array([0.0, 0.1, 0.3]))
        recording.add_windows(episode, WINDOW, *mean_and_std)
        figures = {"episode": 2, "total_reward": 4.0, "last_episode_nll": None, "success": True, "end": "GOAL_REACHED"}
        recording.add_figures(2, figures, "The simulator explains it.")
        send_blueprint(stream, recording.blueprint())
    return tmp_path / "run.rrd"


def test_episodes_follow_each_other_and_no_line_joins_them(run_file: Path) -> None:
    documents = make_documents(TICKS)
    episode = episode_from_documents(documents)
    relative_s = episode.times_s - documents[0].t_s
    second_s = documents[-1].t_s - documents[0].t_s + PAUSE_S
    rows = cells(run_file, "Scalars:scalars", "car_time")["car/state/vx_mps"]
    times_s, values = np.array([t for t, _ in rows]) * 1e-9, np.array([cell[0] for _, cell in rows])
    gap = np.flatnonzero(np.isnan(values))
    assert gap.tolist() == [TICKS + 1], "one NaN between the episodes interrupts the line"
    np.testing.assert_allclose(np.delete(times_s, gap), [*relative_s, *(second_s + relative_s)], atol=2e-9)
    np.testing.assert_array_equal(np.delete(values, gap), [*episode.states[:, 3]] * 2)
    numbers = [n for n, cell in cells(run_file, "Scalars:scalars", "episode")["car/state/vx_mps"] if cell[0] == cell[0]]
    assert numbers == [1] * (TICKS + 1) + [2] * (TICKS + 1)


def test_paths_of_episodes_have_different_colours(run_file: Path) -> None:
    colors = cells(run_file, "LineStrips3D:colors", "episode")["map/trail"]
    assert {(n, cell[0]) for n, cell in colors} == {(1, 0x440154FF), (2, 0xFDE725FF)}, "first and last of viridis"
    assert "map/trail" not in cells(run_file, "LineStrips3D:colors", None), "a static colour would hide them"


def test_predicted_path_has_a_band_of_two_standard_deviations(run_file: Path) -> None:
    rows = [cell for _, cell in cells(run_file, "LineStrips3D:strips", "step")["map/predicted"] if cell]
    ((path, band),) = rows
    np.testing.assert_allclose(np.array(path)[:, :2], [[0, 0], [1, 0], [2, 0]], atol=1e-6)
    edges = [[0, 0], [1, 0.2], [2, 0.6], [2, -0.6], [1, -0.2], [0, 0], [0, 0]]
    np.testing.assert_allclose(np.array(band)[:, :2], edges, atol=1e-6)


def test_predictions_and_figures_are_written_with_their_bands(run_file: Path, mean_and_std) -> None:
    mean, std = mean_and_std
    by_step = cells(run_file, "Scalars:scalars", "step")
    for k, name in enumerate(STATE_NAMES):
        predicted = by_step[f"states/{name}/predicted"]
        assert [step for step, _ in predicted] == [2, 3]
        if name != "yaw":
            center, two_std = mean[0, 2, k], 2.0 * std[0, 2, k]
            np.testing.assert_allclose(predicted[1][1], [center, center - two_std, center + two_std])
    by_episode = cells(run_file, "Scalars:scalars", "episode")
    assert by_episode["learning/total_reward"] == [(2, [4.0])]
    assert "learning/last_episode_nll" not in by_episode
    ((_, (table,)),) = cells(run_file, "TextDocument:text", "episode")["learning/table"]
    assert table.splitlines() == [
        "| episode | return | success | end |", "| --- | --- | --- | --- |", "| 2 | 4.00 | yes | goal reached |"
    ]  # fmt: skip
    assert cells(run_file, "TextLog:text", "episode")["check"] == [(2, ["Episode 2: The simulator explains it."])]


def test_layout_has_the_tabs_and_panels_with_data(run_file: Path, tmp_path: Path) -> None:
    learning = {"Drive by episode", "Predicted against driven", "Learning curve", "Quick check", "Latency and health"}
    assert set(tabs(run_file)) == learning
    names = [view.name for view in views(run_file)]
    assert {"Plan view [m]", "yaw rate [rad/s]", "Return", "Episodes", "What the quick check found"} <= set(names)
    assert not [name for name in names if name.startswith(("Negative", "Error of the simulator", "Distance"))]
    with rerun_file(tmp_path / "drive.rrd") as stream:
        recording = RunRecording(stream, 1)
        for document in make_documents(3):
            recording.write(document)
        send_blueprint(stream, recording.blueprint())
    assert set(tabs(tmp_path / "drive.rrd")) == {"Drive by episode", "Latency and health"}


def test_number_of_an_episode_of_learning_is_that_of_its_model(tmp_path: Path) -> None:
    first, *others = make_documents(3)
    for model, expected in (("3", 3), ("9" * 5000, first.episode), ("x", first.episode)):
        with rerun_file(tmp_path / "run.rrd") as stream:
            recording = RunRecording(stream, 5)
            for document in (dataclasses.replace(first, metadata={"model": model}), *others):
                recording.write(document)
        rows = cells(tmp_path / "run.rrd", "Scalars:scalars", "episode")["car/state/vx_mps"]
        assert {number for number, _ in rows} == {expected}
    assert math.isfinite(recording.documents.now_s)
