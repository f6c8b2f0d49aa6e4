"""A drive in closed form, computed without code of the package: the true value of every number in a file is known."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

DELAY_S = 0.1
NODES, NODE_WEIGHTS = np.polynomial.legendre.leggauss(10)


def yaw(t):
    return 2.0 * np.sin(0.5 * t) + 0.6 * t


def yaw_rate(t):
    return np.cos(0.5 * t) + 0.6


def speed(t):
    return 0.4 + 1.2 * np.sin(0.35 * t) + 0.15 * np.sin(4.0 * t)  # forward and backward


def acceleration(t):
    return 0.42 * np.cos(0.35 * t) + 0.6 * np.cos(4.0 * t)


def drive(t: np.ndarray) -> dict[str, np.ndarray]:
    """Channels of a drive without slip at stamps ``t``; the motion follows the commands with a delay of DELAY_S.

    Curvature = 8 * steering (clipped) and acceleration = 5 * throttle - speed.
    """
    half = 0.5 * np.diff(t)[:, None]  # Gauss-Legendre quadrature in each step; its error is below 1e-12 m
    at = t[:-1, None] + half * (1.0 + NODES)
    steps = [(half * NODE_WEIGHTS * speed(at) * direction(yaw(at))).sum(axis=1) for direction in (np.cos, np.sin)]
    x, y = (np.concatenate([[0.0], np.cumsum(step)]) for step in steps)
    t_of_command = t + DELAY_S
    v = speed(t_of_command)
    bounded_speed = np.where(np.abs(v) < 0.25, np.copysign(0.25, v), v)
    return {
        "t": t,
        "x": x,
        "y": y,
        "yaw": (yaw(t) + np.pi) % (2 * np.pi) - np.pi,
        "vx": speed(t),
        "vy": np.zeros_like(t),
        "yaw_rate": yaw_rate(t),
        "steering": np.clip(yaw_rate(t_of_command) / bounded_speed / 8.0, -1, 1),
        "throttle": (acceleration(t_of_command) + v) / 5.0,
    }


def write(path: Path, columns: dict[str, np.ndarray], delimiter: str = ",") -> Path:
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file, delimiter=delimiter)
        out.writerow(columns)
        out.writerows(zip(*(np.asarray(c).tolist() for c in columns.values()), strict=True))
    return path
