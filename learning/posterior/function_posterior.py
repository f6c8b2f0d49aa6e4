"""Posterior over functions: a Gaussian process around a simulator with unknown parameters, conditioned on rows.

Model: ``y = f(x, theta) + discrepancy(x) + noise``, with a prior on the parameters ``theta``, a Gaussian process for
the model discrepancy (the sim-to-real gap process of Rothfuss et al., arXiv 2403.16644, section 4.2) and Student-t
noise. Given ``theta`` the posterior is Gaussian in closed form (Rasmussen and Williams 2006, equations 2.23 and 2.24);
moments are averaged over draws of ``theta`` (law of total covariance). The method is carlab's, not the paper's.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from learning.evaluation import Mixture
from learning.networks.normaliser import Normaliser
from learning.posterior.discrepancy import DiscrepancyCovariance
from learning.priors.domain_models import DomainModel

JITTER = 1e-5
"""Variance added to a marginal, in normalised outputs."""
_MAX_BATCH_POINTS = 256


@dataclass(frozen=True, slots=True)
class FunctionPosterior:
    """Gaussian marginals of simulator and discrepancy given rows, in normalised outputs.

    Attributes:
        normaliser: of inputs and outputs.
        noise_std: of the measurements (O,).
        dof: degrees of freedom of the noise's multivariate Student-t distribution; infinite for a Gaussian.
        correlation: of prediction errors in normalised outputs (O, O).
        model: the simulator; None: a zero mean.
        parameters: draws of its parameters given the rows (P, K).
        discrepancy: covariance of the model discrepancy; None: the simulator is exact.
        inputs: normalised inputs of the rows and the simulator's mean output (n, D + O); (n, D) without a simulator.
        cholesky: Cholesky factors of the rows' covariance (O, n, n).
        whitened_residuals: residuals of each draw, whitened by the Cholesky factors (O, n, P).
    """

    normaliser: Normaliser
    noise_std: Tensor
    dof: float
    correlation: Tensor
    model: DomainModel | None
    parameters: Tensor | None
    discrepancy: DiscrepancyCovariance | None
    inputs: Tensor
    cholesky: Tensor
    whitened_residuals: Tensor

    @property
    def data(self) -> Tensor:
        """Raw inputs (n, D) of the rows."""
        units = self.normaliser
        return units.raw_inputs(self.inputs[:, : len(units.input_mean)].to(units.input_mean))

    def marginals(self, sets: Tensor) -> tuple[Tensor, Tensor]:
        """Moments of the noise-free function at measurement sets.

        Args:
            sets: raw inputs (B, N, D).

        Returns:
            Means (B, O, N), single precision, and covariances (B, O, N, N), double precision.
        """
        batches = [
            self._batch_marginals(part) for part in torch.split(sets, max(_MAX_BATCH_POINTS // sets.shape[1], 1))
        ]
        return torch.cat([m for m, _ in batches]), torch.cat([c for _, c in batches])

    def predict(self, inputs: Tensor) -> Mixture:
        """Joint prediction of all outputs of a measurement at raw inputs (N, D), in raw units."""
        mean, covariance = self.marginals(inputs[:, None])
        std = (covariance[:, :, 0, 0].clamp_min(0.0) + self.noise_std**2).sqrt().float()
        decorrelation = self.normaliser.error_decorrelation
        if decorrelation is None:
            std = std * self.normaliser.output_std
        means = self.normaliser.raw_outputs(mean[:, :, 0])[None]
        return Mixture(means, std[None], self.dof, decorrelation, self.correlation)

    def discrepancy_marginals(self, sets: Tensor, draws: Tensor) -> tuple[Tensor, Tensor]:
        """Moments of the model discrepancy at measurement sets, given draws of the parameters.

        Args:
            sets: raw inputs (B, N, D).
            draws: indices of the draws (L,).

        Returns:
            Means (L, B, O, N), single precision, and covariances (B, O, N, N), double precision, of every draw.
        """
        batches = []
        for part in torch.split(sets, max(_MAX_BATCH_POINTS // sets.shape[1], 1)):
            at, simulated = self._simulated(part.flatten(0, 1))
            change, covariance = self._discrepancy(at.view(*part.shape[:2], at.shape[1]))
            change = change.expand_as(simulated)[:, draws]
            by_set = change.reshape(*change.shape[:2], *part.shape[:2])
            batches.append((by_set.permute(1, 2, 0, 3).float(), covariance))
        return torch.cat([m for m, _ in batches], dim=1), torch.cat([c for _, c in batches])

    def _batch_marginals(self, sets: Tensor) -> tuple[Tensor, Tensor]:
        count, points = sets.shape[:2]
        outputs = len(self.noise_std)
        at, draws = self._simulated(sets.flatten(0, 1))
        change, covariance = self._discrepancy(at.view(count, points, at.shape[1]))
        draws = draws + change
        mean = draws.mean(dim=1)
        deviation = (draws - mean[:, None]).view(outputs, draws.shape[1], count, points).permute(2, 0, 1, 3)
        covariance = covariance + deviation.transpose(2, 3) @ deviation / draws.shape[1]
        return mean.view(outputs, count, points).transpose(0, 1).float(), covariance

    def _simulated(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs of the discrepancy (F, D + O) and normalised outputs of the draws (O, P, F) at raw inputs (F, D).

        Without a simulator, inputs (F, D) and one draw of zeros.
        """
        at = self.normaliser.inputs(inputs).double()
        if self.model is None or self.parameters is None:
            return at, at.new_zeros((len(self.noise_std), 1, len(inputs)))
        draws = simulate(self.model, inputs, self.parameters, self.normaliser).permute(2, 0, 1)
        return torch.cat([at, draws.mean(dim=1).T], dim=1), draws

    def _discrepancy(self, at: Tensor) -> tuple[Tensor, Tensor]:
        """Means given each draw (O, P, B N) and covariances (B, O, N, N) of the discrepancy at its inputs (B, N, D)."""
        count, points, outputs = *at.shape[:2], len(self.noise_std)
        means, covariance = at.new_zeros((outputs, 1, 1)), at.new_zeros((count, outputs, points, points))
        if self.discrepancy is None:
            return means, covariance
        covariance = self.discrepancy(at).transpose(0, 1)
        if not len(self.inputs):
            return means, covariance
        cross = self.discrepancy(self.inputs, at.flatten(0, 1))
        half = torch.linalg.solve_triangular(self.cholesky, cross, upper=False)
        blocks = half.view(outputs, len(self.inputs), count, points).permute(2, 0, 1, 3)  # (B, O, n, N)
        return self.whitened_residuals.transpose(1, 2) @ half, covariance - blocks.transpose(2, 3) @ blocks


def simulate(model: DomainModel, inputs: Tensor, parameters: Tensor, normaliser: Normaliser) -> Tensor:
    """Normalised outputs (P, N, O) of the simulator, double precision, at raw inputs (N, D) for parameters (P, K)."""
    if not len(inputs):
        return torch.zeros((len(parameters), 0, len(normaliser.output_std)), dtype=torch.float64, device=inputs.device)
    with torch.no_grad():
        return normaliser.outputs(model(inputs, parameters)).double()
