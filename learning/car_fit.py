"""From recorded rows and a simulator to a learned car, and to a file and back."""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from carlab.core.errors import DataError
from learning.authors_fsvgd import WorldDynamics
from learning.car_dynamics import CarDynamics
from learning.domain_models import ABSURD, BROKEN_DOWN, draw_parameters
from learning.fsvgd import Posterior
from learning.function_posterior import infer
from learning.normaliser import Normaliser
from learning.particles import Network
from learning.sim_fsvgd import ParticleSettings, fit_particles, measurement_points
from learning.simulator_model import CarModel
from learning.transitions import OUTPUTS, Transitions

Method = Literal["sim-fsvgd", "fsvgd", "fsvgd-authors"]
LearnedCar = CarDynamics | WorldDynamics
FILE_VERSION = 6
NOISE_STD = (0.001, 0.001, 0.003, 0.02, 0.02, 0.1)
"""Expected noise of a step's changes, in the order of ``OUTPUTS``: motion capture at 100 Hz, differentiated."""
EXPECTED_GAP = 0.3
EXPECTED_FUNCTION = 1.0
"""Size of what a simulator leaves out, and of a step of which nothing is known, in units of the outputs."""
ROWS = 800
"""Rows that are conditioned on at most; of more so many are drawn."""
_UNITS_FROM = 2000


@dataclass(frozen=True, slots=True)
class CarFitSettings:
    """How a car is learned.

    Attributes:
        method: with the simulator as prior, or without (``fsvgd``).
        steps: of the particles' optimiser.
        particles: how many.
        seed: of everything that is drawn.
        learning_rate: of the particles; that of ``ParticleSettings`` unless given.
    """

    method: Method = "sim-fsvgd"
    steps: int = 2500
    particles: int = 20
    seed: int = 0
    learning_rate: float = ParticleSettings().learning_rate


def car_units(model: CarModel, generator: torch.Generator) -> Normaliser:
    """Units of inputs and outputs by random drives of the simulator; they do not change with the data.

    Raises:
        DataError: the simulator breaks down in most of them.
    """
    inputs = model.inputs(_UNITS_FROM, generator)
    with torch.no_grad():
        outputs = model(inputs, draw_parameters(model, 16, generator)).flatten(0, 1)
    sound = (outputs.abs() < ABSURD).all(dim=1)
    if 2 * int(sound.sum()) < len(outputs):
        raise DataError(BROKEN_DOWN)
    outputs = outputs[sound]
    width = inputs.std(dim=0).clamp_min(0.1)
    return Normaliser(inputs.mean(dim=0), width, torch.zeros(len(OUTPUTS)), outputs.std(dim=0).clamp_min(1e-3))


def fit_car(
    rows: Transitions | None,
    model: CarModel,
    settings: CarFitSettings,
    *,
    before: CarDynamics | None = None,
    device: torch.device | str = "cpu",
    progress: Callable[[int], None] = lambda step: None,
) -> CarDynamics:
    """Learn a car.

    Args:
        rows: what was recorded; without any the simulator alone is learned.
        model: the simulator, which is the prior or (``fsvgd``) only tells units and domain.
        settings: how.
        before: an earlier fit of the same car, whose units and particles are taken up, from any device.
        device: where it is learned; what is drawn is drawn on the CPU.
        progress: told the steps of the optimiser that are done.

    Raises:
        DataError: the history of the rows or of the earlier fit is not the model's, or the fit diverged.
    """
    if rows is not None and rows.history != model.history:
        raise DataError(f"The rows have {rows.history} past commands, the model {model.history}; make them alike.")
    if before is not None and before.history != model.history:
        raise DataError(
            f"The earlier car has {before.history} past commands, the model {model.history}; remove its folder, and it "
            "is learned anew."
        )
    generator = torch.Generator().manual_seed(settings.seed)
    units = (car_units(model, generator) if before is None else before.posterior.normaliser.unturned()).to(device)
    width = 3 + 2 * (model.history + 1)
    inputs, outputs = torch.zeros((0, width)), torch.zeros((0, len(OUTPUTS)))
    if rows is not None and len(rows):
        inputs, outputs = (torch.from_numpy(v).float() for v in (rows.inputs, rows.targets))
    if len(inputs) > ROWS:
        some = torch.randperm(len(inputs), generator=generator)[:ROWS]
        inputs, outputs = inputs[some], outputs[some]
    inputs, outputs = inputs.to(device), outputs.to(device)
    own = settings.method == "sim-fsvgd"
    gap = (EXPECTED_GAP if own else EXPECTED_FUNCTION) * units.output_std
    target = infer(
        model if own else None, inputs, outputs, units, torch.tensor(NOISE_STD).to(device), gap_std=gap,
        starts=(1.0,), seed=settings.seed,
    )  # fmt: skip
    points = measurement_points(model, inputs, units, generator)
    particles = ParticleSettings(
        particles=settings.particles, steps=settings.steps, learning_rate=settings.learning_rate, seed=settings.seed
    )
    start = None if before is None else before.posterior.to(device).parameters_for(target.normaliser)
    return CarDynamics(fit_particles(target, points, particles, progress, start), model.history)


