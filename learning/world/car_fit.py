"""Fit a learned car to recorded rows and a simulator prior; save and load it."""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from carlab.core.errors import DataError, first_line
from carlab.core.observation import STATE_FEATURES
from learning.functional_svgd.authors_fsvgd import WorldDynamics
from learning.networks.array_file import (
    MAX_BYTES,
    TOO_LARGE,
    UNREADABLE,
    check_archive,
    read_arrays,
    whole_number,
    write_arrays,
)
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Activation, Network
from learning.posterior.distillation import DistillationSettings, distil, measurement_points
from learning.posterior.inference import infer
from learning.posterior.particle_posterior import ParticlePosterior, ParticleSimulator
from learning.posterior.row_noise import random_rows
from learning.priors.domain_models import MAX_PLAUSIBLE_OUTPUT, NO_FINITE_OUTPUT, draw_parameters
from learning.priors.simulator_model import CarModel
from learning.priors.simulator_text import model_of, text_of
from learning.transitions import OUTPUTS, Transitions
from learning.world.car_dynamics import CarDynamics

Method = Literal["gp-sim-posterior", "gp-posterior", "sim-fsvgd", "sim-fsvgd-corrected", "fsvgd"]
Particles = Literal["network", "simulator"]
"""What a particle is: a network, or the simulator with a draw of its parameters and a network that corrects it."""
PAPER_METHODS = ("sim-fsvgd", "sim-fsvgd-corrected", "fsvgd")
"""The paper's algorithms; the others are carlab's."""
LearnedCar = CarDynamics | WorldDynamics
FILE_VERSION, SIMULATOR_FILE_VERSION = 6, 7
"""Versions of files of particles without and with a simulator; earlier programs do not read the latter."""
NOISE_STD = (0.001, 0.001, 0.003, 0.02, 0.02, 0.1)
"""Prior noise of a step's changes, in the order of ``OUTPUTS``: differences of motion capture at 100 Hz."""
PRIOR_DISCREPANCY = 0.3
PRIOR_FUNCTION = 1.0
"""Prior sizes of a simulator's discrepancy, and of a step without a simulator, in units of the outputs."""
MAX_ROWS = 800
"""Maximum number of rows of the fit; a random subset of more."""
MAX_NETWORK_SIZE = 10_000
"""Maximum width of a layer in a file; a learned car has 64 units per layer and at most some hundred inputs."""
_UNIT_SAMPLES = 2000
_MAX_SHOWN = 6
"""Maximum number of sizes in a message."""
_UNITS = ("input_mean", "input_std", "output_mean", "output_std")
_DOF_KEY, _DECORRELATION_KEY, _INPUT_CLIP_KEY = "freedom", "turn", "reach"
"""Names in the files of the degrees of freedom, the decorrelation of the outputs, and the bounds of the inputs."""
_SIMULATOR_KEY, _DRAWS_KEY = "simulator", "simulator_parameters"
_OPTIONAL_KEYS = (_DECORRELATION_KEY, "trend", "correlation", _INPUT_CLIP_KEY)
_FRAMES = ("body", "world")
_ACTIVATIONS: tuple[Activation, ...] = get_args(Activation)
_READ_ERRORS = (*UNREADABLE, AttributeError, AssertionError)


@dataclass(frozen=True, slots=True)
class CarFitSettings:
    """Settings of the fit.

    Attributes:
        method: ``gp-sim-posterior`` has a simulator prior, ``gp-posterior`` a zero-mean prior; both are distilled
            posteriors (``learning.posterior``). The others are the paper's (``functional_svgd.authors_fsvgd``).
        steps: of the particles' optimiser.
        particles: their number.
        seed: of all draws.
        learning_rate: of the particles.
        kind: what a particle is; ``simulator`` only with ``gp-sim-posterior``.
    """

    method: Method = "gp-sim-posterior"
    steps: int = 2500
    particles: int = 20
    seed: int = 0
    learning_rate: float = DistillationSettings().learning_rate
    kind: Particles = "network"


