"""Draw the curves of a diagnosed DART car beside those that its authors measured by hand, and print differences.

The authors' curves: Lyons et al., "DART: a compact platform for autonomous driving research" (IEEE 10588526);
coefficients of github.com/Lorenzo-Lyons/DART, ``System_identification/dart_dynamic_models.py``,
``model_parameters`` and ``directly_measured_model_parameters`` (commit 267a821). Run by hand:

    python docs/dart_curves.py dart/model.toml 82_*09_16*.csv.gz
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from carlab.api.loaded_recordings import load_recordings
from carlab.cars import load_car_file
from carlab.diagnosis.curves.support import recorded_forces
from carlab.prediction.windows import segments_of
from sim_backends.array_ops import ARRAYS
from sim_backends.dynamics.actuators import ActuatorChain
from sim_backends.dynamics.single_track import SingleTrack
from sim_backends.effects.curves import FrontTyreMap, RearTyreMap

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from carlab.prediction.windows import RecordingSegment
    from sim_backends import SimulatorConfig

    Array = NDArray[np.float64]

IMAGE = Path(__file__).resolve().parent / "images" / "dart-curves.png"
MASS_KG = 1.58
MIN_SUPPORT_S = 0.5
"""Minimum driving time [s] of a bin that is compared."""
AUTHORS, CARLAB = "0.35", "#0072b2"


def authors_angle(command: Array) -> Array:
    """Wheel angle [rad] over the steering command, with the correction of 0.03 that the authors add."""
    shifted = command + 0.0029960 - 0.03
    share = 0.5 * (np.tanh(30.0 * shifted) + 1.0)
    left, right = 0.36576 * np.tanh(1.39293 * shifted), 0.51479 * np.tanh(1.02304 * shifted)
    return np.asarray(share * left + (1.0 - share) * right)


def authors_acceleration(throttle: Array, speed: Array) -> Array:
    """Acceleration [m/s2] on a straight: motor force and rolling friction over the mass."""
    shifted = throttle - 0.163776
    motor = (25.3585 - 4.81533 * speed) * 0.5 * (np.tanh(100.0 * shifted) + 1.0) * shifted
    friction = 1.265988 * np.tanh(7.66637 * speed) + 0.739304 * speed - 0.112315 * speed**2
    return np.asarray((motor - friction) / MASS_KG)


def authors_front(slip: Array) -> Array:
    """Side force of the front axle per load [1] over the slip angle."""
    return np.asarray(0.840686 * np.sin(0.840737 * np.arctan(8.59804 * slip)))


def authors_rear(slip: Array) -> Array:
    """Side force of the rear axle per load [1] over the slip angle."""
    return np.asarray(0.854674 * np.sin(0.959109 * np.arctan(11.54928 * slip)))


class Bench:
    """Steady outputs of a simulator on a virtual test bench."""

    def __init__(self, config: SimulatorConfig) -> None:
        values = {name: np.asarray(value) for name, value in config.values().items()}
        self.chain = ActuatorChain(ARRAYS, values, config.effects)
        self.model = SingleTrack(ARRAYS, config.kind, values, config.effects)

    def angle(self, command: Array) -> Array:
        """Wheel angle [rad] over the steering command."""
        return np.asarray(self.chain.settled_output((command, 0.0 * command))[0])

    def acceleration(self, throttle: Array, speed: Array) -> Array:
        """Acceleration [m/s2] on a straight."""
        zero = 0.0 * speed
        throttle = self.chain.settled_output((zero, throttle))[1]
        state = (zero, zero, zero, speed, zero, zero)
        actuation = self.model.actuation(zero, throttle)
        extra = self.model.settled(0.0, state, actuation)
        return np.asarray(self.model.derivative(0.0, (*state, *extra), actuation)[3])

    def side_force(self, axle: str, slip: Array) -> Array:
        """Side force of an axle per load [1] over the slip angle, without longitudinal force."""
        speed, zero = np.full_like(slip, 2.0), 0.0 * slip
        coast = np.linspace(0.0, 0.5, 2001)
        throttle = np.full_like(slip, coast[np.argmin(np.abs(self.acceleration(coast, np.full_like(coast, 2.0))))])
        state = (zero, zero, zero, speed, -speed * np.tan(slip), zero)
        forces = self.model.evaluate(0.0, state, self.model.actuation(zero, throttle), settle=True)[1]
        assert forces is not None
        side, load = (getattr(forces, f"{name}_{axle}") for name in ("side", "load"))
        return np.asarray(side / load)


@dataclass(frozen=True, slots=True)
class Panel:
    """One panel: input x, curves of both, and the driving time [s] near each x."""

    title: str
    x_label: str
    x: Array
    authors: Array
    carlab: Array
    support_s: Array

    @property
    def supported(self) -> NDArray[np.bool_]:
        """Where the recordings support the curve."""
        return self.support_s >= MIN_SUPPORT_S

    def rms(self) -> tuple[float, float]:
        """Root mean square difference over the supported range by driving time, and that of the authors' curve."""
        weight = self.support_s[self.supported]
        pairs = (self.carlab - self.authors, self.authors - np.average(self.authors[self.supported], weights=weight))
        first, second = (float(np.sqrt(np.average(v[self.supported] ** 2, weights=weight))) for v in pairs)
        return first, second


