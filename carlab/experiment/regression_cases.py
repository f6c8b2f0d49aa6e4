"""Cases of the regression study: what is learned, from how little, and which simulator is the prior.

Each is the paper's (Rothfuss et al., arXiv 2403.16644, section 6.1) with the domains, priors and units of the authors'
public code. Data is drawn here, or read from arrays that their code made.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from carlab.core.errors import DataError
from learning.domain_models import DomainModel, KinematicCar, Pendulum, Sinusoids, draw_parameters
from learning.function_prior import RbfCovariance
from learning.motor_pendulum import MotorPendulum
from learning.normaliser import Normaliser
from learning.simulator_model import CarModel
from sim_backends.car_parameters import MocapParameters, SimulatorConfig

TEST_ROWS = 1000
LEAST_NOISE = 0.005


@dataclass(frozen=True, slots=True)
class Data:
    """Rows to learn from and rows to be judged by: inputs (n, D), outputs (n, O), which are changes of a state.

    ``test_yaw`` (n,) is where a car headed that the rows are of, if that is known.
    """

    inputs: Tensor
    outputs: Tensor
    test_inputs: Tensor
    test_outputs: Tensor
    test_yaw: Tensor | None = None

    def to(self, device: torch.device | str) -> Data:
        """The same on a device."""
        moved = Data(*(v.to(device) for v in (self.inputs, self.outputs, self.test_inputs, self.test_outputs)))
        return moved if self.test_yaw is None else replace(moved, test_yaw=self.test_yaw.to(device))


@dataclass(frozen=True, slots=True)
class Case:
    """One case.

    Attributes:
        name: as on the command line, and of the authors' arrays.
        prior: the simulator that is known.
        process: the same with a gap inside its dynamics, as the prior of Sim-FSVGD, beside which only the sensor's
            noise is left; where it is None, ``prior`` and a gap on its outputs.
        truth: the simulator that makes the data, with a distribution of its parameters; None where only the authors'
            arrays have it.
        counts: numbers of rows that are tried.
        noise_std: of the measured outputs (O,), raw.
        likelihood_std: the authors' noise at the start of a fit (O,), raw.
        learn_noise: whether it is learned.
        input_std: units of the inputs (D,).
        output_std: units of the outputs (O,).
        gap_std: of the Gaussian process between simulator and reality (O,), raw; none where the simulator is right.
        gap_lengthscale: of that process on raw inputs.
        function_lengthscale: of the Gaussian-process prior of FSVGD and of a grey box, on normalised inputs.
        expected_gap: what our way expects the simulator to be wrong by, in units of the outputs; None: it is right.
        ours: the same case as our way sees it, where that is in other coordinates.
        in_body_frame: whether rows are turned and moved into the frame of the step's start.
    """

    name: str
    prior: DomainModel
    process: DomainModel | None
    truth: DomainModel | None
    counts: tuple[int, ...]
    noise_std: tuple[float, ...]
    likelihood_std: tuple[float, ...]
    learn_noise: bool
    input_std: tuple[float, ...]
    output_std: tuple[float, ...]
    gap_std: tuple[float, ...] | None
    gap_lengthscale: float
    function_lengthscale: float
    expected_gap: float | None = 0.3
    ours: Case | None = None
    in_body_frame: bool = False

    @property
    def expected_noise_std(self) -> tuple[float, ...]:
        """Twice the noise of the sensor, which is known, and no less than half a per cent of the output's unit."""
        return tuple(max(2.0 * n, LEAST_NOISE * o) for n, o in zip(self.noise_std, self.output_std, strict=True))

    def gap_from(self, count: int) -> float | tuple[float, ...] | None:
        """Expected size of the gap with so many rows, in units of all outputs or of each (O,); None: there is none."""
        return self.expected_gap

    @property
    def normaliser(self) -> Normaliser:
        """Of inputs and outputs; fixed, not of the data."""
        inputs, outputs = torch.tensor(self.input_std), torch.tensor(self.output_std)
        return Normaliser(torch.zeros_like(inputs), inputs, torch.zeros_like(outputs), outputs)

    def gap(self) -> RbfCovariance | None:
        """Covariance of the gap in normalised outputs on raw inputs."""
        if self.gap_std is None:
            return None
        scales = [g / o for g, o in zip(self.gap_std, self.output_std, strict=True)]
        return RbfCovariance(tuple(scales), (self.gap_lengthscale,))

    def data(self, count: int, seed: int) -> Data:
        """Draw ``count`` rows of one true system and ``TEST_ROWS`` others of the same.

        Noise is added to the outputs, which are changes: the state before is known exactly, as in the authors' data.

        Raises:
            DataError: this case has no true system here.
        """
        if self.truth is None:
            raise DataError(f"The rows of '{self.name}' are the authors' arrays alone; give their folder with --data.")
        generator = torch.Generator().manual_seed(10_000 + seed)
        system = draw_parameters(self.truth, 1, generator)
        inputs = self.truth.inputs(count + TEST_ROWS, generator)
        outputs = self.truth(inputs, system)[0]
        outputs = outputs + torch.tensor(self.noise_std) * torch.randn(outputs.shape, generator=generator)
        return Data(inputs[:count], outputs[:count], inputs[count:], outputs[count:])

    def recorded(self, folder: Path, count: int, seed: int) -> Data:
        """The authors' arrays of this case. Raises DataError where there is no such file."""
        name = "sinusoid_n2" if self.name == "1d" else f"{self.name}_seed{seed}_n{count}"
        path = folder / f"{name}.npz"
        if not path.is_file():
            raise DataError(
                f"{path} does not exist; leave out --data to draw the data here, or choose other --rows or fewer "
                "--seeds."
            )
        try:
            with np.load(path) as arrays:
                x, y, tx, ty = (torch.from_numpy(arrays[k].astype(np.float32)) for k in ("x", "y", "x_test", "y_test"))
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise DataError(f"{path} does not hold the arrays x, y, x_test and y_test; make it anew.") from error
        if self.name == "1d":
            return Data(x, y, tx, ty)
        width = y.shape[1]
        if self.in_body_frame:
            return Data(*in_body_frame(x, y), *in_body_frame(tx, ty))
        return Data(x, y - x[:, :width], tx, ty - tx[:, :width])