def car_units(model: CarModel, generator: torch.Generator) -> Normaliser:
    """Units of inputs and outputs from random drives of the simulator, independent of the data.

    Raises:
        DataError: most drives have implausible outputs.
    """
    inputs = model.inputs(_UNIT_SAMPLES, generator)
    with torch.no_grad():
        outputs = model(inputs, draw_parameters(model, 16, generator)).flatten(0, 1)
    plausible = (outputs.abs() < MAX_PLAUSIBLE_OUTPUT).all(dim=1)
    if 2 * int(plausible.sum()) < len(outputs):
        raise DataError(NO_FINITE_OUTPUT)
    outputs = outputs[plausible]
    width = inputs.std(dim=0).clamp_min(0.1)
    return Normaliser(inputs.mean(dim=0), width, torch.zeros(len(OUTPUTS)), outputs.std(dim=0).clamp_min(1e-3))


def fit_car(
    rows: Transitions | None,
    model: CarModel,
    settings: CarFitSettings,
    *,
    earlier: CarDynamics | None = None,
    device: torch.device | str = "cpu",
    progress: Callable[[int], None] = lambda step: None,
) -> CarDynamics:
    """Fit a car.

    Args:
        rows: recorded transitions; None: the prior alone is distilled.
        model: the simulator: the prior, or (``gp-posterior``) only the source of units and domain.
        settings: of the fit.
        earlier: an earlier fit of the same car, on any device, with the units and initial particles.
        device: of the fit; random numbers are drawn on the CPU.
        progress: called with the number of optimiser steps done.

    Raises:
        DataError: the rows or the earlier fit have another history than the model, or numbers are missing or infinite,
            or the simulator gives no plausible outputs.
        DivergedError: the particles diverged.
    """
    if rows is not None and rows.history != model.history:
        raise DataError(f"The rows have {rows.history} past commands, the model {model.history}; use the same number.")
    if earlier is not None and earlier.history != model.history:
        raise DataError(
            f"The earlier car has {earlier.history} past commands, the model {model.history}; remove its folder to "
            "train again."
        )
    generator = torch.Generator().manual_seed(settings.seed)
    earlier_units = None if earlier is None else earlier.posterior.normaliser.without_decorrelation()
    units = (car_units(model, generator) if earlier_units is None else earlier_units).to(device)
    width = 3 + 2 * (model.history + 1)
    inputs, outputs, step_numbers = torch.zeros((0, width)), torch.zeros((0, len(OUTPUTS))), None
    if rows is not None and len(rows):
        inputs, outputs = (torch.from_numpy(v).float() for v in (rows.inputs, rows.targets))
        step_numbers = torch.from_numpy(rows.step_numbers)
        chosen = random_rows(len(inputs), MAX_ROWS, step_numbers, generator)
        inputs, outputs, step_numbers = (v[chosen].to(device) for v in (inputs, outputs, step_numbers))
    with_simulator = settings.method == "gp-sim-posterior"
    discrepancy_std = (PRIOR_DISCREPANCY if with_simulator else PRIOR_FUNCTION) * units.output_std
    target = infer(
        model if with_simulator else None, inputs, outputs, units, torch.tensor(NOISE_STD).to(device),
        discrepancy_std=discrepancy_std, step_numbers=step_numbers, restart_scales=(1.0,), seed=settings.seed,
    )  # fmt: skip
    correct = settings.kind == "simulator" and with_simulator
    particles = DistillationSettings(
        particles=settings.particles, steps=settings.steps, learning_rate=settings.learning_rate, seed=settings.seed,
        correct_simulator=correct,
    )  # fmt: skip
    points = measurement_points(model, inputs, units, generator, particles.domain_points)
    start = None
    if earlier is not None and (earlier.posterior.simulator is not None) == correct:
        start = earlier.posterior.to(device).parameters_for(target.normaliser)
    return CarDynamics(distil(target, points, particles, progress, start), model.history)


def save_car(dynamics: LearnedCar, path: Path) -> None:
    """Write a learned car to a file.

    Args:
        dynamics: the car, on any device.
        path: of the file.

    Raises:
        OSError: the disk is full.
    """
    buffer = io.BytesIO()  # torch.save to a full disk would not raise OSError.
    torch.save(_content(dynamics), buffer)
    path.write_bytes(buffer.getvalue())


def load_car(path: Path, device: torch.device | str = "cpu") -> LearnedCar:
    """Read a learned car onto a device.

    Raises:
        DataError: the file cannot be read, or has another version or shape.
    """

    def read() -> dict[str, Any]:
        check_archive(path)
        content: dict[str, Any] = torch.load(path, weights_only=True, map_location="cpu")
        return content

    return _read(path, device, read)