def time_near(recorded: Array, x: Array, period_s: float) -> Array:
    """Driving time [s] by the nearest point of an even grid."""
    step = x[1] - x[0]
    edges = np.append(x - 0.5 * step, x[-1] + 0.5 * step)
    return np.histogram(recorded, edges)[0] * period_s


def panels(config: SimulatorConfig, segments: list[RecordingSegment]) -> list[Panel]:
    """The four comparisons: steering, drive force at constant throttles, front and rear tyre."""
    bench, period_s = Bench(config), segments[0].period_s
    forces = [recorded_forces(segment, config) for segment in segments]
    steering = np.concatenate([segment.commands[:, 0] for segment in segments])
    throttle, speed = (np.concatenate([getattr(f, name) for f in forces]) for name in ("throttle", "vx"))
    command = np.linspace(-1.0, 1.0, 41)
    made = [
        Panel("wheel angle [rad]", "steering command", command, authors_angle(command), bench.angle(command),
              time_near(steering, command, period_s))
    ]  # fmt: skip
    grid = np.linspace(0.0, 4.0, 21)
    for u in (0.0, 0.2, 0.25, 0.3, 0.4):
        near = np.abs(throttle - u) < 0.025
        here = np.full_like(grid, u)
        made.append(
            Panel(f"acceleration [m/s²], throttle {u:g}", "speed [m/s]", grid, authors_acceleration(here, grid),
                  bench.acceleration(here, grid), time_near(speed[near], grid, period_s))
        )  # fmt: skip
    slips = np.linspace(0.0, 0.6, 31)
    axles: tuple[tuple[str, Callable[[Array], Array], FrontTyreMap | RearTyreMap], ...] = (
        ("front", authors_front, FrontTyreMap()),
        ("rear", authors_rear, RearTyreMap()),
    )
    for axle, authors, curve in axles:
        moving = [np.abs(f.vx) > 0.5 for f in forces]
        recorded = np.concatenate([curve.coordinates(ARRAYS, f)[-1][m] for f, m in zip(forces, moving, strict=True)])
        made.append(
            Panel(f"{axle} side force per load", "slip angle [rad]", slips, authors(slips),
                  bench.side_force(axle, slips), time_near(recorded, slips, period_s))
        )  # fmt: skip
    return made


def draw(found: list[Panel], path: Path) -> None:
    """Draw all panels; the range without recordings is thin."""
    figure, axes = plt.subplots(2, 4, figsize=(13.0, 5.6), layout="constrained")
    for panel, axis in zip(found, axes.flat, strict=True):
        seen = np.where(panel.supported, panel.carlab, np.nan)
        axis.plot(panel.x, panel.authors, color=AUTHORS, linestyle="--", label="authors, by hand")
        axis.plot(panel.x, panel.carlab, color=CARLAB, linewidth=0.7, alpha=0.6)
        axis.plot(panel.x, seen, color=CARLAB, linewidth=2.2, label="carlab, from drives")
        axis.set(title=panel.title, xlabel=panel.x_label)
        axis.title.set_fontsize("medium")
        axis.grid(alpha=0.3)
    axes.flat[0].legend(frameon=False, fontsize="small")
    figure.savefig(path, dpi=90, metadata={"Software": None})
    plt.close(figure)


def main(model: str, *recordings: str) -> None:
    """Draw the picture and print the table for the results page."""
    config = load_car_file(Path(model)).simulator
    loaded = load_recordings([Path(name) for name in recordings], "fit", config.mocap.latency_s)
    found = panels(config, segments_of(loaded.episodes))
    draw(found, IMAGE)
    lines = [
        "| curve | driven range | rms difference | rms of the authors' curve about its mean |",
        "| --- | --- | --- | --- |",
    ]
    for panel in found:
        if panel.supported.any():
            low, high = panel.x[panel.supported][[0, -1]]
            difference, spread = panel.rms()
            lines.append(f"| {panel.title} | {low:.2f} to {high:.2f} | {difference:.3f} | {spread:.3f} |")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
