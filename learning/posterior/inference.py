"""Inference of the posterior over functions: covariance, parameters, noise and output decorrelation given rows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from carlab.core.errors import DataError
from learning.networks.normaliser import Normaliser
from learning.outliers import (
    decorrelation_of,
    initial_row_weights,
    leave_one_out_log_density,
    mahalanobis_sq,
    median_scale,
    output_correlation,
    student_weights,
)
from learning.posterior.discrepancy import (
    CHOLESKY_JITTER,
    PRIOR_DISCREPANCY_STD,
    DiscrepancyCovariance,
    fit_discrepancy,
    fit_noise,
)
from learning.posterior.function_posterior import FunctionPosterior, simulate
from learning.posterior.parameter_posterior import posterior_parameters
from learning.posterior.row_noise import FIT_BLOCK_ROWS, RowNoise, prior_logs, random_rows
from learning.posterior.simulator_residual import SimulatorResidual, plausible_draws, simulator_residual
from learning.priors.domain_models import DomainModel, draw_parameters

PARAMETER_DRAWS = 128
"""Draws of the parameters given data."""
PRIOR_DRAWS = 1024
PARAMETER_ROWS = 800
"""Maximum number of rows from which the parameters are inferred."""
EARLY_PARAMETER_ROWS = 200
"""The same in all iterations but the last."""
MAX_ROWS = 2000
"""Maximum number of rows on which the process is conditioned; a random subset of more."""
DOMAIN_ROWS = 64
"""Inputs of the domain at which draws of the prior are checked without data."""
ITERATIONS = 3
"""Alternations between covariance, parameters, row weights and output decorrelation (docs/decisions/0013)."""
MIN_NOISE_SHARE = 0.01
"""Lower bound of the noise, relative to the prior noise."""
MIN_ROWS_STUDENT = 40
"""Minimum number of rows for Student-t noise, output correlation and restarts."""
MULTIPLIER_SHARE = 0.1
"""Prior size of the discrepancy's multiplicative part relative to its other parts, from ``MIN_ROWS_STUDENT`` rows on
(docs/decisions/0012)."""
RESTART_SCALES = (1.0, 0.3, 3.0, 10.0)
"""Factors on the prior discrepancy of the restarts; the first is the default (docs/decisions/0011)."""
MIN_RESTART_GAIN_SE = 2.0
"""Standard errors by which a restart's leave-one-out density must exceed the default's."""
ROWS_PER_DOF, MIN_DOF = 8.0, 6.0
"""Rows per allowed degree of freedom of a fitted covariance, and the lower bound of the maximum."""


def infer(
    model: DomainModel | None,
    inputs: Tensor,
    outputs: Tensor,
    normaliser: Normaliser,
    noise_std: Tensor,
    *,
    discrepancy_std: Tensor | None = None,
    with_discrepancy: bool = True,
    noise_known: bool = False,
    step_numbers: Tensor | None = None,
    restart_scales: Sequence[float] = RESTART_SCALES,
    seed: int = 0,
) -> FunctionPosterior:
    """Condition simulator, discrepancy and noise on rows.

    Args:
        model: the simulator; None: a zero mean.
        inputs: raw (n, D); may be empty.
        outputs: raw (n, O).
        normaliser: of inputs and outputs.
        noise_std: prior median of the noise, raw (O,).
        discrepancy_std: prior size of the model discrepancy, raw (O,); by default ``PRIOR_DISCREPANCY_STD`` in the
            outputs' units.
        with_discrepancy: whether the model has a discrepancy.
        noise_known: whether the noise is fixed at ``noise_std``; ignored with a discrepancy, which needs fitted noise.
            Student-t tails and the noise's scale are always fitted from ``MIN_ROWS_STUDENT`` rows on.
        step_numbers: of the rows' steps (n,); those of consecutive steps of a drive differ by 1, and the noise of such
            rows is correlated (``row_noise``). None: the noise of rows is independent.
        restart_scales: factors on ``discrepancy_std``, one for each fit; all but the first are used from
            ``MIN_ROWS_STUDENT`` rows on.
        seed: of all draws.

    Raises:
        DataError: missing or infinite numbers, a unit of zero, or a simulator without finite outputs.
    """
    _check(inputs, outputs, normaliser, noise_std)
    if len(inputs) > MAX_ROWS:
        generator = torch.Generator().manual_seed(seed)
        chosen = random_rows(len(inputs), MAX_ROWS, step_numbers, generator).to(inputs.device)
        inputs, outputs = inputs[chosen], outputs[chosen]
        step_numbers = None if step_numbers is None else step_numbers[chosen]
    default_std = PRIOR_DISCREPANCY_STD * torch.ones_like(noise_std)
    prior_std = default_std if discrepancy_std is None else discrepancy_std / normaliser.output_std
    problem = _Problem(
        model, inputs, outputs, normaliser, (noise_std / normaliser.output_std).double(), prior_std.double(),
        with_discrepancy, noise_known, seed, step_numbers,
    )  # fmt: skip
    if with_discrepancy and problem.has_student_noise:
        return _best_of_restarts(problem, restart_scales)
    return _fit(problem)[0]


def _check(inputs: Tensor, outputs: Tensor, normaliser: Normaliser, noise_std: Tensor) -> None:
    if not (torch.isfinite(inputs).all() and torch.isfinite(outputs).all()):
        raise DataError("The data holds numbers that are missing or infinite; leave those rows out and fit again.")
    if len(inputs) != len(outputs):
        raise DataError(f"There are {len(inputs)} rows of inputs and {len(outputs)} of outputs; each row needs both.")
    if not all(bool((size > 0.0).all()) for size in (normaliser.input_std, normaliser.output_std, noise_std)):
        raise DataError("The unit or noise of an input or output is not positive; give positive values.")


@dataclass(frozen=True, slots=True)
class _Problem:
    """Rows and priors; noise and discrepancy in normalised units."""

    model: DomainModel | None
    inputs: Tensor
    outputs: Tensor
    normaliser: Normaliser
    noise_std: Tensor
    discrepancy_std: Tensor
    with_discrepancy: bool
    noise_known: bool
    seed: int
    step_numbers: Tensor | None

    @property
    def has_student_noise(self) -> bool:
        """Whether there are enough rows for Student-t noise."""
        return len(self.inputs) >= MIN_ROWS_STUDENT

    @property
    def prior_noise(self) -> RowNoise:
        """Prior median of the noise."""
        return RowNoise.of_logs(prior_logs(self.noise_std, self.step_numbers)[0], self.step_numbers)

    @property
    def multiplier_share(self) -> float:
        """Prior size of the discrepancy's multiplicative part, relative to its other parts."""
        return MULTIPLIER_SHARE if self.has_student_noise else 1.0

    @property
    def max_dof(self) -> float:
        """Maximum degrees of freedom for a covariance fitted to these rows."""
        fitted = len(self.inputs) and (self.with_discrepancy or not self.noise_known)
        return max(len(self.inputs) / ROWS_PER_DOF, MIN_DOF) if fitted else math.inf


