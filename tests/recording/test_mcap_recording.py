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

RERUN = Path(sys.executable).with_name("rerun")


def record(path, documents, run_metadata=None):
    with Recorder([McapSink(path, run_metadata)]) as recorder:
        for document in documents:
            recorder.emit(document)
    assert recorder.failed is None
    return path


def plain(value):
    """Documents with arrays and NaN as something that compares bit by bit."""
    if dataclasses.is_dataclass(value):
        return (type(value).__name__, *(plain(getattr(value, f.name)) for f in dataclasses.fields(value)))
    if isinstance(value, np.ndarray):
        return tuple(plain(v) for v in value.tolist())
    if isinstance(value, float):
        return "nan" if math.isnan(value) else value.hex()
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, tuple):
        return tuple(plain(v) for v in value)
    return value


def test_every_document_reads_back_exactly(tmp_path, make_documents):
    documents = make_documents(70)
    path = record(tmp_path / "0001.mcap", documents)
    assert [plain(d) for d in read_documents(path)] == [plain(d) for d in documents]


anything = st.floats(allow_nan=True, allow_infinity=True)
moment = st.floats(min_value=-1e9, max_value=1e9)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    numbers=st.lists(anything, min_size=24, max_size=24),
    times=st.lists(moment, min_size=6, max_size=6),
    words=st.lists(st.text(st.characters(exclude_categories=["Cs"])), min_size=3, max_size=3),
    wall_ns=st.integers(min_value=0, max_value=2**62),
)
def test_any_number_and_any_text_reads_back_exactly(tmp_path_factory, numbers, times, words, wall_ns):
    n = iter(numbers)
    pose = PoseSample(2**31, times[0], times[1], next(n), next(n), next(n), next(n), True)
    state = CarState(*(next(n) for _ in range(6)))
    seen = Observation(state, times[2], times[3], -5, False, next(n), (pose, pose))
    action, other = Action(next(n), next(n)), Action(next(n), next(n))
    features = np.array([next(n), next(n)])
    documents = [
        EpisodeStarted(
            1, times[4], wall_ns, words[0], Reality.REAL, words[1], "", -1, next(n), 0, config_toml=words[2]
        ),
        Tick(0, times[5], next(n), seen, features, action, other, next(n), words[1]),
        Transition(0, times[5], features, other, next(n), features[:0], True, True),
        EpisodeEnded(times[5], EndReason.GEOFENCE, words[0], 1, next(n), seen, {words[2]: next(n)}),
    ]
    path = record(tmp_path_factory.mktemp("any") / "0001.mcap", documents)
    assert [plain(d) for d in read_documents(path)] == [plain(d) for d in documents]


def test_arrays_are_what_the_loop_saw(tmp_path, make_documents):
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
    wanted = {
        "git": "abc",
        "car": "paper car",
        "reality": "emulated",
        "end_reason": "GOAL_REACHED",
        "seed": str(2**40 + 1),
    }
    assert wanted.items() <= episode.metadata.items()
    assert "recovered" not in episode.metadata


def test_an_independent_reader_decodes_messages_units_and_times(tmp_path, make_documents):
    documents = make_documents(10)
    path = record(tmp_path / "0001.mcap", documents)
    seen: dict[str, list] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[mcap_protobuf.decoder.DecoderFactory()])
        channels = {c.topic: c for c in reader.get_summary().channels.values()}
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            seen.setdefault(channel.topic, []).append((schema.name, message, decoded))
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
        assert {s for s, _, _ in seen[topic]} == {name}
        assert len(seen[topic]) == rows, topic
    started, tick = documents[0], next(d for d in documents if isinstance(d, Tick) and d.step == 4)
    _, message, state = seen["/car/state"][4]
    assert (state.x_m, state.vy_mps, state.t_s) == (tick.observation.state.x_m, 0.01, tick.t_s)
    assert message.sequence == 4
    # The origins in the metadata give the car's clock back to a nanosecond, and the publish time is the capture.
    origin_ns, origin_s = (metadata["carlab.episode"][k] for k in ("start_wall_ns", "start_t_s"))
    assert float(origin_s) + (message.log_time - int(origin_ns)) * 1e-9 == pytest.approx(tick.t_s, abs=2e-9)
    assert (message.log_time - message.publish_time) * 1e-9 == pytest.approx(0.006, abs=1e-8)
    assert int(origin_ns) == started.wall_ns
    _, _, transform = seen["/tf"][4]
    turn = Rotation.from_quat([getattr(transform.rotation, axis) for axis in "xyzw"])
    assert turn.as_euler("xyz")[2] == pytest.approx(tick.observation.state.yaw_rad, abs=1e-12)
    for topic, channel in channels.items():
        for field in schemas.MESSAGES.get(seen[topic][0][0].removeprefix("carlab."), ()) if topic in seen else ():
            if field.type == "double":
                assert channel.metadata[f"unit.{field.name}"], f"{topic} {field.name} has no unit"
    assert channels["/car/state"].metadata["unit.yaw_rate_radps"] == "rad/s"
    assert channels["/tf"].metadata["unit.translation"] == "m"


def test_field_numbers_are_never_used_twice():
    for name, fields in schemas.MESSAGES.items():
        assert len({f.number for f in fields}) == len(fields) == len({f.name for f in fields}), name


