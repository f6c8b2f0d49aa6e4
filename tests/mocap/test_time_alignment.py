"""Clock alignment, stream statistics and the client's message schedule, on synthetic times."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mocap.natnet.message_schedule import MessageSchedule
from mocap.natnet.models import MessageId
from mocap.stream_statistics import StreamStatistics
from mocap.time_alignment import ClockAlignment

CLOCK_HZ = 10_000_000.0


class ServerClock:
    """A clock with an offset and a rate error (positive: fast) relative to the host's."""

    def __init__(self, offset_s: float, ppm: float) -> None:
        self.offset_s, self.ppm = offset_s, ppm

    def ticks(self, host_s: float) -> int:
        return round((host_s * (1.0 + self.ppm * 1e-6) + self.offset_s) * CLOCK_HZ)


def echo(alignment: ClockAlignment, clock: ServerClock, sent_s: float, out_s: float, back_s: float) -> None:
    alignment.add_echo(sent_s, clock.ticks(sent_s + out_s), sent_s + out_s + back_s)


def exposure_s(alignment: ClockAlignment, clock: ServerClock, at_s: float) -> float:
    """Estimated host time of an exposure at ``at_s``, of a frame that arrives half a second later."""
    exposure = alignment.exposure(clock.ticks(at_s), clock.ticks(at_s), at_s + 0.5)
    assert exposure.is_aligned
    return exposure.capture_s


def test_alignment_is_unknown_before_the_first_echo() -> None:
    alignment = ClockAlignment(CLOCK_HZ)
    assert not alignment.is_aligned
    assert math.isnan(alignment.round_trip_s)


@pytest.mark.parametrize("offset_s", [-90.0, 0.0, 4.2e5])
@pytest.mark.parametrize("out_s", [1e-5, 5e-4, 9.9e-4])
def test_error_of_one_echo_is_at_most_half_the_round_trip(offset_s: float, out_s: float) -> None:
    clock, alignment = ServerClock(offset_s, 0.0), ClockAlignment(CLOCK_HZ)
    echo(alignment, clock, 100.0, out_s, 1e-3 - out_s)
    assert abs(exposure_s(alignment, clock, 100.1) - 100.1) <= 0.5e-3 + 1e-6
    assert alignment.round_trip_s == pytest.approx(1e-3)


@pytest.mark.parametrize("ppm", [-30.0, 0.0, 30.0])
def test_clock_error_is_small_with_drift_and_jitter(rng: np.random.Generator, ppm: float) -> None:
    """100 s of echoes at 4 Hz; each way takes 0.2 ms plus an exponential queueing delay of 1 ms in the mean."""
    clock, alignment = ServerClock(1234.5, ppm), ClockAlignment(CLOCK_HZ)
    errors_s = []
    for t_s in np.arange(50.0, 150.0, 0.25):
        out_s, back_s = 2e-4 + rng.exponential(1e-3, size=2)
        echo(alignment, clock, float(t_s), float(out_s), float(back_s))
        at_s = float(t_s) + 0.2
        errors_s.append(abs(exposure_s(alignment, clock, at_s) - at_s))
    assert max(errors_s) < 5e-3
    assert max(errors_s[60:]) < 5e-4  # a line through many echoes has a smaller error than one echo
    assert alignment.drift_ppm == pytest.approx(-ppm, abs=8.0)
    assert alignment.resets == 0


def test_drift_without_jitter_is_tracked() -> None:
    clock, alignment = ServerClock(0.0, 30.0), ClockAlignment(CLOCK_HZ)
    for t_s in np.arange(10.0, 40.0, 0.25):
        echo(alignment, clock, float(t_s), 1e-4, 1e-4)
    assert alignment.drift_ppm == pytest.approx(-30.0, abs=1.0)
    assert exposure_s(alignment, clock, 50.0) == pytest.approx(50.0, abs=2e-5)