def save_car(dynamics: LearnedCar, path: Path) -> None:
    """Write a learned car into a file, from wherever it is. Raises OSError where the disk is full."""
    posterior = dynamics.posterior.to("cpu")
    units = posterior.normaliser
    content: dict[str, Any] = {
        "version": FILE_VERSION,
        "frame": "body" if isinstance(dynamics, CarDynamics) else "world",
        "history": dynamics.history,
        "network": [posterior.network.inputs, posterior.network.outputs, *posterior.network.hidden],
        "activation": posterior.network.activation,
        "parameters": posterior.parameters,
        "noise_std": posterior.noise_std,
        "freedom": posterior.freedom,
        "units": [units.input_mean, units.input_std, units.output_mean, units.output_std],
        "turn": units.output_turn,
        "trend": posterior.trend,
        "correlation": posterior.correlation,
        "reach": posterior.reach,
    }
    whole = io.BytesIO()  # torch tells of a full disk by an error of its own
    torch.save(content, whole)
    path.write_bytes(whole.getvalue())


def load_car(path: Path, device: torch.device | str = "cpu") -> LearnedCar:
    """Read a learned car onto a device. Raises DataError where the file is broken, or of another version or shape."""
    remedy = "remove its folder, and it is learned anew"
    try:
        content: dict[str, Any] = torch.load(path, weights_only=True, map_location="cpu")
        version = content["version"]
        if version != FILE_VERSION:
            raise DataError(f"{path} is of version {version}, this program reads {FILE_VERSION}; {remedy}.")
        inputs, outputs, *hidden = content["network"]
        network = Network(inputs, outputs, tuple(hidden), content["activation"])
        parameters: Tensor = content["parameters"]
        found = parameters.shape[1]
        units = Normaliser(*content["units"])
        if content["turn"] is not None:
            units = units.turned(content["turn"])
        noise_std, freedom = content["noise_std"], float(content["freedom"])
        rest = (content[name] for name in ("trend", "correlation", "reach"))
        posterior = Posterior(network, parameters, noise_std, units, freedom, *rest)
        frames: dict[str, type[LearnedCar]] = {"body": CarDynamics, "world": WorldDynamics}
        car: LearnedCar = frames[content.get("frame", "body")](posterior.to(device), content["history"])
    except DataError:
        raise
    except _BROKEN as error:
        raise DataError(f"The learned car in {path} cannot be read ({_first(error)}); {remedy}.") from error
    if found != network.parameters:
        raise DataError(f"{path} holds {found} numbers a particle for {network.parameters}; {remedy}.")
    return car


_BROKEN = (OSError, RuntimeError, EOFError, LookupError, TypeError, ValueError, AttributeError, pickle.UnpicklingError)


def _first(error: BaseException) -> str:
    """The first line of an error, or what kind it is."""
    return next(iter(str(error).splitlines()), "") or type(error).__name__


__all__ = ["CarFitSettings", "LearnedCar", "Method", "car_units", "fit_car", "load_car", "save_car"]
