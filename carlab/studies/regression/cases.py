"""Cases of the regression study: data, simulator and units.

The cases are those of the paper (Rothfuss et al., arXiv 2403.16644, section 6.1) with the domains, priors and units of
the authors' public code. In the body frame, the race car has other units, and the domain of the data instead of the
authors' wider measurement domain. Three more pendulums hide an effect that no family contains. Data is drawn by a
simulator here, or read from arrays of the authors' code.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from carlab.core.errors import ConfigError, DataError
from learning.networks.normaliser import Normaliser
from learning.priors.domain_models import (
    DomainModel,
    KinematicCar,
    Pendulum,
    Sinusoids,
    detent,
    draw_parameters,
    position_friction,
    saturated_torque,
)
from learning.priors.function_prior import RbfCovariance
from learning.priors.motor_pendulum import MotorPendulum
from learning.priors.simulator_model import CarModel
from sim_backends.car_parameters import MocapParameters, SimulatorConfig

TEST_ROWS = 1000
MIN_NOISE = 0.005


@dataclass(frozen=True, slots=True)
class Data:
    """Training and test rows.

    Attributes:
        inputs: training inputs (n, D).
        outputs: training outputs (n, O): changes of the state.
        test_inputs: test inputs (m, D).
        test_outputs: test outputs (m, O).
        test_yaw: heading of the car at the test rows (m,) [rad]; None if it is unknown.
    """

    inputs: Tensor
    outputs: Tensor
    test_inputs: Tensor
    test_outputs: Tensor
    test_yaw: Tensor | None = None

    def to(self, device: torch.device | str) -> Data:
        """The same data on a device."""
        moved = Data(*(v.to(device) for v in (self.inputs, self.outputs, self.test_inputs, self.test_outputs)))
        return moved if self.test_yaw is None else replace(moved, test_yaw=self.test_yaw.to(device))


@dataclass(frozen=True, slots=True)
class Case:
    """A case of the study; standard deviations are in raw units.

    Attributes:
        name: name on the command line and in the file names of the authors' arrays.
        prior: simulator that the methods know.
        counts: numbers of training rows.
        noise_std: standard deviation of the measurement noise of the outputs (O,).
        likelihood_std: initial standard deviation of the noise in the authors' fits (O,).
        fit_noise: whether the noise is fitted.
        input_std: units of the inputs (D,).
        output_std: units of the outputs (O,).
        discrepancy_std: standard deviation of the authors' discrepancy process (O,); None: the simulator is exact.
        discrepancy_lengthscale: lengthscale of that process on raw inputs.
        function_lengthscale: lengthscale of the Gaussian-process prior of FSVGD on normalised inputs.
        prior_with_structure: the same simulator with further terms inside its dynamics, which ``--structure`` gives to
            all methods; None: there is none.
        truth: simulator that generates the data, with a distribution of its parameters; None: the authors' arrays only.
        prior_discrepancy: prior size of carlab's discrepancy, in units of the outputs; None: the simulator is exact.
        body_frame: the same case in the body frame for all methods but those of the paper; None: the same coordinates.
        in_body_frame: whether rows are transformed to the car's frame at the start of the step.
        plain_prior: the simulator without structure, if ``prior`` has it.
    """

    name: str
    prior: DomainModel
    counts: tuple[int, ...]
    noise_std: tuple[float, ...]
    likelihood_std: tuple[float, ...]
    fit_noise: bool
    input_std: tuple[float, ...]
    output_std: tuple[float, ...]
    discrepancy_std: tuple[float, ...] | None
    discrepancy_lengthscale: float
    function_lengthscale: float
    prior_with_structure: DomainModel | None = None
    truth: DomainModel | None = None
    prior_discrepancy: float | None = 0.3
    body_frame: Case | None = None
    in_body_frame: bool = False
    plain_prior: DomainModel | None = None

    @property
    def prior_noise_std(self) -> tuple[float, ...]:
        """Twice the measurement noise, but at least ``MIN_NOISE`` times the unit of the output (O,), in raw units."""
        return tuple(max(2.0 * n, MIN_NOISE * o) for n, o in zip(self.noise_std, self.output_std, strict=True))

    def prior_discrepancy_for(self, count: int) -> float | tuple[float, ...] | None:
        """Prior size of the discrepancy with ``count`` rows, in units of all outputs or of each (O,); None: exact."""
        return self.prior_discrepancy

    def structured(self) -> Case:
        """The case in which every method knows the simulator with structure. Raises ConfigError without structure."""
        if self.prior_with_structure is None:
            raise ConfigError(f"Case '{self.name}' has no structured simulator; remove --structure.")
        return replace(self, prior=self.prior_with_structure, plain_prior=self.prior)

    @property
    def normaliser(self) -> Normaliser:
        """Normalisation of inputs and outputs by the fixed units of the case."""
        inputs, outputs = torch.tensor(self.input_std), torch.tensor(self.output_std)
        return Normaliser(torch.zeros_like(inputs), inputs, torch.zeros_like(outputs), outputs)

    def discrepancy(self) -> RbfCovariance | None:
        """Covariance of the authors' discrepancy process: normalised outputs, raw inputs."""
        if self.discrepancy_std is None:
            return None
        scales = [g / o for g, o in zip(self.discrepancy_std, self.output_std, strict=True)]
        return RbfCovariance(tuple(scales), (self.discrepancy_lengthscale,))

    def data(self, count: int, seed: int) -> Data:
        """Draw ``count`` training rows and ``TEST_ROWS`` test rows of one true system.

        Noise is added to the outputs only: the state before a step is known exactly, as in the authors' data.

        Raises:
            DataError: the case has no simulator of the true system.
        """
        if self.truth is None:
            raise DataError(
                f"Data of '{self.name}' cannot be drawn; give the folder of the authors' arrays with --data."
            )
        generator = torch.Generator().manual_seed(10_000 + seed)
        system = draw_parameters(self.truth, 1, generator)
        inputs = self.truth.inputs(count + TEST_ROWS, generator)
        outputs = self.truth(inputs, system)[0]
        outputs = outputs + torch.tensor(self.noise_std) * torch.randn(outputs.shape, generator=generator)
        return Data(inputs[:count], outputs[:count], inputs[count:], outputs[count:])

    def arrays_file(self, count: int, seed: int) -> str:
        """Name of the file of the authors' arrays."""
        return "sinusoid_n2.npz" if self.name == "1d" else f"{self.name}_seed{seed}_n{count}.npz"

    def recorded(self, folder: Path, count: int, seed: int) -> Data:
        """Read the authors' arrays of this case. Raises DataError if the file is missing or damaged."""
        path = folder / self.arrays_file(count, seed)
        if not path.is_file():
            raise DataError(
                f"{path} does not exist; leave out --data to draw the data here, or choose other --rows or fewer "
                "--seeds."
            )
        try:
            with np.load(path) as arrays:
                x, y, tx, ty = (torch.from_numpy(arrays[k].astype(np.float32)) for k in ("x", "y", "x_test", "y_test"))
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise DataError(f"{path} does not contain the arrays x, y, x_test and y_test; create it again.") from error
        if self.name == "1d":
            return Data(x, y, tx, ty)
        width = y.shape[1]
        if self.in_body_frame:
            return Data(*in_body_frame(x, y), *in_body_frame(tx, ty))
        return Data(x, y - x[:, :width], tx, ty - tx[:, :width])