@dataclass(slots=True)
class _Estimate:
    """Current estimate of all quantities in the alternation.

    Attributes:
        normaliser: with the current decorrelation of the outputs.
        parameters: draws (P, K).
        residual: of the simulator with these parameters.
        discrepancy: its covariance.
        noise: of the rows.
        noise_prior_std: prior median of the noise in the next fit (O,).
        row_weights: Student-t weights (n,).
        correlation: of leave-one-out errors (O, O).
        dof: degrees of freedom.
        scale: factor on the noise by the median of leave-one-out errors (O,).
        log_density: leave-one-out log density of each row (n,).
    """

    normaliser: Normaliser
    parameters: Tensor | None
    residual: SimulatorResidual
    discrepancy: DiscrepancyCovariance | None
    noise: RowNoise
    noise_prior_std: Tensor
    row_weights: Tensor
    correlation: Tensor
    dof: float
    scale: Tensor
    log_density: Tensor

    def covariance(self, rows: Tensor | None = None) -> Tensor:
        """Covariances (O, m, m) of discrepancy and noise of the rows with indices (m,), or of all rows."""
        inputs, weights = self.residual.inputs, self.row_weights
        if rows is None:
            return _covariance(self.discrepancy, inputs, self.noise, weights)
        return _covariance(self.discrepancy, inputs[rows], self.noise.take(rows), weights[rows])

    def leave_one_out(self, row_weights: Tensor) -> tuple[Tensor, Tensor]:
        """Standardised errors of the rows (n, O) and their variances, of ``RowNoise.leave_one_out``, for weights (n,).

        The covariance is that of discrepancy, noise and outputs of the parameter draws.
        """
        covariance = _covariance(self.discrepancy, self.residual.inputs, self.noise, row_weights)
        if self.residual.parameter_covariance is not None:
            covariance += self.residual.parameter_covariance
        return self.noise.leave_one_out(self.residual.mean, covariance, row_weights)