def test_clock_step_is_accepted_after_three_echoes() -> None:
    before, after, alignment = ServerClock(1000.0, 0.0), ServerClock(7.0, 0.0), ClockAlignment(CLOCK_HZ)
    for i in range(20):
        echo(alignment, before, 10.0 + 0.25 * i, 1e-4, 1e-4)
    echo(alignment, after, 20.0, 1e-4, 1e-4)
    assert alignment.is_uncertain
    assert exposure_s(alignment, before, 20.0) == pytest.approx(20.0, abs=1e-4)
    echo(alignment, before, 20.1, 1e-4, 1e-4)  # a single deviating echo does not change the alignment
    assert not alignment.is_uncertain
    for i in range(3):
        echo(alignment, after, 21.0 + 0.02 * i, 1e-4, 1e-4)
    assert alignment.resets == 1
    assert not alignment.is_uncertain
    assert exposure_s(alignment, after, 21.5) == pytest.approx(21.5, abs=1e-4)


def test_impossible_echoes_are_ignored() -> None:
    alignment = ClockAlignment(CLOCK_HZ)
    alignment.add_echo(10.0, 5, 9.0)
    alignment.add_echo(10.0, 5, 12.0)
    ClockAlignment(0.0).add_echo(10.0, 5, 10.001)
    assert not alignment.is_aligned


def test_exposure_time_uses_the_valid_stamps() -> None:
    clock, alignment = ServerClock(500.0, 0.0), ClockAlignment(CLOCK_HZ)
    exposed, sent = clock.ticks(30.0), clock.ticks(30.004)
    assert ClockAlignment(0.0).exposure(exposed, sent, 30.005).capture_s == 30.005
    assert alignment.exposure(0, 0, 30.005).capture_s == 30.005
    early = alignment.exposure(exposed, sent, 30.005)
    assert (early.capture_s, early.is_aligned) == (pytest.approx(30.001), False)
    echo(alignment, clock, 29.0, 1e-4, 1e-4)
    aligned = alignment.exposure(exposed, sent, 30.005)
    assert (aligned.capture_s, aligned.on_server_s) == (pytest.approx(30.0, abs=1e-6), pytest.approx(0.004))
    assert (aligned.is_aligned, aligned.is_inconsistent) == (True, False)
    waited = alignment.exposure(exposed, sent, 33.0)  # a delayed frame keeps its time
    assert (waited.capture_s, waited.is_inconsistent) == (pytest.approx(30.0, abs=1e-6), True)
    ahead = alignment.exposure(clock.ticks(90.0), clock.ticks(90.004), 30.005)
    assert (ahead.capture_s, ahead.is_aligned, ahead.is_inconsistent) == (pytest.approx(30.001), False, True)
    unsent = alignment.exposure(exposed, 0, 30.005)
    assert (unsent.capture_s, unsent.on_server_s) == (pytest.approx(30.0, abs=1e-6), 0.0)
    mixed = alignment.exposure(exposed, clock.ticks(3000.0), 30.005)
    assert (mixed.capture_s, mixed.on_server_s) == (pytest.approx(30.0, abs=1e-6), 0.0)


# -- statistics -----------------------------------------------------------------------------------------------------


def accepted(numbers: list[int]) -> tuple[list[int | None], dict[str, float]]:
    statistics = StreamStatistics()
    sequences = [statistics.accept(n, 0.01 * i) for i, n in enumerate(numbers)]
    return sequences, statistics.as_mapping()


def test_lost_late_and_repeated_frames_are_counted() -> None:
    sequences, counts = accepted([10, 11, 13, 12, 13, 11, 16, 17])
    assert sequences == [10, 11, 13, None, None, None, 16, 17]
    assert counts["frames"] == 5.0
    assert counts["out_of_order"] == 1.0  # 12 came after 13
    assert counts["repeated"] == 2.0  # 13 and 11 came again
    assert counts["lost"] == 2.0  # 14 and 15
    assert counts["rate_hz"] == pytest.approx(4 / 0.07)


@pytest.mark.parametrize("before", [40, 5000])
def test_sequence_numbers_increase_after_a_restarted_count(before: int) -> None:
    """Sequence numbers keep increasing, also if the new numbers look like those of late frames."""
    sequences, counts = accepted([*range(before), *range(30)])
    accepted_sequences = [s for s in sequences if s is not None]
    assert accepted_sequences == sorted(set(accepted_sequences))
    assert accepted_sequences[-1] > before
    assert counts["restarts"] == 1.0
    assert counts["lost"] == 0.0


