"""The emulated firmware: the kill tests rely on its time-outs and checks."""

from __future__ import annotations

import contextlib
import os
import select
import time
from pathlib import Path
from typing import Any

import pytest

from drivers.emulators.command_log import CommandLog, read_log
from drivers.emulators.faults import WireFaults
from drivers.emulators.serial_firmware import SerialFirmware
from drivers.emulators.vesc_firmware import VescFirmware
from drivers.speed import sender_lateness
from drivers.vesc.payloads import MotorValues, decode_reply, set_current
from tests.helpers.waiting import until


def test_motor_times_out_and_only_motor_commands_reset_its_timer() -> None:
    moves: list[tuple[float, str, float]] = []
    servo: list[tuple[float, float]] = []
    firmware = VescFirmware(
        CommandLog(),
        on_motor=lambda t, kind, value: moves.append((t, kind, value)),
        on_servo=lambda t, position: servo.append((t, position)),
        motor_timeout_s=1.0,
    )
    firmware.poll(50.0)
    assert moves == [], "nothing to release before the first command"
    assert firmware.handle(bytes.fromhex("06000005dc"), 100.0) is None
    firmware.handle(bytes.fromhex("0c0352"), 100.5)
    firmware.handle(b"\x04", 100.9)
    firmware.handle(b"\x00", 100.95)
    firmware.poll(101.0)
    assert moves == [(100.0, "current", 1.5)]
    firmware.poll(101.001)
    firmware.poll(105.0)
    assert moves == [(100.0, "current", 1.5), (101.001, "release", 0.0)], "released once"
    assert servo == [(100.5, 0.85)]
    firmware.handle(bytes.fromhex("07fffffa24"), 110.0)
    firmware.handle(bytes.fromhex("0500004e20"), 110.1)
    firmware.handle(bytes.fromhex("1e"), 111.0)
    firmware.poll(111.9)
    assert moves[2:] == [(110.0, "brake", -1.5), (110.1, "duty", 0.2)], "works again at once; ALIVE resets the timer"


@pytest.mark.parametrize(("name", "value"), [("fault_code", 2), ("kill_switch", True)])
def test_fault_and_kill_switch_release_the_motor(name: str, value: int) -> None:
    moves: list[tuple[str, float]] = []
    firmware = VescFirmware(CommandLog(), on_motor=lambda t, kind, value: moves.append((kind, value)))
    firmware.handle(set_current(1.5), 100.0)
    setattr(firmware, name, value)
    firmware.handle(set_current(1.5), 100.01)
    assert moves == [("current", 1.5), ("release", 0.0)]
    assert [e.value for e in firmware.log.motor()] == [1.5, 1.5], "the log has the commands that arrived"


def test_replies_have_the_real_layout(vesc_vectors: list[dict[str, Any]]) -> None:
    vector = next(v for v in vesc_vectors if v["kind"] == "get_values_selective")
    readings = MotorValues(erpm=-12345.0, input_v=14.8, tachometer_steps=-77.0, fault_code=7)
    firmware = VescFirmware(CommandLog(), readings=lambda t_s: readings)
    reply = firmware.handle(bytes.fromhex("320020a180"), 0.0)
    assert reply is not None
    assert reply.hex() == vector["hex"][4:-6]
    full = firmware.handle(b"\x04", 0.0)
    assert full is not None
    assert len(full) == 74, "as firmware 6"
    firmware.readings = lambda t_s: MotorValues(erpm=float("nan"))
    diverged = firmware.handle(b"\x04", 0.0)
    assert diverged is not None
    values = decode_reply(diverged)
    assert isinstance(values, MotorValues)
    assert values.erpm == 0.0


@pytest.mark.parametrize("payload", [b"", b"\x06\x00", b"\x0c", b"\xff\x00", b"\x32\x00"])
def test_invalid_payloads_are_ignored(payload: bytes) -> None:
    firmware = VescFirmware(CommandLog())
    assert firmware.handle(payload, 0.0) is None
    assert firmware.log.motor() == []


def read_some(descriptor: int, count: int) -> bytes:
    data = b""
    end_s = time.monotonic() + 20.0
    while len(data) < count and time.monotonic() < end_s:
        if select.select([descriptor], [], [], 0.1)[0]:
            data += os.read(descriptor, count - len(data))
    return data


def test_reconnecting_host_with_captured_bytes_is_answered(tmp_path: Path, vesc_vectors: list[dict[str, Any]]) -> None:
    """A minimal host that uses captured bytes instead of this project's encoder."""
    log = CommandLog(tmp_path / "log.jsonl")
    request = bytes.fromhex("020100000003")
    with SerialFirmware(VescFirmware(log), link=tmp_path / "vesc") as served:
        for _ in range(3):
            host = os.open(served.port, os.O_RDWR | os.O_NOCTTY)
            os.write(host, b"\x02\xff garbage" + bytes(260) + request)
            reply = read_some(host, 42)
            assert reply[:5] == bytes.fromhex("0225000605")
            assert b"EMULATED" in reply
            os.write(host, bytes.fromhex("020506000005dc388103"))
            assert log.wait_for("current", 20.0, log.entries("firmware")[-1].t_s) is not None
            t_s = time.monotonic()
            os.close(host)
            assert log.wait_for("hang_up", 20.0, t_s) is not None
        assert [e.value for e in log.motor()] == [1.5] * 3
        until(lambda: read_log(tmp_path / "log.jsonl") == log.entries())
    assert not (tmp_path / "vesc").is_symlink()


def test_no_other_terminal_gets_the_name_of_an_unplugged_one() -> None:
    """A sender that reconnects by the name of its port must not find the firmware of another car."""
    with contextlib.ExitStack() as stack:
        first = stack.enter_context(SerialFirmware(VescFirmware(CommandLog())))
        name = first.port
        first.unplug()
        assert not Path(name).exists()
        later = [stack.enter_context(SerialFirmware(VescFirmware(CommandLog()))) for _ in range(4)]
        assert name not in [firmware.port for firmware in later]
        first.replug()
        assert Path(first.port).exists()


def test_wire_faults_drop_and_corrupt_frames() -> None:
    faults = WireFaults(drop_share=0.3, corrupt_share=0.3, seed=5)
    passed = [faults.transmit(b"\x00\x00\x00\x00") for _ in range(2000)]
    assert passed.count(b"") == faults.dropped
    assert 500 < faults.dropped < 700
    broken = [p for p in passed if p not in (b"", b"\x00\x00\x00\x00")]
    assert len(broken) == faults.corrupted
    assert all(sum(b.bit_count() for b in p) == 1 for p in broken)


@pytest.mark.realtime
def test_lateness_is_measured_in_both_conditions() -> None:
    """The benchmark holds the limits; this test checks that the figures come from a sender that ran."""
    figures = sender_lateness(0.7, rates_hz=(100.0,))
    for condition in ("idle", "loaded"):
        p50, p99, top = (figures[f"sender_100_hz_{condition}_late_{k}_ms"] for k in ("p50", "p99", "max"))
        assert 0.0 < p50 <= p99 <= top
    assert figures["sender_100_hz_loaded_to_idle_p99_ratio"] > 0.0
