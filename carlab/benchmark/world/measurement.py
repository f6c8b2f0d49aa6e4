"""Measurement of a drive: noise on the pose, velocities by differentiation."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter

from carlab.benchmark.world.physics import World
from carlab.benchmark.world.simulation import Drive, FloatArray
from carlab.core import planar

COLUMNS = ("t", "x", "y", "yaw", "vx", "vy", "yaw_rate", "steering", "throttle")


@dataclass(frozen=True)
class Recording:
    """A recording and its noise-free counterpart.

    t_s (N,), measured (N, 6) as x, y [m], yaw (unwrapped) [rad], vx, vy [m/s], yaw_rate [rad/s]; commands (N, 2);
    error (N, 6) what noise and differentiation add to the noise-free measurement.
    """

    t_s: FloatArray
    measured: FloatArray
    commands: FloatArray
    error: FloatArray

    @property
    def clean(self) -> FloatArray:
        """The noise-free measurement, observation effects included, (N, 6)."""
        return self.measured - self.error


@dataclass(frozen=True)
class Noise:
    """Noise of the pose, and width of the window over which velocities are differentiated."""

    position_std_m: float
    yaw_std_rad: float
    window_s: float = 0.075


def record(drive: Drive, world: World, noise: Noise, rng: np.random.Generator) -> Recording:
    """Measure a drive: noise on every captured pose, velocities by a local parabola, observation effects."""
    pose = drive.captures[:, :3]
    std = np.array([noise.position_std_m, noise.position_std_m, noise.yaw_std_rad])
    noisy = _measure(drive, world, noise, rng.normal(size=pose.shape) * std)
    quiet = _measure(drive, world, noise, np.zeros_like(pose))
    plain = World(world.car)
    bias = _measure(drive, plain, noise, np.zeros_like(pose)) - drive.rows
    return Recording(drive.row_s, noisy, drive.commands, noisy - quiet + bias)


def _measure(drive: Drive, world: World, noise: Noise, added: FloatArray) -> FloatArray:
    gap = (drive.row_s[1] - drive.row_s[0]) / drive.per_row
    pose = drive.captures[:, :3]
    for change in world.pose_changes:
        pose = change(drive.capture_s, pose)
    pose = pose + added
    velocity = body_velocity(pose, gap, window_rows(noise.window_s, gap))
    for change in world.velocity_changes:
        velocity = change(drive.capture_s, velocity)
    return np.concatenate([pose, velocity], axis=1)[:: drive.per_row]


def window_rows(window_s: float, gap_s: float) -> int:
    """Odd number of samples, at least 5, that spans about ``window_s``."""
    return max(5, 2 * round(0.5 * window_s / gap_s) + 1)


def local_fit(values: FloatArray, window: int, order: int, gap_s: float) -> tuple[FloatArray, FloatArray]:
    """Value and slope of a local polynomial (Savitzky and Golay) at every row of (N, k); off-centre at the ends."""
    fitted, slope = (savgol_filter(values, window, order, deriv=k, delta=gap_s, axis=0) for k in (0, 1))
    return fitted, slope


def to_body(yaw: FloatArray, slope: FloatArray) -> FloatArray:
    """World rates of (x, y, yaw), (N, 3), as vx, vy, yaw_rate in the body frame."""
    return np.stack([*planar.to_body(slope[:, 0], slope[:, 1], yaw), slope[:, 2]], axis=1)


def body_velocity(pose: FloatArray, gap_s: float, window: int) -> FloatArray:
    """Body velocities (N, 3) by differentiating the pose (N, 3), each row with the measured yaw."""
    return to_body(pose[:, 2], local_fit(pose, window, 2, gap_s)[1])


def wrapped(yaw: FloatArray) -> FloatArray:
    """Wrap angles (...) to (-pi, pi]."""
    return -np.remainder(-yaw + np.pi, 2 * np.pi) + np.pi


def as_table(recording: Recording) -> dict[str, FloatArray]:
    """Columns (N,) of a recording by name."""
    columns = [recording.t_s, *recording.measured.T, *recording.commands.T]
    table = dict(zip(COLUMNS, columns, strict=True))
    table["yaw"] = wrapped(table["yaw"])
    return table


def write_csv(path: Path, table: dict[str, FloatArray]) -> None:
    """Write columns (N,); empty fields where a value is missing (NaN)."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(table)
        for row in zip(*table.values(), strict=True):
            writer.writerow("" if np.isnan(v) else f"{v:.7g}" if i else f"{v:.6f}" for i, v in enumerate(row))


def read_csv(path: Path) -> dict[str, FloatArray]:
    """Read the columns (N,) of a file of write_csv."""
    with path.open() as file:
        names = file.readline().strip().split(",")
    return dict(zip(names, np.genfromtxt(path, delimiter=",", skip_header=1, dtype=np.float64).T, strict=True))
