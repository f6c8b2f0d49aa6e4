"""Residual of rows against draws of a simulator's parameters, in normalised outputs."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from carlab.core.errors import DataError
from learning.networks.normaliser import Normaliser
from learning.posterior.function_posterior import simulate
from learning.priors.domain_models import MAX_PLAUSIBLE_OUTPUT, NO_FINITE_OUTPUT, DomainModel
from learning.priors.function_prior import moments


@dataclass(frozen=True, slots=True)
class SimulatorResidual:
    """Residual of the simulator's mean.

    Attributes:
        mean: normalised outputs less the mean of the draws (n, O).
        parameter_covariance: covariance of the draws (O, n, n); None without a simulator.
        inputs: of the discrepancy (n, D + O), or (n, D) without a simulator.
        posterior: normalised outputs less each draw (P, n, O), if the draws are given the rows.
    """

    mean: Tensor
    parameter_covariance: Tensor | None
    inputs: Tensor
    posterior: Tensor | None = None


def simulator_residual(
    model: DomainModel | None,
    inputs: Tensor,
    outputs: Tensor,
    parameters: Tensor | None,
    normaliser: Normaliser,
    *,
    given_rows: bool = True,
) -> SimulatorResidual:
    """Residual of rows.

    Args:
        model: the simulator; None: a zero mean.
        inputs: raw (n, D).
        outputs: raw (n, O).
        parameters: draws (P, K), if any.
        normaliser: of inputs and outputs.
        given_rows: whether the draws are given the rows.

    Raises:
        DataError: no draw gives plausible outputs.
    """
    at, targets = normaliser.inputs(inputs).double(), normaliser.outputs(outputs).double()
    if model is None or parameters is None:
        return SimulatorResidual(targets, None, at)
    simulated = simulate(model, inputs, parameters, normaliser)
    simulated = simulated[plausible_draws(simulated)]
    mean, covariance = moments(simulated)
    given = targets - simulated if given_rows else None
    return SimulatorResidual(targets - mean, covariance, torch.cat([at, mean], dim=1), given)


def plausible_draws(simulated: Tensor) -> Tensor:
    """Mask (P,) of the draws whose outputs (P, N, O) are finite and of plausible size.

    Raises:
        DataError: no draw is plausible.
    """
    plausible = (simulated.abs() < MAX_PLAUSIBLE_OUTPUT).flatten(1).all(dim=1)
    if not bool(plausible.any()):
        raise DataError(NO_FINITE_OUTPUT)
    return plausible
