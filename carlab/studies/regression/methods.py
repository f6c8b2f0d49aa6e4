"""Methods of the regression study and their fits to the rows of a case.

carlab's methods (``gp-...``) condition a Gaussian process (``learning.posterior``) around a simulator, around zero, or
average several by held-out density. ``sim-fsvgd`` and ``fsvgd`` are the paper's (``functional_svgd.fsvgd``) with
the steps, batches, points, bandwidth and starting noise of the authors' public code; prior moments come from a fixed
set of draws. Their ``-corrected`` forms correct two errors of that code: the repulsive term divided by the number of
particles, and the almost absent Gaussian-process prior of FSVGD. ``VARIANTS`` of ``sim-fsvgd`` have another estimator
of the prior's score, or no discrepancy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from carlab.studies.regression.cases import Case, Data
from learning.baselines.ensemble import deep_ensemble
from learning.baselines.ridge import Ridge
from learning.baselines.system_identification import GreyBox, IdentifiedSimulator, identify
from learning.evaluation import Mixture, Predictor
from learning.functional_svgd.estimated_prior import EstimatedPrior
from learning.functional_svgd.fsvgd import FsvgdSettings, GaussianProcessPrior, SimulatorPrior, fit_fsvgd
from learning.functional_svgd.score_estimators import NuMethod, ScoreEstimator, SpectralStein, kernel_density
from learning.networks.normaliser import Normaliser
from learning.posterior.averaging import average
from learning.posterior.distillation import DistillationSettings, distil, measurement_points
from learning.posterior.function_posterior import FunctionPosterior
from learning.posterior.inference import infer
from learning.posterior.particle_posterior import ParticlePosterior
from learning.posterior.residuals import fit_residuals
from learning.priors.domain_models import DomainModel, draw_parameters
from learning.priors.function_prior import RbfCovariance
from learning.world.car_fit import PRIOR_FUNCTION

MIN_DISCREPANCY = 0.03
"""Prior size of GreyBox's residual for a case without discrepancy, in units of the outputs."""
HIDDEN, STEPS = (64, 64), 12_000
"""Hidden layers and optimiser steps of particles (docs/decisions/0014)."""
POOL_POINTS = 1024
PRIOR_DRAWS = 2048
NOISE_ROWS = 2.0
Size = float | tuple[float, ...] | None
"""Prior size of a discrepancy in units of the outputs; None: no discrepancy."""


@dataclass(frozen=True, slots=True)
class SmoothedParticles:
    """Particles whose mixture is kernel-smoothed."""

    posterior: ParticlePosterior

    def predict(self, inputs: Tensor) -> Mixture:
        """Prediction at inputs (N, D)."""
        return self.posterior.predict(inputs).smoothed()


@dataclass(frozen=True, slots=True)
class _Linear:
    ridge: Ridge

    def predict(self, inputs: Tensor) -> Mixture:
        mean = torch.from_numpy(self.ridge(inputs.cpu().double().numpy()))
        return fit_residuals(torch.from_numpy(self.ridge.errors)).centred_at(mean[None].to(inputs.device))


