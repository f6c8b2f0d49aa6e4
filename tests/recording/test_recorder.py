"""The recorder: order and loss of documents, failing disks, and files after a crash or a kill."""

import errno
import logging
import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from carlab.core.documents import EpisodeEnded, EpisodeStarted, SafetyEvent, Tick, Transition
from carlab.core.errors import DataError, NotOpenError
from carlab.core.outcome import EndReason
from carlab.recording.mcap.sink import McapSink
from carlab.recording.mcap.source import read_documents, read_episode, read_recording
from carlab.recording.recorder import Recorder
from carlab.recording.rerun.sink import RerunSink
from carlab.recording.sink import Sink
from tests.helpers.episode_documents import make_documents


class MemorySink(Sink):
    """Keeps documents; waits for ``gate`` if given, and raises ``error`` at document number ``at``."""

    def __init__(self, gate=None, error=None, at=0):
        super().__init__()
        self.items, self.gate, self.error, self.at = [], gate, error, at
        self.flushes = 0
        self.complete = False

    def open(self):
        pass

    def flush(self):
        self.flushes += 1

    def abandon(self):
        self._finished = True

    def _write(self, item):
        if self.gate is not None:
            self.gate.wait(30.0)
        if self.error is not None and len(self.items) == self.at:
            raise self.error
        self.items.append(item)

    def _finish(self):
        self.complete = True


def test_documents_reach_every_sink_in_order_and_sinks_are_finished():
    documents = make_documents(30)
    first, second = MemorySink(), MemorySink()
    with Recorder([first, second]) as recorder:
        for document in documents:
            recorder.emit(document)
    assert first.items == second.items == documents
    assert first.complete
    assert second.complete
    assert recorder.dropped == 0
    assert recorder.failed is None


def test_constructor_starts_no_thread_and_writes_no_file(tmp_path):
    before = threading.active_count()
    recorder = Recorder([McapSink(tmp_path / "runs" / "0001.mcap")])
    assert threading.active_count() == before
    assert list(tmp_path.iterdir()) == []
    recorder.close()
    with pytest.raises(NotOpenError):
        recorder.emit(SafetyEvent(0.0, "clip", ""))


def test_blocked_sink_blocks_no_emit_and_loses_no_event():
    gate = threading.Event()
    blocked = MemorySink(gate)
    recorder = Recorder([blocked], capacity=50)
    recorder.open()
    documents = make_documents(400)
    emitted = threading.Event()

    def loop():
        for document in documents:
            recorder.emit(document)
        for k in range(200):
            recorder.emit(SafetyEvent(1e5 + k, "clip", str(k)))
        emitted.set()

    # Documents after the end are ignored by sinks, so the safety events go before it.
    documents, end = documents[:-1], documents[-1]
    thread = threading.Thread(target=loop)
    thread.start()
    assert emitted.wait(20.0), "emit was blocked by the sink"
    thread.join()
    recorder.emit(end)
    gate.set()
    recorder.close()
    assert recorder.dropped > 700
    assert isinstance(blocked.items[0], EpisodeStarted)
    assert sum(isinstance(d, SafetyEvent) for d in blocked.items) == 201
    assert isinstance(blocked.items[-1], EpisodeEnded)
    assert blocked.items[-1].reason is EndReason.GOAL_REACHED
    assert blocked.items[-1].statistics["recorder_dropped"] == recorder.dropped
    kept = sum(isinstance(d, (Tick, Transition)) for d in blocked.items)
    assert kept + recorder.dropped == sum(not isinstance(d, (EpisodeStarted, SafetyEvent)) for d in documents) - sum(
        type(d).__name__ == "HealthReading" for d in blocked.items
    )


def test_close_ends_and_reports_a_disk_that_hangs():
    gate = threading.Event()
    recorder = Recorder([MemorySink(gate)])
    recorder.open()
    recorder.emit(make_documents(1)[0])
    recorder.close(timeout_s=0.2)
    assert "made no progress" in recorder.failed
    gate.set()
    recorder.close()


