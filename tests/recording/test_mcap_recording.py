"""MCAP recordings: exact round trips, independent readers, recovery of incomplete files and refusals."""

import dataclasses
import math
import subprocess
import sys
from pathlib import Path

import mcap_protobuf.decoder
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

from carlab.core.documents import EpisodeEnded, EpisodeStarted, Tick, Transition
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.outcome import EndReason
from carlab.core.quantities import Action, CarState, Observation, PoseSample, Reality
from carlab.recording.mcap import schemas as schemas
from carlab.recording.mcap.sink import McapSink, write_episode
from carlab.recording.mcap.source import read_documents, read_episode, read_recording
from carlab.recording.recorder import Recorder
from tests.helpers.episode_documents import make_documents

RERUN = Path(sys.executable).with_name("rerun")


def record(path, documents, run_metadata=None):
    with Recorder([McapSink(path, run_metadata)]) as recorder:
        for document in documents:
            recorder.emit(document)
    assert recorder.failed is None
    return path


def comparable(value):
    """A document as nested tuples that compare bit by bit, also with arrays and NaN."""
    if dataclasses.is_dataclass(value):
        return (type(value).__name__, *(comparable(getattr(value, f.name)) for f in dataclasses.fields(value)))
    if isinstance(value, np.ndarray):
        return tuple(comparable(v) for v in value.tolist())
    if isinstance(value, float):
        return "nan" if math.isnan(value) else value.hex()
    if isinstance(value, dict):
        return {k: comparable(v) for k, v in value.items()}
    if isinstance(value, tuple):
        return tuple(comparable(v) for v in value)
    return value


def test_every_document_reads_back_exactly(tmp_path):
    documents = make_documents(70)
    path = record(tmp_path / "0001.mcap", documents)
    assert [comparable(d) for d in read_documents(path)] == [comparable(d) for d in documents]


any_float = st.floats(allow_nan=True, allow_infinity=True)
time_s = st.floats(min_value=-1e9, max_value=1e9)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    numbers=st.lists(any_float, min_size=24, max_size=24),
    times=st.lists(time_s, min_size=6, max_size=6),
    texts=st.lists(st.text(st.characters(exclude_categories=["Cs"])), min_size=3, max_size=3),
    wall_ns=st.integers(min_value=0, max_value=2**62),
)
def test_any_number_and_text_reads_back_exactly(tmp_path_factory, numbers, times, texts, wall_ns):
    n = iter(numbers)
    pose = PoseSample(2**31, times[0], times[1], next(n), next(n), next(n), next(n), True)
    state = CarState(*(next(n) for _ in range(6)))
    observation = Observation(state, times[2], times[3], -5, False, next(n), (pose, pose))
    action, sent = Action(next(n), next(n)), Action(next(n), next(n))
    features = np.array([next(n), next(n)])
    documents = [
        EpisodeStarted(
            1, times[4], wall_ns, texts[0], Reality.REAL, texts[1], "", -1, next(n), 0, config_toml=texts[2]
        ),
        Tick(0, times[5], next(n), observation, features, action, sent, next(n), texts[1]),
        Transition(0, times[5], features, sent, next(n), features[:0], True, True),
        EpisodeEnded(times[5], EndReason.GEOFENCE, texts[0], 1, next(n), observation, {texts[2]: next(n)}),
    ]
    path = record(tmp_path_factory.mktemp("any") / "0001.mcap", documents)
    assert [comparable(d) for d in read_documents(path)] == [comparable(d) for d in documents]


def test_arrays_equal_the_documents(tmp_path):
    documents = make_documents(40)
    ticks = [d for d in documents if isinstance(d, Tick)]
    path = record(tmp_path / "0001.mcap", documents, {"git": "abc", "host": "lab"})
    episode = read_episode(path)
    assert episode.ticks == 40
    np.testing.assert_array_equal(episode.times_s[:-1], [d.t_s for d in ticks])
    assert episode.times_s[-1] == documents[-2].t_s  # the transition that led to the last observation
    np.testing.assert_array_equal(episode.states[-1], documents[-1].last.state.to_array())
    np.testing.assert_array_equal(episode.sent, [d.sent.to_array() for d in ticks])
    np.testing.assert_array_equal(episode.requested, [d.requested.to_array() for d in ticks])
    np.testing.assert_array_equal(episode.rewards, [0.1 * k for k in range(40)])
    tracked = [p for d in [*(t.observation for t in ticks), documents[-1].last] for p in d.poses if p.tracked]
    np.testing.assert_array_equal(episode.poses, [(p.t_capture_s, p.x_m, p.y_m, p.yaw_rad) for p in tracked])
    np.testing.assert_allclose(episode.extra["pose_age_s"][:-1], 0.006, atol=1e-9)
    assert episode.extra["tracked"].sum() == 40  # one observation of 41 was not tracked
    expected = {
        "git": "abc",
        "car": "paper car",
        "reality": "emulated",
        "end_reason": "GOAL_REACHED",
        "seed": str(2**40 + 1),
    }
    assert expected.items() <= episode.metadata.items()
    assert "recovered" not in episode.metadata


