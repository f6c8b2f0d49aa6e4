"""Rerun recordings: entities, values, properties, incomplete files and screenshots."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from carlab.core.documents import EpisodeEnded, SafetyEvent
from carlab.core.errors import DataError, NotReadyError
from carlab.core.outcome import EndReason
from carlab.recording.episode_builder import episode_from_documents
from carlab.recording.recorder import Recorder
from carlab.recording.rerun import blueprint
from carlab.recording.rerun.screenshot import has_vulkan_driver, save_screenshot
from carlab.recording.rerun.sink import RerunSink, episode_to_rrd
from tests.helpers.episode_documents import make_documents
from tests.helpers.rerun_files import BlueprintView, entities, tabs, views

RERUN = Path(sys.executable).with_name("rerun")
needs_rerun = pytest.mark.skipif(not RERUN.exists(), reason="the rerun program is not installed beside this Python")

MOVING = {"map/base_link", "map/trail", *blueprint.SERIES}
LIVE = MOVING | {"mocap/pose", "safety/state", "safety/event", "car/health/battery_v", "episode/end", "log"}
STILL = {"map", "map/arena", "map/path", "map/goal", "map/goal/pose", "map/goal/heading", "map/base_link/body"}


def record(path, documents):
    with Recorder([RerunSink(path)]) as recorder:
        for document in documents:
            recorder.emit(document)
    assert recorder.failed is None
    return path


def rows_of(path):
    """Values by entity and time [s], read chunk by chunk without the query engine of the viewer."""
    values: dict[str, dict[float, np.ndarray]] = {}
    for chunk in RrdReader(str(path)).stream().to_chunks():
        batch = chunk.to_record_batch()
        names = batch.schema.names
        if "car_time" not in names:
            continue
        times_s = np.array(batch.column("car_time").cast("int64").to_pylist(), dtype=np.float64) * 1e-9
        for name in names:
            field = batch.schema.field(name)
            component = (field.metadata or {}).get(b"rerun:component", b"").decode()
            if component in ("Scalars:scalars", "Transform3D:translation", "LineStrips3D:strips"):
                cells = batch.column(name).to_pylist()
                values.setdefault(chunk.entity_path.strip("/"), {}).update(
                    {t: np.array(cell[0]) for t, cell in zip(times_s, cells, strict=True) if cell}
                )
    return values


def verify(path):
    verification = subprocess.run([RERUN, "rrd", "verify", path], capture_output=True, text=True, check=False)
    assert verification.returncode == 0, verification.stdout + verification.stderr


@needs_rerun
def test_live_recording_is_valid_and_has_the_entities_of_the_layout(tmp_path):
    path = record(tmp_path / "0001.rrd", make_documents(60))
    assert [p.name for p in tmp_path.iterdir()] == ["0001.rrd"]
    verify(path)
    assert entities(path) >= LIVE | STILL
    reader = RrdReader(str(path))
    assert len(reader.recordings()) == 1
    assert sorted(tabs(path)) == ["Drive", "Latency and health"]
    assert {"Safety gate", "Health"} <= {view.name for view in views(path)}


def has_data(view: BlueprintView, logged: set[str]) -> bool:
    """Whether an entity of a view is among ``logged``."""
    queried = [line.replace("$origin", view.origin).strip("/").removesuffix("/**") for line in view.query]
    return any(path == q or path.startswith(f"{q}/") for path in logged for q in queried or [view.origin.strip("/")])


def test_layout_of_a_complete_file_has_no_panel_without_data(tmp_path):
    episode = dataclasses.replace(episode_from_documents(make_documents(20)), rewards=np.full(20, np.nan), extra={})
    path = tmp_path / "arrays.rrd"
    episode_to_rrd(episode, path)
    names = [view.name for view in views(path)]
    series = ("Steering [-1, 1], left positive", "Throttle [-1, 1]", "Velocity of the body [m/s]", "Yaw rate [rad/s]")
    assert sorted(names) == ["Events and log", "Plan view [m]", *series], "no safety gate, latency, health or reward"
    assert tabs(path) == ["Drive"]
    with_data = set(rows_of(path)) | {"episode/end"}
    assert all(has_data(view, with_data) for view in views(path))
    full = record(tmp_path / "full.rrd", make_documents(20))
    assert all(has_data(view, LIVE) for view in views(full))


def test_values_and_times_equal_the_emitted_ones(tmp_path):
    documents = make_documents(60)
    episode = episode_from_documents(documents)
    rows = rows_of(record(tmp_path / "0001.rrd", documents))
    times_s = episode.times_s - documents[0].t_s
    for name, expected, count in (
        ("car/action_sent/steering", episode.sent[:, 0], 60),
        ("car/action_requested/throttle", episode.requested[:, 1], 60),
        ("car/state/yaw_rate_radps", episode.states[:, 5], 61),
        ("car/state/age_ms", 1e3 * episode.extra["pose_age_s"], 61),
        ("episode/transition/reward", episode.rewards, 60),
    ):
        assert len(rows[name]) == count, name
        keys = sorted(rows[name])
        expected_times_s = times_s[1:] if name.endswith("reward") else times_s[:count]
        np.testing.assert_allclose(keys, expected_times_s, atol=2e-9, err_msg=name)
        np.testing.assert_array_equal([float(rows[name][k]) for k in keys], expected, err_msg=name)
    positions = [rows["map/base_link"][t] for t in sorted(rows["map/base_link"])]
    np.testing.assert_allclose(np.array(positions)[:, :2], episode.states[:, :2], atol=1e-6)
    trail = [rows["map/trail"][t] for t in sorted(rows["map/trail"])]
    for previous, segment, current in zip(positions, trail[1:], positions[1:], strict=False):
        np.testing.assert_array_equal(segment, [previous, current])


@needs_rerun
def test_converted_episode_has_the_entities_of_a_live_one_and_its_overlays(tmp_path):
    episode = episode_from_documents(make_documents(60))
    predicted = episode.states + 0.1
    predicted[:4] = np.nan
    path = tmp_path / "view.rrd"
    episode_to_rrd(episode, path, "recorded and predicted", {"sim model": predicted})
    verify(path)
    entity_paths = entities(path)
    assert entity_paths >= MOVING | STILL
    assert entity_paths >= {
        "map/overlay/sim_model/trail",
        "map/overlay/sim_model/base_link",
        "overlay/sim_model/vx_mps",
    }
    rows = rows_of(path)
    assert len(rows["overlay/sim_model/vx_mps"]) == 57
    last = max(rows["overlay/sim_model/vx_mps"])
    assert float(rows["overlay/sim_model/vx_mps"][last]) == predicted[-1, 3]
    with pytest.raises(DataError, match="Overlay 'short'"):
        episode_to_rrd(episode, tmp_path / "other.rrd", "", {"short": predicted[:-1]})
    with pytest.raises(DataError, match="never overwritten"):
        episode_to_rrd(episode, path)


def properties(path):
    """Newest value of each property."""
    newest = {}
    for chunk in RrdReader(str(path)).stream().to_chunks():
        if chunk.entity_path.startswith("/__properties"):
            batch = chunk.to_record_batch()
            for name in batch.schema.names[1:]:
                cells = zip(batch.column(0).to_pylist(), batch.column(name).to_pylist(), strict=True)
                rows = [(row, cell[0]) for row, cell in cells if cell]
                newest[name] = max([*rows, *([newest[name]] if name in newest else [])], key=lambda pair: pair[0])
    return {name: value for name, (_, value) in newest.items()}


def test_end_reason_and_car_are_properties(tmp_path):
    ended = properties(record(tmp_path / "ended.rrd", make_documents(5)))
    expected = {
        "reality": "emulated",
        "car": "paper car",
        "reason": "GOAL_REACHED",
        "steps": 5,
        "detail": "within 0.1 m",
    }
    assert expected.items() <= ended.items()
    assert ended["RecordingInfo:name"] == "Episode 7: circle on paper car, EMULATED"
    crashed = properties(record(tmp_path / "crashed.rrd", make_documents(5, end=False)))
    assert crashed["reason"] == "CRASHED"


def test_end_reason_of_a_killed_recording_is_crashed(tmp_path):
    sink = RerunSink(tmp_path / "0001.rrd")
    sink.open()
    for document in make_documents(20, end=False):
        sink.write(document)
    sink.flush()
    try:
        (tmp_path / "copy.rrd").write_bytes((tmp_path / "0001.rrd.partial").read_bytes())
    finally:
        sink.abandon()
    with pytest.warns(match="no footer"):
        assert properties(tmp_path / "copy.rrd")["reason"] == "CRASHED"
    with pytest.warns(match="no footer"):
        assert len(rows_of(tmp_path / "copy.rrd")["car/state/vx_mps"]) == 20


@needs_rerun
def test_episode_without_a_tick_is_a_valid_file(tmp_path):
    started = make_documents(1)[0]
    documents = [
        started,
        SafetyEvent(started.t_s, "arming", "refused"),
        EpisodeEnded(started.t_s, EndReason.CRASHED, "No pose came.", 0, 0.0),
    ]
    verify(record(tmp_path / "0001.rrd", documents))


@pytest.mark.skipif(not has_vulkan_driver(), reason="no Vulkan driver (apt-get install mesa-vulkan-drivers libvulkan1)")
@needs_rerun
def test_screenshot_is_made_without_a_window_and_the_viewer_ends(tmp_path):
    path = record(tmp_path / "0001.rrd", make_documents(60))
    save_screenshot(path, tmp_path / "picture.png", size=(800, 600))
    data = (tmp_path / "picture.png").read_bytes()
    assert data.startswith(b"\x89PNG\r\n")
    from matplotlib.image import imread

    pixels = imread(tmp_path / "picture.png")
    assert pixels.shape[:2] == (600, 800)
    sky = np.array(blueprint.SKY) / 255.0
    running = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
    assert str(path) not in running, "the viewer still runs"
    assert (np.abs(pixels[:, :, :3] - sky).max(axis=2) < 0.1).sum() > 50  # the car, its trail and its series


def test_missing_vulkan_driver_is_reported_with_the_package_to_install(tmp_path, monkeypatch):
    (tmp_path / "0001.rrd").write_bytes(b"")
    monkeypatch.setattr("carlab.recording.rerun.screenshot.has_vulkan_driver", lambda: False)
    monkeypatch.setattr("carlab.recording.rerun.screenshot.rerun_program", lambda: RERUN)
    with pytest.raises(NotReadyError, match="apt-get install mesa-vulkan-drivers libvulkan1"):
        save_screenshot(tmp_path / "0001.rrd", tmp_path / "x.png")
    with pytest.raises(DataError, match="does not exist"):
        save_screenshot(tmp_path / "0002.rrd", tmp_path / "x.png")
