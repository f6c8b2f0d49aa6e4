"""Measurement of the latency from decision to wheels and from cameras to decision, by part."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from carlab.cars.emulated_car import EmulatedCar
from carlab.core.car import Car
from carlab.core.clock import Pacer
from carlab.core.quantities import Action, FloatArray

COMMAND_TO_WIRE = "command to wire"
WIRE_TO_FIRMWARE = "wire to firmware"
EXPOSURE_TO_ARRIVAL = "exposure to arrival"
ARRIVAL_TO_LOOP = "arrival to loop"
TICKS = 90
"""Number of commands whose latency is measured."""


@dataclass(frozen=True, slots=True)
class LatencyParts:
    """Samples [s] of each measured part by its name, each (n,)."""

    parts: Mapping[str, FloatArray]

    def rows(self) -> list[tuple[str, float, float, float, int]]:
        """For each part: name, median, 99th percentile and maximum [ms], and count."""
        table = []
        for name, samples in self.parts.items():
            p50, p99, top = np.percentile(samples, [50, 99, 100]) * 1e3
            table.append((name, float(p50), float(p99), float(top), len(samples)))
        return table


def measure_pose_latency(car: Car, *, seconds: float = 2.0, period_s: float = 1.0 / 30.0) -> LatencyParts:
    """Measure the latency of poses on an open car; the car does not move."""
    arrival: list[float] = []
    waiting: list[float] = []
    pacer = Pacer(car.clock, period_s)
    pacer.start()
    car.observe()
    for _ in range(max(int(seconds / period_s), 1)):
        pacer.wait()
        observation = car.observe()
        arrival += [p.t_receive_s - p.t_capture_s for p in observation.poses if p.tracked]
        waiting.append(car.clock.now_s() - observation.t_receive_s)
    found = {EXPOSURE_TO_ARRIVAL: np.array(arrival), ARRIVAL_TO_LOOP: np.array(waiting)}
    return LatencyParts({name: samples for name, samples in found.items() if samples.size})


def measure_latency(car: EmulatedCar, *, period_s: float = 1.0 / 30.0) -> LatencyParts:
    """Measure every part on an open emulated car by steering at rest with a different value each tick.

    The sender reports when a command was written, the emulated firmware when it was decoded; the servo position
    identifies the command.
    """
    hardware = car.hardware
    calibration = hardware.actuator.calibration
    poses = measure_pose_latency(car, seconds=1.0, period_s=period_s)
    car.arm()
    issued: dict[int, float] = {}
    written: dict[int, float] = {}
    pacer = Pacer(car.clock, period_s)
    start_s = pacer.start()
    for k in range(TICKS):
        steering = (k + 1) / (1000.0 * calibration.servo_range_left)
        key = calibration.to_device(Action(steering)).servo_steps
        issued[key] = car.clock.now_s()
        car.command(Action(steering))
        pacer.wait()
        status = hardware.actuator.status()
        if status.t_issued_s >= issued[key]:
            written[key] = status.t_written_s
    car.stop(planned=True)
    decoded: dict[int, float] = {}
    for t_s, name, value in car.world.request(do="log", since_s=start_s)["entries"]:
        if name == "servo":
            decoded.setdefault(round(value * 1000), t_s)
    keys = [key for key in issued if key in written and key in decoded]
    return LatencyParts(
        {
            COMMAND_TO_WIRE: np.array([written[key] - issued[key] for key in keys]),
            WIRE_TO_FIRMWARE: np.array([decoded[key] - written[key] for key in keys]),
            **poses.parts,
        }
    )
