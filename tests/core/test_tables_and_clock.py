"""Strict tables, the pacer and the angles."""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from carlab.core.angles import align_unwrapped, wrap
from carlab.core.clock import MonotonicClock, Pacer, SimulatedClock
from carlab.core.errors import ConfigError
from carlab.core.tables import from_table


@dataclass(frozen=True)
class Inner:
    gain: float = 1.0


@dataclass(frozen=True)
class Outer:
    port: str
    kind: Literal["a", "b"] = "a"
    count: int = 1
    corners: tuple[tuple[float, float], ...] = ()
    inner: Inner = field(default_factory=Inner)
    maybe: float | None = None


def test_valid_table_becomes_the_dataclass() -> None:
    table = {"port": "/dev/x", "kind": "b", "corners": [[0, 1], [2, 3.5]], "inner": {"gain": 3}, "maybe": 2}
    assert from_table(Outer, table, "[t]") == Outer("/dev/x", "b", 1, ((0.0, 1.0), (2.0, 3.5)), Inner(3.0), 2.0)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({}, ["'port'", "missing", "[t] of car.toml"]),
        ({"port": "x", "cuont": 2}, ["'cuont'", "did you mean 'count'?"]),
        ({"port": "x", "inner": {"gian": 2}}, ["'gian'", "did you mean 'gain'?", "'inner'"]),
        ({"port": "x", "count": 1.5}, ["'count'", "whole number"]),
        ({"port": "x", "count": True}, ["'count'", "whole number"]),
        ({"port": 3}, ["'port'", "text"]),
        ({"port": "x", "kind": "c"}, ["'kind'", "'a', 'b'"]),
        ({"port": "x", "inner": {"gain": math.nan}}, ["'gain'", "NaN"]),
        ({"port": "x", "inner": {"gain": "fast"}}, ["'gain'", "number"]),
        ({"port": "x", "corners": [[0, 1, 2]]}, ["'corners'", "2 entries"]),
        ({"port": "x", "inner": 3}, ["'inner'", "table"]),
    ],
)
def test_bad_table_is_reported_with_its_key(table: dict[str, object], words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        from_table(Outer, table, "[t] of car.toml")
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message


def test_the_pacer_skips_missed_ticks_and_keeps_the_grid() -> None:
    clock = SimulatedClock(5.0)
    pacer = Pacer(clock, 0.1)
    pacer.start()
    assert pacer.wait().deadline_s == pytest.approx(5.1)
    clock.sleep_until(5.47)  # Work took longer than three periods.
    timing = pacer.wait()
    assert timing.deadline_s == pytest.approx(5.4)
    assert timing.late_s == pytest.approx(0.07)
    assert timing.skipped == 2
    assert pacer.wait().deadline_s == pytest.approx(5.5)
    assert pacer.statistics_ms()["skipped"] == 2


def test_rounding_of_deadlines_does_not_accumulate() -> None:
    pacer = Pacer(SimulatedClock(1000.0), 0.1)
    start_s = pacer.start()
    deadlines_s = [pacer.wait().deadline_s for _ in range(20_000)]
    assert deadlines_s == [start_s + 0.1 * k for k in range(1, 20_001)]


@pytest.mark.realtime
def test_the_monotonic_clock_never_returns_early() -> None:
    clock = MonotonicClock()
    for _ in range(20):
        deadline = clock.now_s() + 0.003
        clock.sleep_until(deadline)
        assert clock.now_s() >= deadline


@given(st.floats(-1e3, 1e3))
def test_wrap_keeps_the_direction(angle: float) -> None:
    wrapped = wrap(angle)
    assert -math.pi <= wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


def test_predictions_are_unwrapped_onto_the_measured_angle():
    true = np.linspace(2.5, 10.0, 76)
    starts = [0, 30, 60]
    predicted = np.stack([wrap(true[k]) + (true[k : k + 10] - true[k]) for k in starts])
    whole, shifted = align_unwrapped(wrap(true), starts, predicted)
    assert whole == pytest.approx(true)
    assert shifted == pytest.approx(np.stack([true[k : k + 10] for k in starts]))
