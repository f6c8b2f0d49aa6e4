"""Documents of an episode as a control loop emits them, with values that are hard to store exactly."""

import math
from collections.abc import Iterator

import numpy as np

from carlab.core.documents import Document, EpisodeEnded, EpisodeStarted, HealthReading, SafetyEvent, Tick, Transition
from carlab.core.outcome import EndReason
from carlab.core.quantities import Action, CarState, Health, Observation, PoseSample, Reality

PERIOD_S = 1.0 / 30.0
START_S = 86_413.123456789
ARENA_M = ((-1.4, -2.6), (2.8, -2.6), (2.8, 1.5), (-1.4, 1.5))


def _state(k: int) -> CarState:
    angle = 0.9 * k * PERIOD_S
    return CarState(math.cos(angle), math.sin(angle), math.remainder(angle + math.pi / 2, math.tau), 0.9, 0.01, 0.9)


def _observation(k: int) -> Observation:
    t_s = START_S + k * PERIOD_S
    poses = tuple(
        PoseSample(
            10 * k + i, t_s - 0.010 + 0.002 * i, t_s - 0.004 + 0.002 * i, 0.1 + 1e-17 * k, -0.0, 3.1, 0.05, i != 1
        )
        for i in range(3)
    )
    return Observation(_state(k), t_s - 0.006, t_s - 0.001, 10 * k + 2, k != 3, 0.025, poses)


def documents(ticks: int, *, end: bool = True) -> Iterator[Document]:
    yield EpisodeStarted(
        episode=7,
        t_s=START_S - 0.5,
        wall_ns=1_795_000_000_123_456_789,
        car="paper car",
        reality=Reality.EMULATED,
        policy="circle",
        task="parking",
        seed=2**40 + 1,
        period_s=PERIOD_S,
        history_length=3,
        goal=(0.0, -0.0, math.pi),
        arena_m=ARENA_M,
        path_m=((0.0, 0.0), (1.0, 0.1)),
        config_toml='name = "Zürich"\n',
        metadata={"note": "ein Schlüssel"},
    )
    rng = np.random.default_rng(3)
    features = rng.normal(size=13)
    for k in range(ticks):
        t_s = START_S + k * PERIOD_S
        if k % 30 == 0:
            yield HealthReading(
                t_s, Health(k == 0, ("battery low",) if k else (), {"battery_v": 7.4 - 0.1 * k}, ("battery soon low",))
            )
        if k == 5:
            yield SafetyEvent(t_s, "clip", "steering +1.3 was clipped to +1.0")
        following = rng.normal(size=13)
        sent = Action(math.sin(0.3 * k), 0.2)
        requested = Action(1.5 * math.sin(0.3 * k), 0.2 if k != 2 else math.nan)
        late_s = abs(rng.normal()) * 1e-4
        yield Tick(k, t_s, late_s, _observation(k), features, requested, sent, 0.0012, "driving")
        yield Transition(k, t_s + PERIOD_S, features, sent, 0.1 * k, following, k == ticks - 1, False)
        features = following
    if end:
        yield EpisodeEnded(
            t_s=START_S + ticks * PERIOD_S + 0.004,
            reason=EndReason.GOAL_REACHED,
            detail="within 0.1 m",
            steps=ticks,
            total_reward=sum(0.1 * k for k in range(ticks)),
            last=_observation(ticks),
            statistics={"late_p50_ms": 0.1, "skipped": 0.0},
        )


def make_documents(ticks: int = 60, *, end: bool = True) -> list[Document]:
    return list(documents(ticks, end=end))
