"""The log of an emulated firmware on a full or missing disk: one warning, and the entries stay in memory."""

import json
import logging
import os
import threading
from pathlib import Path

import pytest

from drivers.emulators.command_log import CommandLog, LogEntry
from tests.helpers.waiting import TIMEOUT_S

FULL = Path("/dev/full")


@pytest.mark.skipif(not FULL.exists(), reason="needs /dev/full, a device whose every write fails with ENOSPC")
def test_full_disk_is_reported_once_and_entries_stay_in_memory(caplog: pytest.LogCaptureFixture) -> None:
    log = CommandLog(FULL)
    log.open()
    with caplog.at_level(logging.WARNING):
        for k in range(3):
            log.add(float(k), "current", 1.0)
    log.close()
    assert [e.t_s for e in log.entries("current")] == [0.0, 1.0, 2.0]
    assert len(caplog.messages) == 1
    assert "(No space left on device); free some disk space." in caplog.messages[0]


def test_firmware_does_not_wait_for_a_file_that_takes_no_more_bytes(tmp_path: Path) -> None:
    """A pipe that no program reads takes 64 KiB; a busy disk also stops a program that writes."""
    path = tmp_path / "firmware.jsonl"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    log = CommandLog(path)
    log.open()
    firmware = threading.Thread(target=lambda: [log.add(float(k), "current", 1.0) for k in range(2000)], daemon=True)
    firmware.start()
    firmware.join(TIMEOUT_S)
    assert not firmware.is_alive()
    os.set_blocking(reader, True)
    closing = threading.Thread(target=log.close)
    closing.start()
    with os.fdopen(reader) as lines:
        assert [LogEntry(**json.loads(line)) for line in lines] == log.entries()
    closing.join()


def test_warning_about_a_folder_advises_another_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    log = CommandLog(tmp_path)
    log.open()
    log.close()
    assert "(Is a directory); choose another file." in caplog.messages[0]


def test_log_of_a_run_whose_folder_was_removed_stays_in_memory(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """^C before the first episode removes the folder while the emulated car starts."""
    log = CommandLog(tmp_path / "removed" / "firmware.jsonl")
    log.open()
    log.add(0.0, "current", 1.0)
    assert len(log.entries()) == 1
    assert not caplog.records