def _best_of_restarts(problem: _Problem, scales: Sequence[float]) -> FunctionPosterior:
    """Fit with several prior sizes of the discrepancy, and select by the leave-one-out density of the rows.

    A restart replaces the first fit only if its density is higher by ``MIN_RESTART_GAIN_SE`` standard errors. Restarts
    use the parameters of the first fit; the parameters depend little on the scale and cost most of the time.
    """
    first, *restarts = (replace(problem, discrepancy_std=scale * problem.discrepancy_std) for scale in scales)
    best, first_density = _fit(first)
    parameters, best_gain = best.parameters, 0.0
    for restart in restarts:
        try:
            posterior, density = _fit(restart, parameters)
        except torch.linalg.LinAlgError:  # type: ignore[attr-defined]
            continue  # The covariance of this scale is not positive definite; the first fit remains.
        difference = density - first_density
        gain = float(difference.mean())
        if gain > max(best_gain, MIN_RESTART_GAIN_SE * float(difference.std()) / math.sqrt(len(difference))):
            best, best_gain = posterior, gain
    return best


def _fit(problem: _Problem, known_parameters: Tensor | None = None) -> tuple[FunctionPosterior, Tensor]:
    """Alternate between covariance, parameters, row weights and output decorrelation, then condition on the rows.

    Outputs are decorrelated because their discrepancy processes are independent.

    Args:
        problem: rows and priors.
        known_parameters: draws of the parameters given the rows; None: they are inferred.

    Returns:
        The posterior, and the leave-one-out log density of each row (n,) from ``MIN_ROWS_STUDENT`` rows on.
    """
    generator = torch.Generator().manual_seed(problem.seed)
    count = len(problem.inputs)
    rows = random_rows(count, PARAMETER_ROWS, problem.step_numbers, generator, FIT_BLOCK_ROWS)
    rows = rows.to(problem.inputs.device)
    estimate = _initial_estimate(problem, known_parameters, generator)
    for iteration in range(ITERATIONS if count else 0):
        last = iteration == ITERATIONS - 1
        _fit_covariance(problem, estimate)
        if problem.model is not None and known_parameters is None:
            _infer_parameters(problem, estimate, rows if last else rows[:EARLY_PARAMETER_ROWS], generator)
        if problem.has_student_noise:
            width, variance = _fit_student_noise(problem, estimate)
            if not last:
                _decorrelate_outputs(problem, estimate, width, variance)
    return _condition(problem, estimate), estimate.log_density


def _initial_estimate(problem: _Problem, known_parameters: Tensor | None, generator: torch.Generator) -> _Estimate:
    """Prior medians, draws of the prior parameters, and the row weights that follow from them."""
    count, noise = len(problem.inputs), problem.prior_noise
    parameters = known_parameters
    if problem.model is not None and parameters is None:
        parameters = _prior_parameters(problem, problem.model, generator)
    ones = torch.ones(count, dtype=torch.float64, device=problem.inputs.device)
    discrepancy = None
    if problem.with_discrepancy:
        discrepancy = DiscrepancyCovariance.at_prior_median(
            problem.inputs.shape[1], problem.discrepancy_std, problem.multiplier_share
        )
    given_rows = known_parameters is not None
    residual = simulator_residual(
        problem.model, problem.inputs, problem.outputs, parameters, problem.normaliser, given_rows=given_rows
    )
    estimate = _Estimate(
        problem.normaliser, parameters, residual, discrepancy, noise, noise.std, ones,
        torch.eye(len(noise.std), dtype=torch.float64, device=problem.inputs.device), problem.max_dof,
        torch.ones_like(noise.std), torch.zeros_like(ones),
    )  # fmt: skip
    if problem.has_student_noise:
        estimate.row_weights = initial_row_weights(ones, lambda weights: estimate.leave_one_out(weights)[0])
    return estimate


def _prior_parameters(problem: _Problem, model: DomainModel, generator: torch.Generator) -> Tensor:
    """Draws (P, K) of the prior; without data, only those with plausible outputs in the simulator's domain."""
    if len(problem.inputs) or not model.size:
        return draw_parameters(model, PRIOR_DRAWS if model.size else 1, generator).to(problem.inputs)
    drawn = draw_parameters(model, PARAMETER_DRAWS, generator).to(problem.inputs)
    domain = model.inputs(DOMAIN_ROWS, torch.Generator().manual_seed(problem.seed)).to(problem.inputs)
    return drawn[plausible_draws(simulate(model, domain, drawn, problem.normaliser))]