@pytest.mark.skipif(not RERUN.exists(), reason="the rerun program is not installed beside this Python")
def test_rerun_finds_nothing_wrong_with_the_file(tmp_path, make_documents):
    path = record(tmp_path / "0001.mcap", make_documents(30))
    done = subprocess.run([RERUN, "mcap", "check", path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_file_cut_anywhere_gives_what_is_whole_or_one_sentence(tmp_path, make_documents):
    documents = make_documents(90)
    sink = McapSink(tmp_path / "whole.mcap")
    sink.open()
    for k, document in enumerate(documents):
        sink.write(document)
        if k % 12 == 0 and not sink.finished:
            sink.flush()
    whole = (tmp_path / "whole.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    rng = np.random.default_rng(0)
    sizes = sorted({*range(0, 40, 3), *rng.integers(0, len(whole), 150).tolist(), len(whole) - 1, len(whole) - 9})
    recovered = []
    for size in sizes:
        cut.write_bytes(whole[:size])
        try:
            episode = read_episode(cut)
        except DataError as error:
            assert "\n" not in str(error)
            recovered.append(0)
            continue
        assert episode.metadata["recovered"] == "true"
        np.testing.assert_array_equal(episode.sent, np.array([(math.sin(0.3 * k), 0.2) for k in range(episode.ticks)]))
        recovered.append(episode.ticks)
    assert recovered == sorted(recovered)  # a longer piece never gives less
    assert recovered[-1] == 90
    assert len(set(recovered)) > 5


def test_damage_in_the_middle_never_gives_wrong_numbers(tmp_path, make_documents):
    path = record(tmp_path / "0001.mcap", make_documents(60))
    whole = path.read_bytes()
    true = read_episode(path)
    rng = np.random.default_rng(1)
    for place in rng.integers(8, len(whole), 60):
        damaged = bytearray(whole)
        damaged[place] ^= 0x55
        path.write_bytes(damaged)
        try:
            episode = read_episode(path)
        except DataError:
            continue
        np.testing.assert_array_equal(episode.states[: episode.ticks], true.states[: episode.ticks])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", ("empty", "carlab import")),
        (b"t,x,y,yaw\n0,0,0,0\n", ("not an MCAP file", "carlab import")),
        (b"\x89MCAP0\r\n", ("no complete tick",)),
    ],
)
def test_what_is_no_recording_says_so_with_the_next_step(tmp_path, content, words):
    path = tmp_path / "thing.mcap"
    path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        read_episode(path)
    for word in ("thing.mcap", *words):
        assert word in str(caught.value)


def test_an_mcap_of_another_program_is_told_apart(tmp_path):
    path = tmp_path / "other.mcap"
    writer = Writer(str(path))
    writer.start(library="somebody else 1.0")
    channel = writer.register_channel("/car/state", "json", writer.register_schema("thing", "jsonschema", b"{}"))
    writer.add_message(channel, 1, b'{"x_m": 1}', 1)
    writer.finish()
    with pytest.raises(DataError, match=r"not a recording of carlab \(written by somebody else"):
        read_episode(path)


def test_missing_file_and_folder(tmp_path, make_documents):
    with pytest.raises(DataError, match="does not exist"):
        read_episode(tmp_path / "0001.mcap")
    with pytest.raises(DataError, match="folder"):
        read_episode(tmp_path)
    (tmp_path / "0001.mcap.partial").write_bytes(b"")
    with pytest.raises(DataError, match="is incomplete; read"):
        read_episode(tmp_path / "0001.mcap")


def test_an_episode_that_ended_before_its_first_tick_says_how(tmp_path, make_documents):
    started = make_documents(1)[0]
    ended = EpisodeEnded(started.t_s, EndReason.CRASHED, "No pose came.", 0, 0.0)
    path = record(tmp_path / "0001.mcap", [started, ended])
    assert read_recording(path).recovered is False
    with pytest.raises(DataError, match=r"0001\.mcap holds no complete tick .*No pose came"):
        read_episode(path)


def test_a_command_whose_outcome_nobody_saw_is_left_out(tmp_path, make_documents):
    documents = make_documents(20)
    # The car failed after the 20th command: its transition is missing and `last` is the observation of that tick.
    last_tick = [d for d in documents if isinstance(d, Tick)][-1]
    ended = dataclasses.replace(documents[-1], steps=19, last=last_tick.observation)
    path = record(tmp_path / "0001.mcap", [*documents[:-2], ended])
    assert [plain(d) for d in read_documents(path)] == [plain(d) for d in [*documents[:-2], ended]]
    episode = read_episode(path)
    assert episode.ticks == 19
    np.testing.assert_array_equal(episode.states[-1], last_tick.observation.state.to_array())


def test_an_imported_episode_goes_through_a_file_unchanged(tmp_path):
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
    back = read_episode(tmp_path / "imported.mcap")
    for name in ("times_s", "states", "requested", "sent", "rewards", "poses"):
        np.testing.assert_array_equal(getattr(back, name), getattr(episode, name), err_msg=name)
    assert back.extra.keys() == episode.extra.keys()
    np.testing.assert_array_equal(back.extra["battery"], episode.extra["battery"])
    assert episode.metadata.items() <= back.metadata.items()
    with pytest.raises(DataError, match="never overwritten"):
        write_episode(episode, tmp_path / "imported.mcap")