@pytest.mark.parametrize(
    ("error", "message", "finished"),
    [
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), "disk is full; free some space", False),
        (PermissionError(errno.EACCES, os.strerror(errno.EACCES)), "check the permissions", False),
        (ValueError("a bug"), "a bug", True),
    ],
)
def test_failed_sink_is_closed_and_the_others_continue(caplog, error, message, finished):
    documents = make_documents(20)
    failing, intact = MemorySink(error=error, at=9), MemorySink()
    with caplog.at_level(logging.CRITICAL), Recorder([failing, intact]) as recorder:
        for document in documents:
            recorder.emit(document)
    assert intact.items == documents
    assert message in recorder.failed
    assert "\n" not in recorder.failed
    assert failing.finished
    if not finished:
        assert not failing.complete


def test_full_disk_leaves_a_readable_partial_file(tmp_path, monkeypatch):
    sink = McapSink(tmp_path / "0001.mcap")
    documents = make_documents(60)
    sink.open()
    for document in documents[:60]:
        sink.write(document)
    sink.flush()
    file = sink._file

    class FullDisk:
        def __getattr__(self, name):
            return getattr(file, name)

        def write(self, data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(sink._writer, "_Writer__stream", FullDisk())
    other = MemorySink()
    # The recorder takes over the half-written sink, whose disk is now full.
    monkeypatch.setattr(sink, "open", lambda: None)
    with Recorder([sink, other]) as recorder:
        for document in documents[60:]:
            recorder.emit(document)
    assert "0001.mcap could not be written because the disk is full" in recorder.failed
    assert not (tmp_path / "0001.mcap").exists()
    episode = read_episode(tmp_path / "0001.mcap.partial")
    assert episode.ticks > 20
    assert episode.metadata["end_reason"] == "CRASHED"


def test_file_that_cannot_be_created_is_reported_when_the_recorder_opens(tmp_path):
    (tmp_path / "taken").write_text("")
    (tmp_path / "0002.mcap").write_text("")
    first = McapSink(tmp_path / "0001.mcap")
    with (
        pytest.raises(DataError, match="a file has the path of its folder"),
        Recorder([first, McapSink(tmp_path / "taken" / "x")]),
    ):
        pass
    with pytest.raises(DataError, match="never overwritten"), Recorder([McapSink(tmp_path / "0002.mcap")]):
        pass
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0002.mcap", "taken"]


def test_disk_without_space_is_reported_when_the_recorder_opens(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr("carlab.recording.sink.shutil.disk_usage", lambda path: usage._replace(free=1_000_000))
    for sink in (McapSink(tmp_path / "0001.mcap"), RerunSink(tmp_path / "0001.rrd")):
        with pytest.raises(DataError, match="less than 20 MB are free; free some space"), Recorder([sink]):
            pass
    assert list(tmp_path.iterdir()) == []


def test_close_without_an_end_marks_the_file_as_crashed(tmp_path):
    path = tmp_path / "0001.mcap"

    def loop():
        with Recorder([McapSink(path)]) as recorder:
            for document in make_documents(30, end=False):
                recorder.emit(document)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        loop()
    episode = read_episode(path)
    assert episode.metadata["end_reason"] == "CRASHED"
    assert "recovered" not in episode.metadata
    assert episode.ticks == 29
    assert read_documents(path)[-1].steps == 30
    assert read_documents(path)[-1].total_reward == pytest.approx(sum(0.1 * k for k in range(30)))


def test_first_end_is_kept_and_finishes_the_file_while_the_loop_hangs(tmp_path):
    path = tmp_path / "0001.mcap"
    documents = make_documents(30)
    recorder = Recorder([McapSink(path)])
    recorder.open()
    for document in documents[:40]:
        recorder.emit(document)

    def watchdog():
        recorder.emit(EpisodeEnded(documents[39].t_s, EndReason.LOOP_HUNG, "in the policy", 19, 0.0))
        recorder.close()

    thread = threading.Thread(target=watchdog)
    thread.start()
    thread.join(30.0)
    assert path.exists()
    for document in documents[40:]:  # the loop resumes and emits its own end
        recorder.emit(document)
    recorder.close()
    assert read_episode(path).metadata["end_reason"] == "LOOP_HUNG"
    assert sum(isinstance(d, EpisodeEnded) for d in read_documents(path)) == 1


def test_log_lines_and_early_events_are_recorded(tmp_path):
    path = tmp_path / "0001.mcap"
    documents = make_documents(5)
    logger = logging.getLogger("carlab.test_recording")
    recorder = Recorder([McapSink(path)])
    handler = recorder.log_handler()
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        with recorder:
            recorder.emit(SafetyEvent(1.0, "armed", "before the start"))
            for document in documents[:-1]:
                recorder.emit(document)
            logger.error("the link %s", "is slow")
            recorder.emit(documents[-1])
        logger.error("afterwards")
    finally:
        logger.removeHandler(handler)
    recording = read_recording(path)
    assert [(line.level, line.name, line.message) for line in recording.log if line.name == logger.name] == [
        (logging.ERROR, logger.name, "the link is slow")
    ]
    assert recording.documents[1] == SafetyEvent(1.0, "armed", "before the start")


ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
"""The environment of a process that finds the modules of the tests in any folder."""
WRITER = """
import sys, time
from carlab.recording.mcap.sink import McapSink
from carlab.recording.recorder import Recorder
from carlab.core.documents import Tick
from tests.helpers.episode_documents import documents
recorder = Recorder([McapSink(sys.argv[1])])
recorder.open()
for document in documents(100000, end=False):
    recorder.emit(document)
    if isinstance(document, Tick):
        print(document.step, time.monotonic(), flush=True)
        time.sleep(0.01)
"""


@pytest.mark.realtime
def test_sigkill_loses_at_most_half_a_second(tmp_path):
    path = tmp_path / "0001.mcap"
    command = [sys.executable, "-c", WRITER, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT) as child:
        emitted = []
        for line in child.stdout:
            step, t_s = line.split()
            emitted.append((int(step), float(t_s)))
            if len(emitted) == 200:
                child.send_signal(signal.SIGKILL)
                break
        emitted += [(int(s), float(t)) for s, t in (rest.split() for rest in child.stdout if rest.count(" "))]
    assert child.returncode == -signal.SIGKILL
    assert not path.exists()
    episode = read_episode(path.with_name("0001.mcap.partial"))
    assert episode.metadata["end_reason"] == "CRASHED"
    assert episode.metadata["recovered"] == "true"
    # A flush interval of half a second, and half a second for a delayed writer thread on a busy machine.
    safe = [step for step, t_s in emitted if t_s < emitted[-1][1] - 1.0]
    assert episode.ticks >= len(safe) > 20
    np.testing.assert_array_equal(episode.sent[:, 0], np.sin(0.3 * np.arange(episode.ticks)))


WRITER_WITH_SIZE_LIMIT = """
import resource, sys
from carlab.recording.mcap.sink import McapSink
from carlab.recording.recorder import Recorder
from carlab.recording.rerun.sink import RerunSink
from tests.helpers.episode_documents import documents
folder = sys.argv[1]
recorder = Recorder([McapSink(folder + "/1.mcap"), RerunSink(folder + "/1.rrd"), McapSink(folder + "/2.mcap")])
recorder.open()
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
for document in documents(900):
    recorder.emit(document)
recorder.close()
print(recorder.failed)
"""


@pytest.mark.parametrize("max_bytes", [40_000, 150_000])
def test_file_size_limit_gives_one_sentence_and_readable_partial_files(tmp_path, max_bytes):
    command = [sys.executable, "-c", WRITER_WITH_SIZE_LIMIT, str(tmp_path), str(max_bytes)]
    writer = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120, env=ENVIRONMENT)
    assert " could not be written: File too large" in writer.stdout
    assert "Traceback" not in writer.stdout + writer.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["1.mcap.partial", "1.rrd.partial", "2.mcap.partial"]
    assert read_episode(tmp_path / "1.mcap.partial").ticks > 10


def test_sinks_are_flushed_periodically_without_new_documents():
    sink = MemorySink()
    with Recorder([sink], flush_interval_s=0.01) as recorder:
        recorder.emit(make_documents(1)[0])
        deadline_s = time.monotonic() + 20.0
        while sink.flushes == 0 and time.monotonic() < deadline_s:
            time.sleep(0.005)
        assert sink.flushes > 0