def save_car_arrays(dynamics: LearnedCar, path: Path) -> None:
    """Write a learned car as arrays, for another computer: the file has no pickle. Raises OSError if the disk is full.

    Parts that the car does not have are left out.
    """
    content = _content(dynamics)
    means_and_stds = dict(zip(_UNITS, content.pop("units"), strict=True))
    arrays = {name: part for name, part in content.items() if isinstance(part, Tensor)} | means_and_stds
    if content[_SIMULATOR_KEY] is not None:
        arrays[_SIMULATOR_KEY] = torch.frombuffer(bytearray(content[_SIMULATOR_KEY].encode()), dtype=torch.uint8)
    write_arrays(path, arrays | {
        "version": content["version"], "history": dynamics.history, "frame": _FRAMES.index(content["frame"]),
        "activation": _ACTIVATIONS.index(content["activation"]), "network": torch.tensor(content["network"]),
        _DOF_KEY: torch.tensor(content[_DOF_KEY], dtype=torch.float64),
    })  # fmt: skip


def load_car_arrays(path: Path) -> LearnedCar:
    """Read the output of ``save_car_arrays``. Raises DataError as ``load_car``."""

    def read() -> dict[str, Any]:
        arrays = read_arrays(path)
        tensors = {k: torch.from_numpy(v.copy()) for k, v in arrays.items()}
        optional: dict[str, Any] = dict.fromkeys(_OPTIONAL_KEYS)
        if _SIMULATOR_KEY in arrays:
            optional[_SIMULATOR_KEY] = arrays[_SIMULATOR_KEY].astype(np.uint8).tobytes().decode()
            del tensors[_SIMULATOR_KEY]
        return optional | tensors | {
            "version": whole_number(arrays, "version"), "history": whole_number(arrays, "history"),
            "frame": _FRAMES[whole_number(arrays, "frame")], "network": [int(n) for n in arrays["network"]],
            "activation": _ACTIVATIONS[whole_number(arrays, "activation")], "units": [tensors[k] for k in _UNITS],
        }  # fmt: skip

    return _read(path, "cpu", read)


def _content(dynamics: LearnedCar) -> dict[str, Any]:
    """Content of a file."""
    posterior = dynamics.posterior.to("cpu")
    units, simulator = posterior.normaliser, posterior.simulator
    return {
        "version": FILE_VERSION if simulator is None else SIMULATOR_FILE_VERSION,
        "frame": "body" if isinstance(dynamics, CarDynamics) else "world",
        "history": dynamics.history,
        "network": [posterior.network.inputs, posterior.network.outputs, *posterior.network.hidden],
        "activation": posterior.network.activation,
        "parameters": posterior.parameters,
        "noise_std": posterior.noise_std,
        _DOF_KEY: posterior.dof,
        "units": [units.input_mean, units.input_std, units.output_mean, units.output_std],
        _DECORRELATION_KEY: units.decorrelation,
        "trend": posterior.trend,
        "correlation": posterior.correlation,
        _INPUT_CLIP_KEY: posterior.input_clip,
        _SIMULATOR_KEY: None if simulator is None else text_of(simulator.model),
        _DRAWS_KEY: None if simulator is None else simulator.parameters,
    }


def _read(path: Path, device: torch.device | str, read: Callable[[], dict[str, Any]]) -> LearnedCar:
    """The car of a content that ``read`` reads from a file. Raises DataError if it cannot be read."""
    remedy = "remove its folder to train again"
    try:
        content = read()
        version = content["version"]
        if version in (FILE_VERSION, SIMULATOR_FILE_VERSION):
            return _car_of(content, device)
    except pickle.UnpicklingError as error:  # its own message recommends to read the file unsafely
        raise DataError(f"{path} holds more than numbers, so it is no learned car; {remedy}.") from error
    except _READ_ERRORS as error:
        raise DataError(f"The learned car in {path} cannot be read ({first_line(error)}); {remedy}.") from error
    known = f"{FILE_VERSION} and {SIMULATOR_FILE_VERSION}"
    raise DataError(f"{path} has version {version}, this program reads versions {known}; {remedy}.")


