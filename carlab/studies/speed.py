"""Speed of the components, as ratios within one run: the figures of ``carlab bench speed``."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from typing import Any


def measure_speed(
    *, seconds: float = 5.0, device: str = "cpu", note: Callable[[str], None] = lambda text: None
) -> dict[str, Any]:
    """Measure the simulator, gradients, learning, NatNet decoding and the command sender.

    All measurements except the sender's run on one core with one thread. The sender is measured twice: with all
    processes on one core, and on all cores.

    Args:
        seconds: duration of each condition of the sender's measurement [s].
        device: of particles and SAC; all other measurements use the CPU.
        note: called with the name of each measurement.

    Returns:
        Figures by part and name; the names end in the unit.
    """
    from drivers.speed import sender_lateness
    from learning.devices import device_name
    from learning.speed import prediction_speed, sac_speed, training_speed
    from mocap.speed import natnet_decode_speed
    from sim_backends.speed import gradient_speed, simulation_speed, single_torch_thread

    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))
    machine = {"cores_count": len(cores), "python": platform.python_version(), "learning_device": device_name(device)}
    figures: dict[str, Any] = {"machine": machine}
    one = {min(cores)}
    where = "one core" if device == "cpu" else device
    try:
        _pin(one)
        with single_torch_thread():  # Two threads that synchronise on one core are a hundred times slower.
            note("simulation against a plain loop, one core")
            figures["simulation"] = simulation_speed()
            note("gradient of a rollout against central differences, one core")
            figures["gradient"] = gradient_speed()
            note(f"training of particles, {where}")
            figures["training"] = training_speed(device)
            note(f"predictions of particles against a matrix product, {where}")
            figures["prediction"] = prediction_speed(device)
            note(f"gradient steps of SAC against stable-baselines3, {where}")
            figures["sac"] = sac_speed(device)
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