def in_body_frame(before: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
    """Transform rows of a car to the body frame at the start of each step.

    Outputs are rotated in pairs. A rotation preserves volumes, so the likelihood is the same in both frames.

    Args:
        before: x, y, sin and cos of yaw, vx, vy in the world frame, yaw rate, and two commands (n, 9).
        after: the first seven columns one step later (n, 7).

    Returns:
        The inputs of the same car at the origin that heads along x (n, 9), and the changes of the state (n, 7).
    """
    sin, cos = before[:, 2], before[:, 3]

    def rotated(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        return cos * x + sin * y, cos * y - sin * x

    change = after - before[:, :7]
    zeros = torch.zeros_like(sin)
    inputs = torch.stack(
        [zeros, zeros, zeros, zeros + 1.0, *rotated(before[:, 4], before[:, 5]), *before[:, 6:].T], dim=1
    )
    cos_of_turn, sin_of_turn = rotated(after[:, 3], after[:, 2])
    outputs = [
        *rotated(change[:, 0], change[:, 1]),
        sin_of_turn,
        cos_of_turn - 1.0,
        *rotated(change[:, 4], change[:, 5]),
        change[:, 6],
    ]
    return inputs, torch.stack(outputs, dim=1)


@dataclass(frozen=True, slots=True)
class BodyFrameCar(KinematicCar):
    """The kinematic car with inputs in the body frame: it heads along x, so that world and body frame agree."""

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        """Inputs of the kinematic car (count, 9), transformed to the body frame."""
        drawn = KinematicCar.inputs(self, count, generator)
        return in_body_frame(drawn, drawn[:, :7])[0]


_CAR_NOISE = (0.0011, 0.0011, 0.0018, 0.0018, 0.0082, 0.0082, 0.0368)

CAR_HISTORY = 3
"""Number of past commands in the input besides the last one; the delay of 80 ms is 2.5 control periods."""
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

_RACECAR_WORLD_FRAME = Case(
    name="racecar",
    prior=KinematicCar(place_m=4.0, speed_mps=6.0, rate_radps=8.0),
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
_RACECAR_BODY_FRAME = replace(
    _RACECAR_WORLD_FRAME,
    prior=BodyFrameCar(),
    input_std=(3.0, 3.0, 1.0, 1.0, 1.5, 1.5, 2.0, 0.6, 0.6),
    output_std=(0.1, 0.06, 0.1, 0.03, 1.0, 1.0, 3.0),
    function_lengthscale=2.0,
    in_body_frame=True,
)
_RACECAR = replace(_RACECAR_WORLD_FRAME, body_frame=_RACECAR_BODY_FRAME)

_PENDULUM = Case(
    name="pendulum",
    prior=Pendulum(),
    prior_with_structure=Pendulum(rate_discrepancy=(1.0, 0.5, 0.5)),
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
)
# Sizes of the structured terms, chosen without data. Friction by the rate: as for the pendulum, about gravity at the
# highest rate. Friction by the sign of the rate: a tenth of that. Motor: half of each command.
_PENDULUM_MOTOR = replace(
    _PENDULUM,
    name="pendulum_motor",
    prior=MotorPendulum(),
    prior_with_structure=MotorPendulum(rate_discrepancy=(1.0, 0.5, 0.5, 1.0), command_discrepancy=0.5),
    truth=MotorPendulum(frictions=(0.4, 0.6), drags=(0.4, 0.6), dry=(0.1, 0.4), lags=(0.02, 0.06)),
    input_std=(1.0, 1.0, 3.5, 2.0, 2.0),
)
_HIDDEN_EFFECTS = tuple(
    replace(_PENDULUM, name=f"pendulum_{name}", truth=Pendulum(hidden_acceleration=effect))
    for name, effect in (("detent", detent), ("saturation", saturated_torque), ("friction", position_friction))
)
"""One effect that no method knows. The structured simulator has friction by the rate, which is wrong here."""

CASES = {
    case.name: case
    for case in (
        Case(
            name="1d",
            prior=Sinusoids(),
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
        *_HIDDEN_EFFECTS,
        Case(
            name="car",
            prior=CarModel(KINEMATIC, CAR_HISTORY, KINEMATIC_RANGES),
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