def _fit_covariance(problem: _Problem, estimate: _Estimate) -> None:
    """Fit discrepancy and noise to the residual by the evidence."""
    residual, noise_prior = estimate.residual, estimate.noise_prior_std
    width, given = problem.inputs.shape[1], residual.posterior
    rows = (residual.mean, residual.parameter_covariance) if given is None else (given, None)
    if problem.with_discrepancy:
        estimate.discrepancy, estimate.noise = fit_discrepancy(
            residual.inputs[:, :width], *rows, noise_prior, problem.discrepancy_std, estimate.row_weights,
            None if problem.model is None else residual.inputs[:, width:], problem.seed, problem.multiplier_share,
            problem.step_numbers,
        )  # fmt: skip
    elif not problem.noise_known:
        estimate.noise = fit_noise(*rows, noise_prior, estimate.row_weights, problem.seed, problem.step_numbers)


def _infer_parameters(problem: _Problem, estimate: _Estimate, rows: Tensor, generator: torch.Generator) -> None:
    """Draw the simulator's parameters given the rows with indices (m,), and update the residual."""
    assert problem.model is not None
    cholesky = torch.linalg.cholesky(estimate.covariance(rows))
    estimate.parameters = posterior_parameters(
        problem.model, problem.inputs[rows], problem.outputs[rows], cholesky, estimate.normaliser, PARAMETER_DRAWS,
        generator,
    )  # fmt: skip
    estimate.residual = simulator_residual(
        problem.model, problem.inputs, problem.outputs, estimate.parameters, estimate.normaliser
    )


def _fit_student_noise(problem: _Problem, estimate: _Estimate) -> tuple[Tensor, Tensor]:
    """Fit degrees of freedom, row weights, correlation and scale to leave-one-out errors.

    Returns:
        Scales (O,) of the standardised leave-one-out errors, and their predictive variances (n, O).
    """
    standardised, variance = estimate.leave_one_out(estimate.row_weights)
    estimate.correlation, width = output_correlation(standardised)
    square = mahalanobis_sq(standardised, estimate.correlation)
    dof, estimate.row_weights = student_weights(square, standardised.shape[1])
    estimate.dof = min(dof, problem.max_dof)
    estimate.scale = median_scale(standardised**2, estimate.dof)
    log_det = estimate.normaliser.decorrelation_log_det
    estimate.log_density = leave_one_out_log_density(standardised, variance) + log_det
    return width, variance


def _decorrelate_outputs(problem: _Problem, estimate: _Estimate, width: Tensor, variance: Tensor) -> None:
    """Transform the outputs so that leave-one-out errors are uncorrelated, and update the residual."""
    # A constant output does not determine its noise; the lower bound holds.
    estimate.noise_prior_std = torch.maximum(width * estimate.noise.std, MIN_NOISE_SHARE * problem.noise_std)
    error_std = width * variance.median(dim=0).values.sqrt()
    estimate.normaliser = estimate.normaliser.decorrelated(decorrelation_of(estimate.correlation, error_std))
    estimate.residual = simulator_residual(
        problem.model, problem.inputs, problem.outputs, estimate.parameters, estimate.normaliser
    )


def _condition(problem: _Problem, estimate: _Estimate) -> FunctionPosterior:
    """Condition the estimated process on all rows."""
    model, parameters, normaliser = problem.model, estimate.parameters, estimate.normaliser
    cholesky = torch.linalg.cholesky(estimate.covariance())
    targets = normaliser.outputs(problem.outputs).double()
    residuals = targets[None]
    if model is not None and parameters is not None:
        simulated = simulate(model, problem.inputs, parameters, normaliser)
        plausible = plausible_draws(simulated)
        parameters, residuals = parameters[plausible], targets - simulated[plausible]
    whitened = torch.linalg.solve_triangular(cholesky, residuals.permute(2, 1, 0), upper=False)
    noise_std = torch.maximum(estimate.scale * estimate.noise.std, MIN_NOISE_SHARE * problem.noise_std).float()
    return FunctionPosterior(
        normaliser, noise_std, estimate.dof, estimate.correlation.float(), model, parameters, estimate.discrepancy,
        estimate.residual.inputs, cholesky, whitened,
    )  # fmt: skip


def _covariance(
    discrepancy: DiscrepancyCovariance | None, inputs: Tensor, noise: RowNoise, row_weights: Tensor
) -> Tensor:
    """Covariances (O, n, n) of discrepancy and noise; a row's noise variance is divided by its weight."""
    covariance = (
        noise.covariance(row_weights) if discrepancy is None else noise.add_to(discrepancy(inputs), row_weights)
    )
    covariance.diagonal(dim1=1, dim2=2).add_(CHOLESKY_JITTER)
    return covariance
