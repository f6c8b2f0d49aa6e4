"""The motor stops after the failure of any process or connection.

Each case runs a program that drives the emulated car over the whole hardware path and injects one failure. The tests
check the command log of the emulated firmware and the recording.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from carlab.core.episode_data import EpisodeData
from carlab.recording.mcap.source import read_episode
from drivers.emulators.command_log import LogEntry, read_log

PROGRAM = Path(__file__).with_name("driving_program.py")
BREAK_AT_TICK = 25

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(120)]


@dataclass
class Driving:
    """A running driving program."""

    process: subprocess.Popen[str]
    run: Path
    main: int
    sender: int
    world: int
    last_line: str = ""

    def until(self, start: str) -> str:
        """Read the output up to a line that begins with ``start``; fails at the end of the output."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.last_line = line.strip()
            if self.last_line.startswith(start):
                return self.last_line
        raise AssertionError(f"the program ended before '{start}'; its last line was '{self.last_line}'")

    def end(self) -> int:
        """Wait for the end of the program and return its exit code."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.last_line = line.strip()
        return self.process.wait()

    def firmware_log(self, settled_s: float = 2.5) -> list[LogEntry]:
        """Entries of the firmware, once they end with the sender's neutral commands or with the motor time-out."""
        deadline_s = time.monotonic() + settled_s + 5.0
        while time.monotonic() < deadline_s:
            log = read_log(self.run / "firmware.jsonl")
            motor = [e for e in log if e.name in ("current", "brake", "duty")]
            quiet = bool(motor) and time.monotonic() - motor[-1].t_s > settled_s - 1.0
            if quiet or any(e.name == "motor_timeout" for e in log):
                return log
            time.sleep(0.05)
        return read_log(self.run / "firmware.jsonl")

    @property
    def recording(self) -> EpisodeData:
        """The finished recording."""
        assert not list(self.run.glob("episodes/*.mcap.partial"))
        return read_episode(self.run / "episodes" / "0001.mcap")