def in_body_frame(before: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
    """Rows of a car as seen from where each begins.

    Pairs of outputs are turned, which leaves volumes alone: a density in these coordinates is that of the others, and
    so is the likelihood.

    Args:
        before: x, y, sin, cos of yaw, vx, vy in the world, yaw rate, and commands (n, 7 + 2).
        after: the first seven a step later (n, 7).

    Returns:
        The same inputs for a car at the origin that looks along x, and changes (n, 7).
    """
    sin, cos = before[:, 2], before[:, 3]

    def turned(along_x: Tensor, along_y: Tensor) -> tuple[Tensor, Tensor]:
        return cos * along_x + sin * along_y, cos * along_y - sin * along_x

    change = after - before[:, :7]
    none = torch.zeros_like(sin)
    inputs = torch.stack([none, none, none, none + 1.0, *turned(before[:, 4], before[:, 5]), *before[:, 6:].T], dim=1)
    upright, turn = turned(after[:, 3], after[:, 2])
    outputs = [
        *turned(change[:, 0], change[:, 1]),
        turn,
        upright - 1.0,
        *turned(change[:, 4], change[:, 5]),
        change[:, 6],
    ]
    return inputs, torch.stack(outputs, dim=1)


@dataclass(frozen=True, slots=True)
class BodyFrame:
    """A car's domain model with its inputs seen from the car."""

    model: KinematicCar

    @property
    def size(self) -> int:
        """As the model."""
        return self.model.size

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        """The model's, from where the car is and looks."""
        drawn = self.model.inputs(count, generator)
        return in_body_frame(drawn, drawn[:, :7])[0]

    def parameters(self, normal: Tensor) -> Tensor:
        """As the model."""
        return self.model.parameters(normal)

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        """Changes; the car looks along x, so that those in the world are its own."""
        return self.model(inputs, parameters)


_CAR_NOISE = (0.0011, 0.0011, 0.0018, 0.0018, 0.0082, 0.0082, 0.0368)

CAR_HISTORY = 3
"""Commands before the last one; the delay of 80 ms is two and a half periods."""
_STILL = MocapParameters(latency_s=0.0)
PACEJKA = SimulatorConfig(mocap=_STILL)
PACEJKA_RANGES = {
    "tyre.front.mu": (0.6, 1.0),
    "tyre.rear.mu": (0.6, 1.0),
    "tyre.front.B": (2.0, 4.0),
    "tyre.rear.B": (3.0, 10.0),
    "motor.drive_gain": (6.5, 10.0),
    "motor.damping": (1.0, 2.2),
    "vehicle.yaw_inertia": (0.03, 0.18),
    "steering.max_angle": (0.4, 0.7),
}
KINEMATIC = SimulatorConfig(kind="kinematic", mocap=_STILL)
KINEMATIC_RANGES = {
    "motor.drive_gain": (6.0, 10.0),
    "motor.damping": (1.0, 3.2),
    "steering.max_angle": (0.3, 0.7),
}

_WORLD = Case(
    name="racecar",
    prior=KinematicCar(place_m=4.0, speed_mps=6.0, rate_radps=8.0),
    process=None,
    truth=None,
    counts=(20, 50, 100, 200, 400),
    noise_std=_CAR_NOISE,
    likelihood_std=tuple(20.0 * s for s in _CAR_NOISE),
    learn_noise=True,
    input_std=(3.0, 3.0, 1.0, 1.0, 4.0, 4.0, 5.0, 1.0, 1.0),
    output_std=(0.127, 0.123, 0.060, 0.056, 2.86, 2.86, 5.65),
    gap_std=(0.004, 0.004, 0.015, 0.015, 0.15, 0.15, 0.75),
    gap_lengthscale=10.0,
    function_lengthscale=0.4,
)
_BODY = replace(
    _WORLD,
    prior=BodyFrame(KinematicCar()),
    input_std=(3.0, 3.0, 1.0, 1.0, 1.5, 1.5, 2.0, 0.6, 0.6),
    output_std=(0.1, 0.06, 0.1, 0.03, 1.0, 1.0, 3.0),
    function_lengthscale=2.0,
    in_body_frame=True,
)
_RACECAR = replace(_WORLD, ours=_BODY)

_PENDULUM = Case(
    name="pendulum",
    prior=Pendulum(),
    process=Pendulum(rate_gap=(1.0, 0.5, 0.5)),
    truth=Pendulum(frictions=(0.4, 0.6), drags=(0.4, 0.6)),
    counts=(5, 10, 20, 50),
    noise_std=(0.02, 0.02, 0.02),
    likelihood_std=(0.05, 0.05, 0.5),
    learn_noise=True,
    input_std=(1.0, 1.0, 3.5, 2.0),
    output_std=(0.158, 0.150, 0.951),
    gap_std=(0.025, 0.025, 0.25),
    gap_lengthscale=10.0,
    function_lengthscale=0.4,
    expected_gap=0.03,
)
# What may be missing, said without data: of the rate as with the other pendulum, where at the fastest rate it is about
# what gravity does; of its sign a tenth of that; of the motor half of either command.
_PENDULUM_MOTOR = replace(
    _PENDULUM,
    name="pendulum_motor",
    prior=MotorPendulum(),
    process=MotorPendulum(rate_gap=(1.0, 0.5, 0.5, 1.0), command_gap=0.5),
    truth=MotorPendulum(frictions=(0.4, 0.6), drags=(0.4, 0.6), dry=(0.1, 0.4), lags=(0.02, 0.06)),
    input_std=(1.0, 1.0, 3.5, 2.0, 2.0),
)

CASES = {
    case.name: case
    for case in (
        Case(
            name="1d",
            prior=Sinusoids(),
            process=None,
            truth=Sinusoids(),
            counts=(2,),
            noise_std=(0.0,),
            likelihood_std=(0.4,),
            learn_noise=False,
            input_std=(5.0,),
            output_std=(8.0,),
            gap_std=None,
            gap_lengthscale=1.0,
            function_lengthscale=0.2,
            expected_gap=None,
        ),
        _PENDULUM,
        _PENDULUM_MOTOR,
        Case(
            name="car",
            prior=CarModel(KINEMATIC, CAR_HISTORY, KINEMATIC_RANGES),
            process=None,
            truth=CarModel(PACEJKA, CAR_HISTORY, PACEJKA_RANGES),
            counts=(20, 50, 100, 200, 400),
            noise_std=(0.001, 0.001, 0.002, 0.008, 0.008, 0.04),
            likelihood_std=(0.01, 0.01, 0.02, 0.05, 0.05, 0.3),
            learn_noise=True,
            input_std=(1.5, 0.5, 3.0, *(0.6,) * (2 * CAR_HISTORY + 2)),
            output_std=(0.05, 0.02, 0.1, 0.1, 0.1, 0.6),
            gap_std=(0.01, 0.01, 0.03, 0.05, 0.05, 0.4),
            gap_lengthscale=3.0,
            function_lengthscale=3.0,
        ),
        _RACECAR,
    )
}

__all__ = ["CASES", "TEST_ROWS", "Case", "Data"]