@dataclass(frozen=True, slots=True)
class FitTask:
    """One fit: a case, its rows, a seed, and the number of optimiser steps (None: the method's default)."""

    case: Case
    data: Data
    seed: int
    steps: int | None

    @property
    def normaliser(self) -> Normaliser:
        """Of the case, on the data's device."""
        return self.case.normaliser.to(self.data.inputs.device)

    @property
    def noise_std(self) -> Tensor:
        """Prior noise (O,), on the data's device."""
        return torch.tensor(self.case.prior_noise_std).to(self.data.inputs.device)

    def authors_settings(self, *, with_simulator: bool, corrected: bool) -> FsvgdSettings:
        """The authors' settings of functional SVGD."""
        case, rows = self.case, len(self.data.inputs)
        noise = tuple(s / o for s, o in zip(case.likelihood_std, case.output_std, strict=True))
        steps = self.steps or min(60 * rows // 8 + 5000, 100_000) // 1000 * 1000
        if case.name == "1d":
            settings = FsvgdSettings(
                steps=self.steps or (20_000 if with_simulator else 10_000), batch=4, measurement_points=8,
                bandwidth=1.0 if with_simulator else 0.5, natural=False, anneal_rate=False, noise_std=noise,
                fit_noise=False, seed=self.seed,
            )  # fmt: skip
        else:
            settings = FsvgdSettings(
                steps=steps, batch=8, measurement_points=32, bandwidth=10.0 if case.name == "realcar" else 2.0,
                natural=False, anneal_rate=False, noise_std=noise, noise_rate=1.0, seed=self.seed,
            )  # fmt: skip
        return settings if corrected else settings.with_published_errors(rows, with_simulator=with_simulator)

    def pool(self) -> Tensor:
        """Inputs of the domain (M, D)."""
        generator = torch.Generator().manual_seed(20_000 + self.seed)
        return self.case.prior.inputs(POOL_POINTS, generator).to(self.data.inputs)

    def posterior(
        self, simulator: DomainModel | None, inputs: Tensor, outputs: Tensor, size: Size
    ) -> FunctionPosterior:
        """Posterior over functions.

        Args:
            simulator: the simulator; None: a zero mean.
            inputs: raw (n, D).
            outputs: raw (n, O).
            size: of the discrepancy.
        """
        normaliser, noise = self.normaliser, self.noise_std
        discrepancy_std = None if size is None else torch.tensor(size).to(noise) * normaliser.output_std
        return infer(
            simulator, inputs, outputs, normaliser, noise, discrepancy_std=discrepancy_std,
            with_discrepancy=size is not None, noise_known=not self.case.fit_noise, seed=self.seed,
        )  # fmt: skip

    def distilled(
        self, simulator: DomainModel | None, outputs: Tensor, size: Size, *, correct_simulator: bool = False
    ) -> SmoothedParticles:
        """Particles distilled from the posterior over functions at the rows, with outputs (n, O); as ``posterior``.

        With ``correct_simulator`` they are networks that correct the simulator.

        Raises:
            DataError: numbers are missing or infinite, or the simulator gives no finite outputs.
            DivergedError: the particles diverged.
        """
        generator = torch.Generator().manual_seed(30_000 + self.seed)
        posterior = self.posterior(simulator, self.data.inputs, outputs, size)
        settings = DistillationSettings(
            hidden=HIDDEN, steps=self.steps or STEPS, seed=self.seed, correct_simulator=correct_simulator
        )
        points = measurement_points(
            simulator or self.case.prior, self.data.inputs, self.normaliser, generator, settings.domain_points
        )
        return SmoothedParticles(distil(posterior, points, settings))

    @property
    def discrepancy_size(self) -> Size:
        """Prior size of the simulator's discrepancy."""
        return self.case.prior_discrepancy_for(len(self.data.inputs))

    def average(self) -> Predictor:
        """The simulators with and without discrepancy, and no simulator, averaged by held-out density."""
        case = self.case
        candidates: list[tuple[DomainModel | None, Size]] = [(case.prior, None), (None, PRIOR_FUNCTION)]
        if self.discrepancy_size is not None:
            simulators = [case.prior] if case.plain_prior is None else [case.prior, case.plain_prior]
            candidates += [(simulator, self.discrepancy_size) for simulator in simulators]

        def fit(simulator: DomainModel | None, size: Size) -> Callable[[Tensor, Tensor], FunctionPosterior]:
            return lambda inputs, outputs: self.posterior(simulator, inputs, outputs, size)

        return average([fit(*candidate) for candidate in candidates], self.data.inputs, self.data.outputs, self.seed)

    def sim_fsvgd(
        self, *, corrected: bool = False, estimator: ScoreEstimator | None = None, with_discrepancy: bool = True
    ) -> Predictor:
        """The paper's Sim-FSVGD.

        Args:
            corrected: without the errors of the authors' code.
            estimator: of the prior's score; None: the paper's Gaussian fit.
            with_discrepancy: whether the simulator has the authors' discrepancy process.
        """
        case, normaliser = self.case, self.normaliser
        pool, generator = self.pool(), torch.Generator().manual_seed(30_000 + self.seed)
        prior_inputs = torch.cat([self.data.inputs, pool])
        with torch.no_grad():
            parameters = draw_parameters(case.prior, PRIOR_DRAWS, generator).to(prior_inputs)
            draws = normaliser.outputs(case.prior(prior_inputs, parameters))
        gaussian = SimulatorPrior(draws, prior_inputs, case.discrepancy() if with_discrepancy else None)
        prior = gaussian if estimator is None else EstimatedPrior(gaussian, estimator, self.seed)
        settings = self.authors_settings(with_simulator=True, corrected=corrected)
        return fit_fsvgd(self.data.inputs, self.data.outputs, pool, prior, normaliser, settings)

    def fsvgd(self, *, corrected: bool) -> Predictor:
        """The paper's FSVGD: a Gaussian-process prior of one normalised unit."""
        case, normaliser, pool = self.case, self.normaliser, self.pool()
        covariance = RbfCovariance((1.0,) * len(case.output_std), (case.function_lengthscale,))
        prior = GaussianProcessPrior(normaliser.inputs(torch.cat([self.data.inputs, pool])), covariance)
        settings = self.authors_settings(with_simulator=False, corrected=corrected)
        return fit_fsvgd(self.data.inputs, self.data.outputs, pool, prior, normaliser, settings)

    def sysid(self) -> IdentifiedSimulator:
        """SysID: the simulator at its maximum-likelihood parameters."""
        return identify(self.case.prior, self.data.inputs, self.data.outputs, self.noise_std, self.seed)

    def grey_box(self) -> Predictor:
        """GreyBox: SysID, and particles for its residual."""
        simulator = self.sysid()
        with torch.no_grad():
            residual = self.data.outputs - simulator.mean(self.data.inputs)
        particles = self.distilled(None, residual, self.discrepancy_size or MIN_DISCREPANCY)
        return GreyBox(simulator, particles.predict)

    def ensemble(self) -> Predictor:
        """Deep ensemble."""
        case = self.case
        noise = tuple(s / o for s, o in zip(case.prior_noise_std, case.output_std, strict=True))
        settings = FsvgdSettings(
            steps=self.steps or STEPS, noise_std=noise, fit_noise=case.fit_noise, noise_rows=NOISE_ROWS, seed=self.seed
        )
        return deep_ensemble(self.data.inputs, self.data.outputs, self.normaliser, settings)

    def ridge(self) -> Predictor:
        """Ridge regression."""
        return _Linear(Ridge.fit(*(v.cpu().double().numpy() for v in (self.data.inputs, self.data.outputs))))


METHODS: dict[str, Callable[[FitTask], Predictor]] = {
    "gp-sim-average": FitTask.average,
    "gp-sim-posterior": lambda task: task.distilled(task.case.prior, task.data.outputs, task.discrepancy_size),
    "sim-posterior": lambda task: task.distilled(task.case.prior, task.data.outputs, None),
    "gp-posterior": lambda task: task.distilled(None, task.data.outputs, PRIOR_FUNCTION),
    "sim-fsvgd": lambda task: task.sim_fsvgd(corrected=False),
    "sim-fsvgd-corrected": lambda task: task.sim_fsvgd(corrected=True),
    "fsvgd": lambda task: task.fsvgd(corrected=False),
    "fsvgd-corrected": lambda task: task.fsvgd(corrected=True),
    "SysID": FitTask.sysid,
    "GreyBox": FitTask.grey_box,
    "ensemble": FitTask.ensemble,
    "ridge": FitTask.ridge,
}
"""Methods by their name in tables and on the command line; ``sim-posterior`` has no model discrepancy."""
VARIANTS: dict[str, Callable[[FitTask], Predictor]] = {
    "sim-fsvgd-kde": lambda task: task.sim_fsvgd(estimator=kernel_density),
    "sim-fsvgd-ssge": lambda task: task.sim_fsvgd(estimator=SpectralStein(from_normal=True)),
    "sim-fsvgd-nu": lambda task: task.sim_fsvgd(estimator=NuMethod(from_normal=True)),
    "sim-fsvgd-no-discrepancy": lambda task: task.sim_fsvgd(with_discrepancy=False),
}
"""``sim-fsvgd`` with another estimator of the prior's score, or without a discrepancy; a study must name them."""
PAPER_METHODS = ("sim-fsvgd", "sim-fsvgd-corrected", "fsvgd", "fsvgd-corrected", *VARIANTS)
"""The paper's algorithms; their inputs are in the world frame."""
