"""How fast the parts are, as ratios taken in one run: what ``carlab bench speed`` prints and writes."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from typing import Any


def measure_speed(*, seconds: float = 5.0, note: Callable[[str], None] = lambda text: None) -> dict[str, Any]:
    """Measure the simulator, gradients, learning, NatNet decoding and the command sender.

    Everything but the sender runs on one core with one thread. The sender is measured on all cores and, pinned with
    everything else, on one.

    Args:
        seconds: length of each condition of the sender's measurement [s].
        note: told what is being measured.

    Returns:
        Figures by part and name; the names say the unit.
    """
    from drivers.speed import sender_lateness
    from learning.speed import prediction_speed, sac_speed, training_speed
    from mocap.speed import natnet_decode_speed
    from sim_backends.speed import gradient_speed, simulation_speed

    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))
    figures: dict[str, Any] = {"machine": {"cores_count": len(cores), "python": platform.python_version()}}
    one = {min(cores)}
    try:
        _pin(one)
        note("simulation against a plain loop, one core")
        figures["simulation"] = simulation_speed()
        note("gradient of a rollout against central differences, one core")
        figures["gradient"] = gradient_speed()
        note("training of particles, one core")
        figures["training"] = training_speed()
        note("predictions of particles against a matrix product, one core")
        figures["prediction"] = prediction_speed()
        note("gradient steps of SAC against stable-baselines3, one core")
        figures["sac"] = sac_speed()
        note("NatNet decoding, one core")
        figures["natnet"] = natnet_decode_speed()
        note("lateness of the command sender, everything on one core")
        figures["sender_one_core"] = sender_lateness(seconds)
        _pin(cores)
        note("lateness of the command sender, all cores")
        figures["sender_all_cores"] = sender_lateness(seconds)
    finally:
        _pin(cores)
    return figures


def _pin(cores: set[int]) -> None:
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, cores)