def _car_of(content: Mapping[str, Any], device: torch.device | str) -> LearnedCar:
    """The car of a file's content; all shapes are checked before anything is computed, because it may be untrusted.

    Raises:
        One of ``_READ_ERRORS``: a part is missing, or has another type or shape.
    """
    inputs, outputs, *hidden = content["network"]
    network = Network(inputs, outputs, tuple(hidden), content["activation"])
    frame, history, dof = content.get("frame", "body"), content["history"], float(content[_DOF_KEY])
    _check_sizes(network, frame, history)
    if not dof > 0.0:
        raise ValueError(f"{dof} degrees of freedom")
    _check_parts(content, network)
    units = Normaliser(*content["units"])
    if content[_DECORRELATION_KEY] is not None:
        units = units.decorrelated(content[_DECORRELATION_KEY])
    trend, correlation, input_clip = (content[name] for name in ("trend", "correlation", _INPUT_CLIP_KEY))
    simulator = _simulator_of(content) if content["version"] == SIMULATOR_FILE_VERSION else None
    posterior = ParticlePosterior(
        network, content["parameters"], content["noise_std"], units, dof, trend, correlation, input_clip, simulator
    )  # fmt: skip
    frames: dict[str, type[LearnedCar]] = {"body": CarDynamics, "world": WorldDynamics}
    return frames[frame](posterior.to(device), history)


def _simulator_of(content: Mapping[str, Any]) -> ParticleSimulator:
    """The simulator of the particles of a file. Raises one of ``_READ_ERRORS`` as ``_car_of``."""
    if content.get("frame", "body") != "body":
        raise ValueError("a simulator of steps in the world frame")
    model, draws = model_of(content[_SIMULATOR_KEY], content["history"]), content[_DRAWS_KEY]
    _check_array(_DRAWS_KEY, draws, (len(content["parameters"]), model.size))
    _check_finite({_DRAWS_KEY: draws})
    return ParticleSimulator(model, draws.float())


def _check_sizes(network: Network, frame: str, history: int) -> None:
    """Raise ValueError if the sizes of a network are no counts, or do not belong to the frame and the history."""
    sizes = (network.inputs, network.outputs, *network.hidden)
    if not all(type(size) is int and 0 < size <= MAX_NETWORK_SIZE for size in sizes):
        raise ValueError(f"a network of {', '.join(map(str, sizes[:_MAX_SHOWN]))}")
    state_inputs, outputs = {"body": (3, len(OUTPUTS)), "world": (STATE_FEATURES, STATE_FEATURES)}[frame]
    if type(history) is not int or history < 0 or network.inputs != state_inputs + 2 * (history + 1):
        raise ValueError(f"a history of {history} and {network.inputs} inputs")
    if network.outputs != outputs:
        raise ValueError(f"{network.outputs} outputs")


def _check_parts(content: Mapping[str, Any], network: Network) -> None:
    """Raise ValueError if an array of a file has another shape than the network, or if all together are too large."""
    d, o = network.inputs, network.outputs
    shapes: dict[str, tuple[int | None, ...]] = {
        "parameters": (None, network.parameters), "noise_std": (o,), "input_mean": (d,), "input_std": (d,),
        "output_mean": (o,), "output_std": (o,), _DECORRELATION_KEY: (o, o), "trend": (1 + d, o),
        "correlation": (o, o), _INPUT_CLIP_KEY: (d,),
    }  # fmt: skip
    parts = dict(content) | dict(zip(_UNITS, content["units"], strict=True))
    given = {name: parts[name] for name in shapes if name not in _OPTIONAL_KEYS or parts[name] is not None}
    for name, part in given.items():
        _check_array(name, part, shapes[name])
    if sum(part.numel() * part.element_size() for part in given.values()) > MAX_BYTES:
        raise ValueError(TOO_LARGE)
    _check_finite(given)


def _check_array(name: str, part: Any, shape: tuple[int | None, ...]) -> None:
    """Raise ValueError if a part of a file is no array of numbers of a shape, in which None is any positive size."""
    if not isinstance(part, Tensor) or part.layout != torch.strided or not part.is_floating_point():
        raise ValueError(f"{name} is not an array of numbers")
    size = part.numel() * part.element_size()
    if part.device.type != "cpu" or part.untyped_storage().nbytes() < size:  # one stored number at many indices
        raise ValueError(f"{name} has fewer numbers than its shape")
    wanted = tuple(max(len(part), 1) if n is None else n for n in shape) if part.ndim else shape
    if tuple(part.shape) != wanted:
        raise ValueError(f"{name} has shape {tuple(part.shape)}, not {wanted}")


def _check_finite(parts: Mapping[str, Tensor]) -> None:
    """Raise ValueError for the first array with a number that is not finite."""
    for name, part in parts.items():
        if not torch.isfinite(part).all():
            raise ValueError(f"{name} is not finite")