def test_independent_reader_decodes_messages_units_and_times(tmp_path):
    documents = make_documents(10)
    path = record(tmp_path / "0001.mcap", documents)
    messages: dict[str, list] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[mcap_protobuf.decoder.DecoderFactory()])
        channels = {c.topic: c for c in reader.get_summary().channels.values()}
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            messages.setdefault(channel.topic, []).append((schema.name, message, decoded))
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
        attachments = {a.name: a.data.decode() for a in reader.iter_attachments()}
        assert reader.get_header().library.startswith("carlab ")
    assert attachments == {"config.toml": 'name = "Zürich"\n'}
    assert metadata["carlab.episode"]["end_reason"] == "GOAL_REACHED"
    for topic, name, rows in (
        ("/mocap/pose", "foxglove.PoseInFrame", 22),  # one of three samples of each observation is untracked
        ("/mocap/sample", "carlab.PoseSample", 33),
        ("/tf", "foxglove.FrameTransform", 11),
        ("/car/state", "carlab.CarState", 11),
        ("/car/action_requested", "carlab.Action", 10),
        ("/car/action_sent", "carlab.Action", 10),
        ("/car/health", "carlab.Health", 1),
        ("/safety/event", "carlab.SafetyEvent", 1),
        ("/episode/tick", "carlab.Tick", 10),
        ("/episode/transition", "carlab.Transition", 10),
        ("/log", "foxglove.Log", 2),
    ):
        assert {s for s, _, _ in messages[topic]} == {name}
        assert len(messages[topic]) == rows, topic
    started, tick = documents[0], next(d for d in documents if isinstance(d, Tick) and d.step == 4)
    _, message, state = messages["/car/state"][4]
    assert (state.x_m, state.vy_mps, state.t_s) == (tick.observation.state.x_m, 0.01, tick.t_s)
    assert message.sequence == 4
    # With the origins of the metadata the log time gives the car's clock to 2 ns; the publish time is the capture time.
    origin_ns, origin_s = (metadata["carlab.episode"][k] for k in ("start_wall_ns", "start_t_s"))
    assert float(origin_s) + (message.log_time - int(origin_ns)) * 1e-9 == pytest.approx(tick.t_s, abs=2e-9)
    assert (message.log_time - message.publish_time) * 1e-9 == pytest.approx(0.006, abs=1e-8)
    assert int(origin_ns) == started.wall_ns
    _, _, transform = messages["/tf"][4]
    rotation = Rotation.from_quat([getattr(transform.rotation, axis) for axis in "xyzw"])
    assert rotation.as_euler("xyz")[2] == pytest.approx(tick.observation.state.yaw_rad, abs=1e-12)
    for topic, channel in channels.items():
        for field in (
            schemas.MESSAGES.get(messages[topic][0][0].removeprefix("carlab."), ()) if topic in messages else ()
        ):
            if field.type == "double":
                assert channel.metadata[f"unit.{field.name}"], f"{topic} {field.name} has no unit"
    assert channels["/car/state"].metadata["unit.yaw_rate_radps"] == "rad/s"
    assert channels["/tf"].metadata["unit.translation"] == "m"


def test_field_numbers_are_unique():
    for name, fields in schemas.MESSAGES.items():
        assert len({f.number for f in fields}) == len(fields) == len({f.name for f in fields}), name


@pytest.mark.skipif(not RERUN.exists(), reason="the rerun program is not installed beside this Python")
def test_rerun_accepts_the_file(tmp_path):
    path = record(tmp_path / "0001.mcap", make_documents(30))
    check = subprocess.run([RERUN, "mcap", "check", path], capture_output=True, text=True, check=False)
    assert check.returncode == 0, check.stdout + check.stderr


def test_truncated_file_gives_its_complete_ticks_or_one_sentence(tmp_path):
    documents = make_documents(90)
    sink = McapSink(tmp_path / "complete.mcap")
    sink.open()
    for k, document in enumerate(documents):
        sink.write(document)
        if k % 12 == 0 and not sink.finished:
            sink.flush()
    complete = (tmp_path / "complete.mcap").read_bytes()
    truncated = tmp_path / "cut.mcap"
    rng = np.random.default_rng(0)
    sizes = sorted(
        {*range(0, 40, 3), *rng.integers(0, len(complete), 150).tolist(), len(complete) - 1, len(complete) - 9}
    )
    recovered = []
    for size in sizes:
        truncated.write_bytes(complete[:size])
        try:
            episode = read_episode(truncated)
        except DataError as error:
            assert "\n" not in str(error)
            recovered.append(0)
            continue
        assert episode.metadata["recovered"] == "true"
        np.testing.assert_array_equal(episode.sent, np.array([(math.sin(0.3 * k), 0.2) for k in range(episode.ticks)]))
        recovered.append(episode.ticks)
    assert recovered == sorted(recovered)  # a longer part never gives fewer ticks
    assert recovered[-1] == 90
    assert len(set(recovered)) > 5