def test_repeats_of_every_frame_are_no_restart() -> None:
    _, counts = accepted([n // 2 for n in range(400)])
    assert (counts["frames"], counts["repeated"], counts["restarts"]) == (200.0, 200.0, 0.0)


def test_latency_percentiles_are_those_of_the_window() -> None:
    statistics = StreamStatistics(window=100)
    empty = statistics.as_mapping()
    assert math.isnan(empty["latency_p50_ms"])
    assert math.isnan(empty["rate_hz"])
    for i in range(1000):
        statistics.add_latency(1e-3 * i, 1e-4)
    numbers = statistics.as_mapping()
    window_ms = np.arange(900.0, 1000.0)
    assert numbers["latency_p50_ms"] == pytest.approx(np.percentile(window_ms, 50))
    assert numbers["latency_p99_ms"] == pytest.approx(np.percentile(window_ms, 99))
    assert numbers["server_latency_p50_ms"] == pytest.approx(0.1)


# -- schedule -------------------------------------------------------------------------------------------------------


def sent_in(schedule: MessageSchedule, start_s: float, stop_s: float, **state: bool) -> list[MessageId]:
    return [m for t in np.arange(start_s, stop_s, 0.01) for m in schedule.due(float(t), **state)]


def test_messages_are_sent_on_schedule() -> None:
    schedule = MessageSchedule(keepalives=True)
    sent = sent_in(schedule, 100.0, 103.995, has_clock=True, settled=True)
    assert sent.count(MessageId.KEEPALIVE) == 4
    assert 15 <= sent.count(MessageId.ECHOREQUEST) <= 16
    assert MessageId.CONNECT not in sent
    schedule.note_frame(104.0)
    assert not schedule.reconnecting
    sent = sent_in(schedule, 104.0, 110.5, has_clock=False, settled=True)
    assert sent.count(MessageId.CONNECT) == 3
    assert schedule.reconnecting
    assert MessageId.ECHOREQUEST not in sent
    schedule.note_server_info(110.5)
    assert not schedule.reconnecting
    unsettled = sent_in(MessageSchedule(keepalives=False), 100.0, 101.0, has_clock=True, settled=False)
    assert 30 <= unsettled.count(MessageId.ECHOREQUEST) <= 51
    assert MessageId.KEEPALIVE not in unsettled
    assert MessageId.REQUEST not in unsettled
    polled = sent_in(MessageSchedule(keepalives=False), 100.0, 101.995, has_clock=False, settled=True, polls_mode=True)
    assert polled == [MessageId.REQUEST] * 4


def test_models_are_requested_once_a_second_until_they_arrive() -> None:
    schedule = MessageSchedule(keepalives=False)
    assert sent_in(schedule, 10.0, 11.0, has_clock=False, settled=True) == []
    schedule.models_outdated = True
    assert sent_in(schedule, 11.0, 13.995, has_clock=False, settled=True) == [MessageId.REQUEST_MODELDEF] * 3
    schedule.note_models()
    assert sent_in(schedule, 14.0, 16.0, has_clock=False, settled=True) == []


@pytest.mark.parametrize("flag", ["models_outdated", "models_uncertain"])
def test_change_between_a_request_and_its_answer_is_requested_too(flag: str) -> None:
    schedule = MessageSchedule(keepalives=False)
    schedule.models_outdated = True
    assert schedule.due(10.0, has_clock=False, settled=True) == [MessageId.REQUEST_MODELDEF]
    setattr(schedule, flag, True)
    schedule.note_models()
    assert sent_in(schedule, 10.01, 12.5, has_clock=False, settled=True) != []
    schedule.note_models()
    assert sent_in(schedule, 12.5, 15.0, has_clock=False, settled=True) == []


def test_request_after_missing_frames_does_not_delay_that_after_a_change() -> None:
    schedule = MessageSchedule(keepalives=False)
    schedule.models_uncertain = True
    assert sent_in(schedule, 10.0, 11.495, has_clock=False, settled=True) == [MessageId.REQUEST_MODELDEF] * 2
    schedule.models_outdated = True
    assert schedule.due(11.5, has_clock=False, settled=True) == [MessageId.REQUEST_MODELDEF]
    schedule.note_models()
    assert sent_in(schedule, 11.51, 14.0, has_clock=False, settled=True) == []
