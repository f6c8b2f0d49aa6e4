"""Cases of the regression study: training rows, simulator and units.

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
from learning.networks.normaliser import Normaliser
from learning.priors.domain_models import DomainModel, KinematicCar, Pendulum, Sinusoids, draw_parameters
from learning.priors.function_prior import RbfCovariance
from learning.priors.motor_pendulum import MotorPendulum
from learning.priors.simulator_model import CarModel
from sim_backends.car_parameters import MocapParameters, SimulatorConfig

TEST_ROWS = 1000
MIN_NOISE = 0.005


@dataclass(frozen=True, slots=True)
class Data:
    """Training and test rows: inputs (n, D), and outputs (n, O), which are changes of a state.

    ``test_yaw`` (n,) is the heading of the car at the test rows [rad], if it is known.
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
        prior_with_discrepancy: the same with a discrepancy process inside its dynamics, as the prior of Sim-FSVGD;
            where it is None, ``prior`` and a discrepancy on its outputs.
        truth: the simulator that makes the data, with a distribution of its parameters; None where only the authors'
            arrays have it.
        counts: numbers of rows.
        noise_std: of the measured outputs (O,), raw.
        likelihood_std: the authors' noise at the start of a fit (O,), raw.
        fit_noise: whether it is fitted.
        input_std: units of the inputs (D,).
        output_std: units of the outputs (O,).
        discrepancy_std: of the authors' Gaussian process between simulator and reality (O,), raw; None: the simulator
            is exact.
        discrepancy_lengthscale: of that process on raw inputs.
        function_lengthscale: of the Gaussian-process prior of FSVGD and of GreyBox, on normalised inputs.
        prior_discrepancy: prior size of the discrepancy where the way is ``ours``, in units of the outputs; None: the
            simulator is exact.
        ours: the same case in the coordinates of the way ``ours``, where these are others.
        in_body_frame: whether rows are transformed into the frame of the step's start.
        comparison_note: sentence that a table of this case needs where the way is ``ours``.
    """

    name: str
    prior: DomainModel
    prior_with_discrepancy: DomainModel | None
    truth: DomainModel | None
    counts: tuple[int, ...]
    noise_std: tuple[float, ...]
    likelihood_std: tuple[float, ...]
    fit_noise: bool
    input_std: tuple[float, ...]
    output_std: tuple[float, ...]
    discrepancy_std: tuple[float, ...] | None
    discrepancy_lengthscale: float
    function_lengthscale: float
    prior_discrepancy: float | None = 0.3
    ours: Case | None = None
    in_body_frame: bool = False
    comparison_note: str = ""

    @property
    def prior_noise_std(self) -> tuple[float, ...]:
        """Twice the sensor's noise, and at least ``MIN_NOISE`` of the output's unit (O,), raw."""
        return tuple(max(2.0 * n, MIN_NOISE * o) for n, o in zip(self.noise_std, self.output_std, strict=True))

    def prior_discrepancy_for(self, count: int) -> float | tuple[float, ...] | None:
        """Prior size of the discrepancy with so many rows, in units of all outputs or of each (O,); None: exact."""
        return self.prior_discrepancy

    @property
    def normaliser(self) -> Normaliser:
        """Of inputs and outputs; fixed, not of the data."""
        inputs, outputs = torch.tensor(self.input_std), torch.tensor(self.output_std)
        return Normaliser(torch.zeros_like(inputs), inputs, torch.zeros_like(outputs), outputs)

    def discrepancy(self) -> RbfCovariance | None:
        """Covariance of the authors' discrepancy, in normalised outputs on raw inputs."""
        if self.discrepancy_std is None:
            return None
        scales = [g / o for g, o in zip(self.discrepancy_std, self.output_std, strict=True)]
        return RbfCovariance(tuple(scales), (self.discrepancy_lengthscale,))

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
    """Rows of a car in the frame of each step's start.

    Pairs of outputs are rotated, which preserves volumes: the likelihood is the same in both frames.

    Args:
        before: x, y, sin, cos of yaw, vx, vy in the world, yaw rate, and commands (n, 7 + 2).
        after: the first seven a step later (n, 7).

    Returns:
        The same inputs for a car at the origin that heads along x, and changes (n, 7).
    """
    sin, cos = before[:, 2], before[:, 3]

    def rotated(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        return cos * x + sin * y, cos * y - sin * x

    change = after - before[:, :7]
    zero = torch.zeros_like(sin)
    inputs = torch.stack([zero, zero, zero, zero + 1.0, *rotated(before[:, 4], before[:, 5]), *before[:, 6:].T], dim=1)
    cos_change, sin_change = rotated(after[:, 3], after[:, 2])
    outputs = [
        *rotated(change[:, 0], change[:, 1]),
        sin_change,
        cos_change - 1.0,
        *rotated(change[:, 4], change[:, 5]),
        change[:, 6],
    ]
    return inputs, torch.stack(outputs, dim=1)


@dataclass(frozen=True, slots=True)
class BodyFrame:
    """A car's domain model with its inputs in the car's frame."""

    model: KinematicCar

    @property
    def size(self) -> int:
        """As the model."""
        return self.model.size

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        """The model's, in the car's frame."""
        drawn = self.model.inputs(count, generator)
        return in_body_frame(drawn, drawn[:, :7])[0]

    def parameters(self, normal: Tensor) -> Tensor:
        """As the model."""
        return self.model.parameters(normal)

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        """Changes; the car heads along x, so that world and body frame agree."""
        return self.model(inputs, parameters)


_CAR_NOISE = (0.0011, 0.0011, 0.0018, 0.0018, 0.0082, 0.0082, 0.0368)

CAR_HISTORY = 3
"""Commands before the last one; the delay of 80 ms is two and a half periods."""
_NO_LATENCY = MocapParameters(latency_s=0.0)
PACEJKA = SimulatorConfig(mocap=_NO_LATENCY)
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
KINEMATIC = SimulatorConfig(kind="kinematic", mocap=_NO_LATENCY)
KINEMATIC_RANGES = {
    "motor.drive_gain": (6.0, 10.0),
    "motor.damping": (1.0, 3.2),
    "steering.max_angle": (0.3, 0.7),
}

_WORLD = Case(
    name="racecar",
    prior=KinematicCar(place_m=4.0, speed_mps=6.0, rate_radps=8.0),
    prior_with_discrepancy=None,
    truth=None,
    counts=(20, 50, 100, 200, 400),
    noise_std=_CAR_NOISE,
    likelihood_std=tuple(20.0 * s for s in _CAR_NOISE),
    fit_noise=True,
    input_std=(3.0, 3.0, 1.0, 1.0, 4.0, 4.0, 5.0, 1.0, 1.0),
    output_std=(0.127, 0.123, 0.060, 0.056, 2.86, 2.86, 5.65),
    discrepancy_std=(0.004, 0.004, 0.015, 0.015, 0.15, 0.15, 0.75),
    discrepancy_lengthscale=10.0,
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
    prior_with_discrepancy=Pendulum(rate_discrepancy=(1.0, 0.5, 0.5)),
    truth=Pendulum(frictions=(0.4, 0.6), drags=(0.4, 0.6)),
    counts=(5, 10, 20, 50),
    noise_std=(0.02, 0.02, 0.02),
    likelihood_std=(0.05, 0.05, 0.5),
    fit_noise=True,
    input_std=(1.0, 1.0, 3.5, 2.0),
    output_std=(0.158, 0.150, 0.951),
    discrepancy_std=(0.025, 0.025, 0.25),
    discrepancy_lengthscale=10.0,
    function_lengthscale=0.4,
    prior_discrepancy=0.03,
    comparison_note=(
        "The discrepancy given to Sim-FSVGD here contains the form of the truth (friction by the rate), which SysID "
        "and GreyBox do not have. Given the same family, SysID scores -5.55 / -6.73 / -7.35 / -7.34 at n = 5 / 10 / "
        "20 / 50."
    ),
)
# Prior sizes without data. Rate: as with the other pendulum, at the fastest rate about the size of gravity. Sign of the
# rate: a tenth of that. Motor: half of either command.
_PENDULUM_MOTOR = replace(
    _PENDULUM,
    name="pendulum_motor",
    prior=MotorPendulum(),
    prior_with_discrepancy=MotorPendulum(rate_discrepancy=(1.0, 0.5, 0.5, 1.0), command_discrepancy=0.5),
    truth=MotorPendulum(frictions=(0.4, 0.6), drags=(0.4, 0.6), dry=(0.1, 0.4), lags=(0.02, 0.06)),
    input_std=(1.0, 1.0, 3.5, 2.0, 2.0),
    comparison_note=(
        "The discrepancy given to Sim-FSVGD here contains the form of the truth (friction by the rate and its sign, "
        "both commands), which SysID and GreyBox do not have."
    ),
)

CASES = {
    case.name: case
    for case in (
        Case(
            name="1d",
            prior=Sinusoids(),
            prior_with_discrepancy=None,
            truth=Sinusoids(),
            counts=(2,),
            noise_std=(0.0,),
            likelihood_std=(0.4,),
            fit_noise=False,
            input_std=(5.0,),
            output_std=(8.0,),
            discrepancy_std=None,
            discrepancy_lengthscale=1.0,
            function_lengthscale=0.2,
            prior_discrepancy=None,
        ),
        _PENDULUM,
        _PENDULUM_MOTOR,
        Case(
            name="car",
            prior=CarModel(KINEMATIC, CAR_HISTORY, KINEMATIC_RANGES),
            prior_with_discrepancy=None,
            truth=CarModel(PACEJKA, CAR_HISTORY, PACEJKA_RANGES),
            counts=(20, 50, 100, 200, 400),
            noise_std=(0.001, 0.001, 0.002, 0.008, 0.008, 0.04),
            likelihood_std=(0.01, 0.01, 0.02, 0.05, 0.05, 0.3),
            fit_noise=True,
            input_std=(1.5, 0.5, 3.0, *(0.6,) * (2 * CAR_HISTORY + 2)),
            output_std=(0.05, 0.02, 0.1, 0.1, 0.1, 0.6),
            discrepancy_std=(0.01, 0.01, 0.03, 0.05, 0.05, 0.4),
            discrepancy_lengthscale=3.0,
            function_lengthscale=3.0,
        ),
        _RACECAR,
    )
}

__all__ = ["CASES", "TEST_ROWS", "Case", "Data"]
