"""A damaged or truncated recording says what is wrong with it; ticks outside the damaged chunk are read."""

import math
from io import BytesIO

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader, breakup_chunk

from carlab.api.recordings import load
from carlab.core.documents import Tick, Transition
from carlab.core.errors import DataError
from carlab.recording.episode_builder import episode_from_documents
from carlab.recording.mcap.sink import McapSink
from carlab.recording.mcap.source import read_episode, read_recording
from tests.helpers.episode_documents import make_documents

TICKS = 90


@pytest.fixture
def path(tmp_path):
    """A complete recording with a chunk for each 12 documents."""
    sink = McapSink(tmp_path / "0001.mcap")
    sink.open()
    for k, document in enumerate(make_documents(TICKS)):
        sink.write(document)
        if k % 12 == 0 and not sink.finished:
            sink.flush()
    return sink.path


def chunks_of(path):
    """Offset, length and number of ticks of each chunk."""
    chunks = []
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        (tick_id,) = (channel.id for channel in summary.channels.values() if channel.topic == "/episode/tick")
        for index in summary.chunk_indexes:
            file.seek(index.chunk_start_offset)
            record = BytesIO(file.read(index.chunk_length))
            chunk = next(StreamReader(record, skip_magic=True, emit_chunks=True).records)
            messages = [record for record in breakup_chunk(chunk) if isinstance(record, Message)]
            ticks = sum(message.channel_id == tick_id for message in messages)
            chunks.append((index.chunk_start_offset, index.chunk_length, ticks))
    return chunks


def flip(path, position):
    content = bytearray(path.read_bytes())
    content[position] ^= 0x55
    path.write_bytes(content)


@pytest.mark.parametrize("index", [0, 5, -1])
def test_chunks_after_a_damaged_one_are_read(path, index):
    """Chunk 0 has the names of the topics, too; they are repeated at the end of the file."""
    complete = read_episode(path)
    start, length, ticks = chunks_of(path)[index]
    flip(path, start + length - 10)
    recording = load(path)
    episode = recording.episode
    # A tick whose parts lie in two chunks is lost with either of them.
    assert TICKS - ticks - 2 <= episode.ticks <= TICKS - ticks
    assert recording.recovery == (
        f"is damaged at byte {start}; {episode.ticks} of {TICKS} ticks were recovered; copy it again"
    )
    rows = [int(np.argmin(np.abs(complete.times_s - t_s))) for t_s in episode.times_s]
    np.testing.assert_array_equal(episode.states, complete.states[rows])
    np.testing.assert_array_equal(episode.sent[:, 0], [math.sin(0.3 * k) for k in rows[:-1]])
    if index == 5:
        assert rows[-1] == TICKS
        assert int(episode.metadata["missing_ticks"]) == TICKS - episode.ticks


@pytest.mark.parametrize("offset", [1, 7], ids=["length inside the file", "length beyond the file"])
def test_damaged_header_of_a_chunk_loses_this_chunk_at_most(path, offset):
    """The length of the record is wrong; the index at the end of the file states where the next chunk begins."""
    start, _, ticks = chunks_of(path)[4]
    assert path.read_bytes()[start] == Opcode.CHUNK
    flip(path, start + offset)
    episode = read_episode(path)
    assert episode.ticks >= TICKS - ticks - 2
    assert f"; {episode.ticks} of {TICKS} ticks were recovered" in episode.metadata["recovery"]
    assert episode.metadata["end_reason"] == "GOAL_REACHED"


def test_zeros_over_several_chunks_lose_these_chunks_only(path):
    """A block of the disk is lost: its zeros contain headers of chunks."""
    chunks = chunks_of(path)
    first, last = chunks[2][0] + 100, chunks[4][0] + 100
    content = path.read_bytes()
    path.write_bytes(content[:first] + bytes(last - first) + content[last:])
    lost = sum(ticks for _, _, ticks in chunks[2:5])
    assert TICKS - lost - 2 <= read_episode(path).ticks <= TICKS - lost


def test_damaged_beginning_loses_no_tick(path):
    content = path.read_bytes()
    path.write_bytes(content[:8] + bytes(20) + content[28:])
    episode = read_episode(path)
    assert episode.ticks == TICKS
    assert episode.metadata["recovery"].startswith("is damaged at byte 8; ")


def test_truncated_recording_is_not_called_unfinished(path):
    content = path.read_bytes()
    path.write_bytes(content[:-5000])
    recovery = read_episode(path).metadata["recovery"]
    assert recovery.startswith(f"ends at byte {len(content) - 5000} before its closing record (it was not copied")
    assert recovery.endswith("complete ticks were recovered; copy it again")
    unfinished = path.rename(path.with_name("0001.mcap.partial"))
    assert read_episode(unfinished).metadata["recovery"].startswith("is incomplete, because its writer was stopped; ")


def test_saved_copy_of_a_damaged_recording_is_not_damaged(path, tmp_path):
    path.write_bytes(path.read_bytes()[:-5000])
    damaged = load(path)
    assert damaged.is_recovered
    copy = tmp_path / "copy.mcap"
    damaged.save(copy)
    assert not load(copy).is_recovered


def test_recording_without_a_readable_tick_names_the_damage(path):
    start = chunks_of(path)[0][0]
    end = sum(chunks_of(path)[-1][:2])
    content = path.read_bytes()
    path.write_bytes(content[:8] + bytes(end - 8) + content[end:])
    with pytest.raises(DataError, match=r"0001\.mcap holds no complete tick and is damaged at byte 8; copy it again"):
        read_episode(path)
    for size in (300, start + 10):
        path.write_bytes(content[:size])
        with pytest.raises(DataError, match=rf"holds no complete tick and ends at byte {size} before its closing"):
            read_episode(path)


def test_complete_recording_has_no_defect(path):
    assert read_recording(path).defect is None
    assert load(path).recovery == ""


def test_beginning_and_end_alone_are_refused(path):
    path.write_bytes(path.read_bytes()[:8] * 2)
    with pytest.raises(DataError, match="holds no complete tick and is damaged at byte 8"):
        read_episode(path)


@pytest.mark.parametrize("lost_transitions", [0, 3])
def test_final_state_keeps_its_time_if_the_last_ticks_are_lost(lost_transitions):
    documents = make_documents(60)
    complete = episode_from_documents(documents)
    remaining = [
        d
        for d in documents
        if not (isinstance(d, Tick) and d.step >= 57)
        and not (isinstance(d, Transition) and d.step >= 60 - lost_transitions)
    ]
    episode = episode_from_documents(remaining)
    end_s = documents[-1].t_s if lost_transitions else complete.times_s[-1]
    np.testing.assert_array_equal(episode.times_s, [*complete.times_s[:57], end_s])
    np.testing.assert_array_equal(episode.states[-1], complete.states[-1])
