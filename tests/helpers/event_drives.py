"""Drives of the independent generator with planted events: blows, blows that only turn the car, lifts."""

import functools
import math
from dataclasses import dataclass

import numpy as np
from impacts import Blow, Lift

from carlab.benchmark.effects.catalogue import Draw
from carlab.benchmark.effects.forms import all_forms
from carlab.benchmark.world.base_car import BaseCar, draw_nominal
from carlab.benchmark.world.driver import HumanDriver, Track
from carlab.benchmark.world.measurement import Noise, record
from carlab.benchmark.world.physics import World
from carlab.benchmark.world.simulation import drive
from carlab.core.episode_data import EpisodeData
from sim_backends.car_parameters import CarParameters, MocapParameters, SimulatorConfig

FOUND_WITHIN_S = 0.2


@dataclass(frozen=True)
class EventDrive:
    """A recording with its planted events as spans (from, to) [s], and the simulator of its car file."""

    episode: EpisodeData
    spans: tuple[tuple[float, float], ...]
    config: SimulatorConfig

    def missed_and_false(self, found: list) -> tuple[int, int]:
        """Number of planted events that are not found, and of events that were not planted."""
        near = [
            [k for k, e in enumerate(found) if e.from_s <= end + FOUND_WITHIN_S and e.to_s >= begin - FOUND_WITHIN_S]
            for begin, end in self.spans
        ]
        return sum(not own for own in near), len(found) - len({k for own in near for k in own})


@functools.cache
def event_drive(seed: int, kind: str = "", *, length_s: float = 60.0, period_s: float = 1 / 30) -> EventDrive:
    """Drive a car with events every 4 to 8 s. Tests share the result, whose arrays are read-only.

    Args:
        seed: of everything that is drawn.
        kind: "blow" (1 to 3 m/s), "turn" (yaw rate 3 to 8 rad/s), "lift" (by 0.3 to 1.2 m); "effect": no event, but
            physics of the catalogue or outside of it at twice its typical size; empty: neither.
        length_s: length of the recording.
        period_s: control period.
    """
    rng = np.random.default_rng((seed, 78))
    nominal = draw_nominal(rng, period_s)
    car, track = nominal.perturbed(rng), Track(rng)
    world = World(car)
    if kind == "effect":
        forms = list(all_forms().values())
        form = forms[seed % len(forms)]
        form.attach(world, form.sized(2.0 * form.typical, Draw.from_rng(rng, car, track.points)))
    spans = []
    start_s = 4.0 + float(rng.uniform(4.0, 8.0))
    while kind in ("blow", "turn", "lift") and start_s < length_s - 4.0:
        event = _drawn(kind, start_s, rng)
        event.attach(world)
        spans.append((start_s, start_s + event.duration_s))
        start_s += float(rng.uniform(4.0, 8.0))
    human = HumanDriver(car, track, rng)
    driven = drive(world, human, length_s, start=human.start(), rtol=1e-6)
    recording = record(driven, world, Noise(nominal.position_std, nominal.yaw_std), rng)
    sent = recording.commands[:-1]
    episode = EpisodeData(recording.t_s, recording.measured, sent, sent, np.zeros(len(sent)))
    for array in (episode.times_s, episode.states, episode.sent):
        array.setflags(write=False)
    return EventDrive(episode, tuple(spans), _config(nominal))


def _drawn(kind: str, start_s: float, rng: np.random.Generator) -> Blow | Lift:
    heading = rng.uniform(0.0, 2.0 * math.pi)
    size = rng.uniform(0.3, 1.2) if kind == "lift" else rng.uniform(1.0, 3.0)
    along = (float(size * math.cos(heading)), float(size * math.sin(heading)))
    if kind == "lift":
        return Lift(start_s, float(rng.uniform(0.7, 2.0)), along, float(rng.uniform(-3.0, 3.0)))
    contact_s = float(rng.uniform(0.005, 0.05))
    if kind == "turn":
        return Blow(start_s, contact_s, (0.0, 0.0), float(rng.choice((-1.0, 1.0)) * rng.uniform(3.0, 8.0)))
    return Blow(start_s, contact_s, along, float(rng.normal(0.0, 3.0)))


def _config(car: BaseCar) -> SimulatorConfig:
    parameters = CarParameters(
        car.mass, car.yaw_inertia, car.front_axle, car.rear_axle, car.b_front, car.c_front, car.mu_front, car.b_rear,
        car.c_rear, car.mu_rear, car.drive_gain, car.damping, car.max_angle,
    )  # fmt: skip
    mocap = MocapParameters(latency_s=car.latency)
    return SimulatorConfig(parameters, car.control_period, car.command_delay, mocap=mocap)
