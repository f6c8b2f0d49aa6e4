"""Draw the pictures of the effect gallery: one drive with and without each effect (run by ``make pictures``)."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch

from sim_backends import EFFECTS, SimulatorConfig, rollout
from sim_backends.array_ops import FLOATS
from sim_backends.effects import CATALOGUE
from sim_backends.measurement import COMMAND_DELAY, MeasurementModel, delay_as_recorded_s

if TYPE_CHECKING:
    from numpy.typing import NDArray

FOLDER = Path(__file__).resolve().parent / "images" / "effects"
PERIOD_S = 1.0 / 30.0
DURATION_S = 8.0
NOISE = {"vx [m/s]": 0.02, "vy [m/s]": 0.02, "yaw rate [rad/s]": 0.05}
"""Typical noise of each channel; the channel with the largest difference in these units is drawn."""
WITHOUT, WITH = "0.55", "#0072b2"


def commands() -> torch.Tensor:
    """One drive (1, T, 2) with steps, a chirp, coasting, braking and full lock."""
    t = np.arange(0.0, DURATION_S, PERIOD_S)
    chirp = 0.6 * np.sin(2.0 * math.pi * (0.4 * (t - 3.0) + 0.15 * (t - 3.0) ** 2))
    steering = np.select([t < 1.0, t < 1.6, t < 2.2, t < 3.0, t < 6.0], [0.0, 0.5, -0.5, 0.0, chirp], 1.0)
    throttle = np.select([t < 0.2, t < 3.5, t < 4.2, t < 5.5, t < 6.0], [0.0, 0.6, 0.0, 0.5, -0.4], 0.35)
    return torch.tensor(np.stack([steering, throttle], axis=1))[None]


def drive(config: SimulatorConfig, values: dict[str, float]) -> NDArray[np.float64]:
    """Return what motion capture reports (T + 1, 6) of the drive, which starts at rest."""
    config = config.with_values(values)
    numbers = config.values()
    model = MeasurementModel(FLOATS, numbers, config.effects)
    delay_s = delay_as_recorded_s(FLOATS, numbers, config.effects, model.latency_s)
    start = torch.zeros(1, 6, dtype=torch.float64)
    states = rollout(config, start, commands(), values={COMMAND_DELAY: delay_s}).states[0]
    return np.array(model.measure(states.tolist(), PERIOD_S))


def draw(effect_id: str) -> None:
    """Draw path and most affected channel of the drive, without and with the effect, as a PNG."""
    effect = EFFECTS[effect_id]
    config = SimulatorConfig.from_preset()
    if all(p.same_as.startswith("tyre.") for p in effect.parameters):
        config = replace(config, kind="linear_tyre")
    size = {f"effects.{effect_id}.{p.name}": p.typical for p in effect.parameters}
    without, with_effect = drive(config, {}), drive(config, size)
    channels = dict(zip(NOISE, (3, 4, 5), strict=True))
    name = max(channels, key=lambda c: np.abs(with_effect - without)[:, channels[c]].max() / NOISE[c])
    t = np.arange(len(without)) * PERIOD_S
    figure, (path, channel) = plt.subplots(1, 2, figsize=(7.2, 2.4), layout="constrained", width_ratios=[1, 2])
    for state, colour, label in ((without, WITHOUT, "without"), (with_effect, WITH, "with")):
        path.plot(state[:, 0], state[:, 1], color=colour, linewidth=1.5)
        channel.plot(t, state[:, channels[name]], color=colour, linewidth=1.5, label=label)
    path.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    channel.set(xlabel="time [s]", ylabel=name)
    channel.legend(frameon=False, fontsize="small")
    figure.savefig(FOLDER / f"{effect_id}.png", dpi=90, metadata={"Software": None})
    plt.close(figure)


def main() -> None:
    """Draw every effect of the catalogue."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for effect_id in CATALOGUE:
        draw(effect_id)


if __name__ == "__main__":
    main()
