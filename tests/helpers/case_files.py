"""Recordings and the car file of a case of the independent generator, written and read as a user would."""

from pathlib import Path

import numpy as np

from carlab.benchmark.cases.case import Case
from carlab.benchmark.world.measurement import write_csv
from carlab.cars import load_car_file
from carlab.core.episode_data import EpisodeData
from carlab.recording.csv.foreign import import_csv
from sim_backends import SimulatorConfig

Table = dict[str, np.ndarray]
"""Columns of a recording."""


def write_case(case: Case, folder: Path) -> Path:
    """Write fit.csv, hold.csv and car.toml; return the folder."""
    write_csv(folder / "fit.csv", case.fit)
    write_csv(folder / "hold.csv", case.hold)
    case.nominal.write(folder / "car.toml")
    return folder


def episodes_in(path: Path) -> list[EpisodeData]:
    return list(import_csv(path).episodes)


def car_in(folder: Path) -> SimulatorConfig:
    return load_car_file(folder / "car.toml").simulator


def imported(table: Table, path: Path) -> list[EpisodeData]:
    """The episodes of a table, written to ``path`` and read again."""
    write_csv(path, table)
    return episodes_in(path)


def rotated(table: Table, angle: float) -> Table:
    """The same drive measured by a camera system whose yaw has the offset ``angle`` [rad]."""
    sin, cos = np.sin(angle), np.cos(angle)
    vx, vy = table["vx"], table["vy"]
    return table | {"yaw": table["yaw"] + angle, "vx": cos * vx + sin * vy, "vy": cos * vy - sin * vx}