@contextmanager
def driving(folder: Path, misbehaviour: str) -> Iterator[Driving]:
    process = subprocess.Popen(
        [sys.executable, str(PROGRAM), str(folder), misbehaviour],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line, process.stderr.read() if process.stderr else ""
        facts = json.loads(line)
        yield Driving(process, Path(facts["run"]), facts["main"], facts["sender"], facts["world"])
    finally:
        process.kill()
        process.wait()
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()


def assert_neutral_at_the_end(log: list[LogEntry], min_commands: int = 3, min_duration_s: float = 0.055) -> None:
    """The last ``min_commands`` motor commands over ``min_duration_s`` are zero current; the servo is centred."""
    motor = [e for e in log if e.name in ("current", "brake", "duty")]
    assert any(e.value > 0.5 for e in motor), "the car never drove"
    neutral: list[LogEntry] = []
    for entry in reversed(motor):
        if entry.value != 0.0:
            break
        neutral.append(entry)
    assert len(neutral) >= min_commands, f"only {len(neutral)} neutral commands at the end"
    assert neutral[0].t_s - neutral[-1].t_s >= min_duration_s
    servo = [e for e in log if e.name == "servo"]
    assert servo[-1].value == pytest.approx(0.5)


@pytest.mark.usefixtures("default_hangup")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_ends_the_episode_with_stop_requested(tmp_path: Path, number: signal.Signals) -> None:
    with driving(tmp_path, "well_behaved") as program:
        program.until(f"tick {BREAK_AT_TICK}")
        os.kill(program.main, number)
        assert program.end() == 0
        assert program.last_line == "ended STOP_REQUESTED"
        assert_neutral_at_the_end(program.firmware_log())
        recording = program.recording
        assert recording.metadata["end_reason"] == "STOP_REQUESTED"
        assert recording.ticks >= BREAK_AT_TICK


@pytest.mark.parametrize(
    ("misbehaviour", "reason"),
    [
        ("policy_error", "POLICY_ERROR"),
        ("nan", "BAD_COMMAND"),
        ("recorder_error", "RECORDER_ERROR"),
        ("mocap_silent", "POSE_STALE"),
        ("mocap_hidden", "TRACKING_LOST"),
        ("mocap_jump", "POSE_JUMP"),
    ],
)
def test_error_ends_the_episode_in_neutral_with_its_reason(tmp_path: Path, misbehaviour: str, reason: str) -> None:
    with driving(tmp_path, misbehaviour) as program:
        assert program.end() == 4
        assert program.last_line == f"ended {reason}"
        assert_neutral_at_the_end(program.firmware_log())
        assert program.recording.metadata["end_reason"] == reason


def test_unexpected_exception_stops_the_car_and_is_raised(tmp_path: Path) -> None:
    with driving(tmp_path, "mocap_error") as program:
        assert program.end() == 1
        assert program.process.stderr is not None
        assert "TypeError" in program.process.stderr.read()
        assert_neutral_at_the_end(program.firmware_log())
        recording = program.recording
        assert recording.metadata["end_reason"] == "CRASHED"
        assert "TypeError" in recording.metadata["end_detail"]


@pytest.mark.parametrize("misbehaviour", ["hang_sleep", "hang_busy"])
def test_hung_loop_is_stopped_by_the_loop_watch(tmp_path: Path, misbehaviour: str) -> None:
    with driving(tmp_path, misbehaviour) as program:
        assert program.end() == 4
        assert program.last_line == "abandoned LOOP_HUNG"
        log = program.firmware_log()
        assert_neutral_at_the_end(log)
        # The sender's watchdog acted long before the loop watch did: no moving command after 0.15 s of silence.
        moving = [e for e in log if e.name == "current" and e.value != 0.0]
        recording = program.recording
        assert recording.metadata["end_reason"] == "LOOP_HUNG"
        assert moving[-1].t_s - recording.times_s[-1] < 0.4


def test_second_interrupt_stops_a_hung_loop_at_once(tmp_path: Path) -> None:
    with driving(tmp_path, "hang_sleep") as program:
        program.until("tick 19")
        time.sleep(0.2)
        for _ in range(2):
            os.kill(program.main, signal.SIGINT)
            time.sleep(0.05)
        assert program.end() == 4
        assert program.last_line == "abandoned STOP_REQUESTED"
        assert_neutral_at_the_end(program.firmware_log())
        assert program.recording.metadata["end_reason"] == "STOP_REQUESTED"


def test_unplugged_port_latches_a_fault_and_the_firmware_times_out(tmp_path: Path) -> None:
    with driving(tmp_path, "unplug") as program:
        assert program.end() == 4
        assert program.last_line == "ended ACTUATOR_FAULT"
        log = read_log(program.run / "firmware.jsonl")
        unplugged_s = next(e.t_s for e in log if e.name == "unplug")
        # No process sends to the port afterwards: nothing re-arms.
        assert not [e for e in log if e.t_s > unplugged_s + 0.05 and e.name in ("current", "servo")]
        timeout = next(e for e in log if e.name == "motor_timeout")
        assert unplugged_s + 0.9 < timeout.t_s < unplugged_s + 1.5
        assert program.recording.metadata["end_reason"] == "ACTUATOR_FAULT"


def test_killed_program_ends_in_neutral_with_a_recoverable_recording(tmp_path: Path) -> None:
    with driving(tmp_path, "well_behaved") as program:
        program.until(f"tick {BREAK_AT_TICK}")
        os.kill(program.main, signal.SIGKILL)
        program.process.wait()
        log = program.firmware_log()
        assert_neutral_at_the_end(log)
        partial = program.run / "episodes" / "0001.mcap.partial"
        recovered = read_episode(partial)
        assert recovered.ticks >= BREAK_AT_TICK - 18  # At most half a second is lost.
        assert recovered.metadata["recovered"] == "true"
        assert recovered.metadata["end_reason"] == "CRASHED"


def test_exit_without_cleanup_ends_in_neutral(tmp_path: Path) -> None:
    with driving(tmp_path, "exit") as program:
        assert program.end() == 7
        assert_neutral_at_the_end(program.firmware_log())


def test_killed_sender_ends_in_the_time_out_of_the_firmware(tmp_path: Path) -> None:
    with driving(tmp_path, "well_behaved") as program:
        program.until(f"tick {BREAK_AT_TICK}")
        killed_s = time.monotonic()
        os.kill(program.sender, signal.SIGKILL)
        assert program.end() == 4
        assert program.last_line == "ended ACTUATOR_FAULT"
        log = program.firmware_log()
        timeouts = [e for e in log if e.name == "motor_timeout"]
        assert timeouts, "the firmware did not time out"
        assert timeouts[0].t_s - killed_s < 2.0
        assert not [e for e in log if e.name == "current" and e.t_s > killed_s + 0.1]
        assert program.recording.metadata["end_reason"] == "ACTUATOR_FAULT"


def test_hung_sender_ends_with_actuator_fault_and_not_with_loop_hung(tmp_path: Path) -> None:
    with driving(tmp_path, "well_behaved") as program:
        program.until(f"tick {BREAK_AT_TICK}")
        os.kill(program.sender, signal.SIGSTOP)
        suspended_s = time.monotonic()
        assert program.end() == 4
        assert program.last_line == "ended ACTUATOR_FAULT"
        assert "sender process hangs" in program.recording.metadata["end_detail"]
        log = program.firmware_log()
        assert any(e.name == "motor_timeout" for e in log)
        assert not [e for e in log if e.name == "current" and e.value != 0.0 and e.t_s > suspended_s + 0.1]
    assert not process_exists(program.sender)


def test_killed_emulator_ends_the_episode_and_leaves_no_process(tmp_path: Path) -> None:
    with driving(tmp_path, "world_dies") as program:
        assert program.end() == 4
        assert program.last_line in ("ended ACTUATOR_FAULT", "ended POSE_STALE")
        assert program.recording.ticks >= 15
    assert not process_exists(program.sender)


def process_exists(pid: int) -> bool:
    """Whether a process exists, zombies included."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_suspended_program_is_stopped_by_its_sender(tmp_path: Path) -> None:
    with driving(tmp_path, "well_behaved") as program:
        program.until(f"tick {BREAK_AT_TICK}")
        os.kill(program.main, signal.SIGSTOP)
        suspended_s = time.monotonic()
        time.sleep(1.0)
        log = read_log(program.run / "firmware.jsonl")
        os.kill(program.main, signal.SIGCONT)
        moving = [e for e in log if e.name == "current" and e.value != 0.0]
        assert moving[-1].t_s < suspended_s + 0.4
        # A fault that was latched during the suspension stays latched afterwards.
        assert program.end() == 4
        moving_afterwards = [e for e in program.firmware_log() if e.name == "current" and e.value != 0.0]
        assert moving_afterwards[-1].t_s < suspended_s + 0.4
        assert program.recording.metadata["end_reason"] in ("ACTUATOR_FAULT", "POSE_STALE", "LOOP_HUNG")


def test_pause_of_the_whole_computer_ends_the_episode_with_its_reason(tmp_path: Path) -> None:
    """All processes stop for 0.8 s and resume together: neither the sender nor the control loop hangs."""
    with driving(tmp_path, "well_behaved") as program:
        program.until(f"tick {BREAK_AT_TICK}")
        processes = (program.main, program.sender, program.world)
        for pid in processes:
            os.kill(pid, signal.SIGSTOP)
        time.sleep(0.8)
        resumed_s = time.monotonic()
        for pid in processes:
            os.kill(pid, signal.SIGCONT)
        assert program.end() == 4
        log = program.firmware_log()
        assert_neutral_at_the_end(log)
        recording = program.recording
        reason = recording.metadata["end_reason"]
        assert program.last_line == f"ended {reason}"
        assert reason in ("ACTUATOR_FAULT", "POSE_STALE")
        assert "hangs" not in recording.metadata["end_detail"]
        moving = [e for e in log if e.name == "current" and e.value != 0.0 and e.t_s > resumed_s]
        assert len(moving) <= 3, "commands in transmission"
