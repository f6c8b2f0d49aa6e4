"""Data faults, applied to the columns of a finished recording."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.measurement import body_velocity, window_rows, wrapped
from carlab.benchmark.world.simulation import FloatArray
from carlab.core.planar import to_world

Table = dict[str, FloatArray]
Faulty = tuple[Table, tuple[str, ...], int]
"""The columns with a fault, the names of the changed ones, and the number of changed rows."""


def yaw_wrap_spikes(table: Table, rng: np.random.Generator, car: BaseCar) -> Faulty:
    """Yaw rate from the difference of a wrapped angle."""
    gap = car.control_period
    raw = np.gradient(wrapped(table["yaw"]), gap)
    spikes = np.abs(raw) > 0.5 * np.pi / gap
    return {**table, "yaw_rate": np.where(spikes, raw, table["yaw_rate"])}, ("yaw_rate",), int(spikes.sum())


def outliers(table: Table, rng: np.random.Generator, car: BaseCar) -> Faulty:
    """Poses of another marker set: jumps of some decimetres in single rows, with the resulting velocities."""
    out = dict(table)
    count = max(3, len(table["t"]) // 150)
    rows = rng.choice(np.arange(5, len(table["t"]) - 5), count, replace=False)
    jump = rng.uniform(0.15, 0.6, (count, 2)) * rng.choice((-1.0, 1.0), (count, 2))
    out["x"], out["y"] = table["x"].copy(), table["y"].copy()
    out["x"][rows] += jump[:, 0]
    out["y"][rows] += jump[:, 1]
    return _derive(out, car), ("x", "y"), count


def dropouts(table: Table, rng: np.random.Generator, car: BaseCar) -> Faulty:
    """Missing rows, some in runs."""
    keep = np.ones(len(table["t"]), dtype=bool)
    for _ in range(max(2, len(keep) // 250)):
        first = int(rng.integers(5, len(keep) - 15))
        keep[first : first + int(rng.integers(1, 9))] = False
    return {name: column[keep] for name, column in table.items()}, ("t",), int((~keep).sum())


def stale_samples(table: Table, rng: np.random.Generator, car: BaseCar) -> Faulty:
    """The logger repeats the last pose and velocity if no new sample has arrived."""
    source = np.arange(len(table["t"]))
    for _ in range(max(3, len(source) // 60)):
        first = int(rng.integers(5, len(source) - 10))
        run = int(rng.integers(1, 5))
        source[first : first + run] = source[first - 1]
    moved = {"x", "y", "yaw", "vx", "vy", "yaw_rate"}
    stale = int((source != np.arange(len(source))).sum())
    out = {name: column[source] if name in moved else column for name, column in table.items()}
    return out, tuple(sorted(moved)), stale


def clock_drift(table: Table, rng: np.random.Generator, car: BaseCar) -> Faulty:
    """Commands logged by another clock that drifts by up to some milliseconds per second."""
    rate = float(rng.choice((-1.0, 1.0)) * rng.uniform(1e-3, 4e-3))
    source = np.clip(np.searchsorted(table["t"], table["t"] * (1.0 + rate), side="right") - 1, 0, len(table["t"]) - 1)
    names = ("steering", "throttle")
    return {**table, **{name: table[name][source] for name in names}}, names, len(source)


def column_shift(table: Table, rng: np.random.Generator, car: BaseCar) -> Faulty:
    """A command column shifted by some rows."""
    name = str(rng.choice(("steering", "throttle")))
    rows = int(rng.choice((-1, 1)) * rng.integers(4, 12) * max(1, round(1.0 / 30.0 / car.control_period)))
    return {**table, name: np.roll(table[name], rows)}, (name,), len(table["t"])


def column_scale(table: Table, rng: np.random.Generator, car: BaseCar) -> Faulty:
    """A velocity column with a wrong factor."""
    name = str(rng.choice(("vx", "yaw_rate")))
    return {**table, name: table[name] * float(rng.choice((0.5, 0.8, 1.25, 2.0)))}, (name,), len(table["t"])


def wrong_unit(table: Table, rng: np.random.Generator, car: BaseCar) -> Faulty:
    """Degrees instead of radians, millimetres instead of metres or milliseconds instead of seconds."""
    columns, scale = (
        (("yaw",), 180.0 / np.pi),
        (("yaw_rate",), 180.0 / np.pi),
        (("x", "y"), 1000.0),
        (("t",), 1000.0),
    )[int(rng.integers(4))]
    return {**table, **{name: table[name] * scale for name in columns}}, columns, len(table["t"])


def wrong_sign(table: Table, rng: np.random.Generator, car: BaseCar) -> Faulty:
    """A column with the opposite sign."""
    name = str(rng.choice(("yaw_rate", "steering", "vy", "throttle")))
    return {**table, name: -table[name]}, (name,), len(table["t"])


def wrong_frame(table: Table, rng: np.random.Generator, car: BaseCar) -> Faulty:
    """Velocities in the world frame."""
    vx, vy = to_world(table["vx"], table["vy"], table["yaw"])
    return {**table, "vx": vx, "vy": vy}, ("vx", "vy"), len(table["t"])


def _derive(table: Table, car: BaseCar) -> Table:
    pose = np.stack([table["x"], table["y"], np.unwrap(table["yaw"])], axis=1)
    velocity = body_velocity(pose, car.control_period, window_rows(0.075, car.control_period))
    return {**table, "vx": velocity[:, 0], "vy": velocity[:, 1]}


FAULTS: dict[str, Callable[[Table, np.random.Generator, BaseCar], Faulty]] = {
    fault.__name__: fault
    for fault in (
        yaw_wrap_spikes,
        outliers,
        dropouts,
        stale_samples,
        clock_drift,
        column_shift,
        column_scale,
        wrong_unit,
        wrong_sign,
        wrong_frame,
    )
}
