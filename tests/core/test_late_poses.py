"""The gate ends an episode whose poses arrive ever later after their exposure, and no other."""

from collections.abc import Callable

import numpy as np
import pytest
from logging_car import gate

from carlab.core.outcome import EndReason
from carlab.core.quantities import Action, CarState, Observation
from carlab.core.safety import SafetyStop

PERIOD_S = 1.0 / 30.0
NORMAL_S = 0.05
JITTER_S = np.append(0.0, np.random.default_rng(3).exponential(0.06, 1199).clip(max=0.4))


def drive(latency_s: Callable[[int], float], ticks: int = 300) -> tuple[int, list[bool], SafetyStop | None]:
    """Drive with a pose at each tick of that latency; returns the ticks, which were neutral, and the safety stop."""
    safe, car, _ = gate(stale_pose_s=0.1, lost_pose_s=0.5)
    safe.arm()
    for tick in range(ticks):
        car.clock.sleep_until(car.clock.now_s() + PERIOD_S)
        now_s = car.clock.now_s()
        try:
            safe.command(Action(0.0, 0.3), Observation(CarState(), now_s - latency_s(tick), now_s, tick), PERIOD_S)
        except SafetyStop as stop:
            assert car.stops == [False]
            return tick, [a.is_neutral for a in car.log], stop
    return ticks, [a.is_neutral for a in car.log], None


@pytest.mark.parametrize("growth_s", [0.101, 0.2, 0.44])
def test_a_latency_that_has_grown_gives_neutral_and_ends_the_episode(growth_s: float) -> None:
    ticks, neutral, stop = drive(lambda tick: NORMAL_S + (growth_s if tick >= 100 else 0.0))
    assert stop is not None
    assert stop.reason is EndReason.POSE_STALE
    assert f"{(NORMAL_S + growth_s) * 1e3:.0f} ms after their exposure; before, it was 50 ms" in stop.detail
    assert 0.5 < (ticks - 100) * PERIOD_S <= 0.5 + 2.0 * PERIOD_S
    assert neutral == [False] * 100 + [True] * (ticks - 100)


@pytest.mark.parametrize(
    ("latency_s", "neutral_ticks"),
    [
        pytest.param(lambda tick: 0.3, 0, id="constant"),
        pytest.param(lambda tick: NORMAL_S + (0.099 if tick >= 100 else 0.0), 0, id="growth below the limit"),
        pytest.param(lambda tick: NORMAL_S + 100e-6 * tick * PERIOD_S, 0, id="clock drift of 100 ppm"),
        pytest.param(lambda tick: NORMAL_S - 100e-6 * tick * PERIOD_S, 0, id="clock drift of -100 ppm"),
        pytest.param(lambda tick: NORMAL_S + JITTER_S[tick], np.sum(JITTER_S > 0.1), id="jitter"),
        pytest.param(lambda tick: NORMAL_S + (0.3 if 100 <= tick < 115 else 0.0), 15, id="late for half a second"),
    ],
)
def test_jitter_and_drift_of_the_latency_do_not_end_the_episode(
    latency_s: Callable[[int], float], neutral_ticks: int
) -> None:
    ticks, neutral, stop = drive(latency_s, 1200)
    assert stop is None
    assert (ticks, sum(neutral)) == (1200, neutral_ticks)


def test_each_episode_has_its_own_normal_latency() -> None:
    safe, car, _ = gate()
    for latency_s in (0.01, 0.3):
        safe.arm()
        for _ in range(30):
            car.clock.sleep_until(car.clock.now_s() + PERIOD_S)
            now_s = car.clock.now_s()
            sent = safe.command(Action(0.1, 0.0), Observation(CarState(), now_s - latency_s, now_s, 1), PERIOD_S)
            assert not sent.is_neutral
        safe.stop(planned=True)