def test_damaged_byte_never_gives_wrong_numbers(tmp_path):
    path = record(tmp_path / "0001.mcap", make_documents(60))
    complete = path.read_bytes()
    original = read_episode(path)
    rng = np.random.default_rng(1)
    for position in rng.integers(8, len(complete), 60):
        damaged = bytearray(complete)
        damaged[position] ^= 0x55
        path.write_bytes(damaged)
        try:
            episode = read_episode(path)
        except DataError:
            continue
        rows = [int(np.argmin(np.abs(original.times_s - t_s))) for t_s in episode.times_s]
        # The time of the end replaces a lost last transition, 4 ms before.
        np.testing.assert_allclose(episode.times_s, original.times_s[rows], rtol=0, atol=0.0041)
        np.testing.assert_array_equal(episode.states, original.states[rows])
        np.testing.assert_array_equal(episode.sent, original.sent[rows[:-1]])


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        (b"", ("empty", "carlab import")),
        (b"t,x,y,yaw\n0,0,0,0\n", ("not an MCAP file", "carlab import")),
        (b"\x89MCAP0\r\n", ("no complete tick",)),
    ],
)
def test_file_that_is_no_recording_is_refused_with_the_next_step(tmp_path, content, parts):
    path = tmp_path / "invalid.mcap"
    path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        read_episode(path)
    for part in ("invalid.mcap", *parts):
        assert part in str(caught.value)


def test_mcap_of_another_program_is_refused(tmp_path):
    path = tmp_path / "other.mcap"
    writer = Writer(str(path))
    writer.start(library="somebody else 1.0")
    channel = writer.register_channel("/car/state", "json", writer.register_schema("thing", "jsonschema", b"{}"))
    writer.add_message(channel, 1, b'{"x_m": 1}', 1)
    writer.finish()
    with pytest.raises(DataError, match=r"not a recording of carlab \(written by somebody else"):
        read_episode(path)


def test_missing_file_and_folder_are_refused(tmp_path):
    with pytest.raises(DataError, match="does not exist"):
        read_episode(tmp_path / "0001.mcap")
    with pytest.raises(DataError, match="folder"):
        read_episode(tmp_path)
    (tmp_path / "0001.mcap.partial").write_bytes(b"")
    with pytest.raises(DataError, match="is incomplete; read"):
        read_episode(tmp_path / "0001.mcap")


def test_episode_without_a_tick_is_refused_with_its_end_reason(tmp_path):
    started = make_documents(1)[0]
    ended = EpisodeEnded(started.t_s, EndReason.CRASHED, "No pose came.", 0, 0.0)
    path = record(tmp_path / "0001.mcap", [started, ended])
    assert read_recording(path).defect is None
    with pytest.raises(DataError, match=r"0001\.mcap holds no complete tick .*No pose came"):
        read_episode(path)


def test_command_without_a_following_observation_is_dropped(tmp_path):
    documents = make_documents(20)
    # The car failed after the 20th command: its transition is missing and `last` is the observation of that tick.
    last_tick = [d for d in documents if isinstance(d, Tick)][-1]
    ended = dataclasses.replace(documents[-1], steps=19, last=last_tick.observation)
    path = record(tmp_path / "0001.mcap", [*documents[:-2], ended])
    assert [comparable(d) for d in read_documents(path)] == [comparable(d) for d in [*documents[:-2], ended]]
    episode = read_episode(path)
    assert episode.ticks == 19
    np.testing.assert_array_equal(episode.states[-1], last_tick.observation.state.to_array())


def test_imported_episode_reads_back_unchanged(tmp_path):
    rng = np.random.default_rng(5)
    episode = EpisodeData(
        times_s=np.cumsum(rng.uniform(0.01, 0.05, 31)),
        states=rng.normal(size=(31, 6)),
        requested=rng.uniform(-1, 1, (30, 2)),
        sent=rng.uniform(-1, 1, (30, 2)),
        rewards=np.full(30, np.nan),
        poses=np.column_stack([np.linspace(0.0, 0.9, 50), rng.normal(size=(50, 3))]),
        metadata={"car": "somebody's car", "source": "log.csv.gz", "units": "yaw was in degrees"},
        extra={"battery": np.append(rng.normal(size=30), np.nan)},
    )
    write_episode(episode, tmp_path / "imported.mcap")
    reread = read_episode(tmp_path / "imported.mcap")
    for name in ("times_s", "states", "requested", "sent", "rewards", "poses"):
        np.testing.assert_array_equal(getattr(reread, name), getattr(episode, name), err_msg=name)
    assert reread.extra.keys() == episode.extra.keys()
    np.testing.assert_array_equal(reread.extra["battery"], episode.extra["battery"])
    assert episode.metadata.items() <= reread.metadata.items()
    with pytest.raises(DataError, match="never overwritten"):
        write_episode(episode, tmp_path / "imported.mcap")
