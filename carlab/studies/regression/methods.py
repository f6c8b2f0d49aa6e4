"""Methods of the regression study and their fits to the rows of a case.

Particles are fitted in one of two ways. ``ours`` distils the posterior over functions (``learning.posterior``;
Sim-FSVGD around a simulator, FSVGD and the residual of GreyBox around zero). ``authors`` is functional SVGD as
published (``learning.functional_svgd.fsvgd``) with the steps, batches, points, bandwidth and starting noise of the
authors' public code; prior moments come from a fixed set of draws, and the Gaussian process of FSVGD has its full
weight.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor

from carlab.studies.regression.cases import Case, Data
from learning.baselines.ensemble import deep_ensemble
from learning.baselines.ridge import Ridge
from learning.baselines.system_identification import GreyBox, IdentifiedSimulator, grey_box, identify
from learning.evaluation import Mixture
from learning.functional_svgd.fsvgd import FsvgdSettings, GaussianProcessPrior, SimulatorPrior, fit_fsvgd
from learning.networks.normaliser import Normaliser
from learning.posterior.distillation import DistillationSettings, distil, measurement_points
from learning.posterior.inference import infer
from learning.posterior.particle_posterior import ParticlePosterior
from learning.posterior.residuals import fit_residuals
from learning.priors.domain_models import DomainModel, draw_parameters
from learning.priors.function_prior import RbfCovariance

Way = Literal["ours", "authors"]
PRIOR_FUNCTION = 1.0
"""Prior size of a function without a simulator, in units of the outputs."""
MIN_DISCREPANCY = 0.03
"""Prior size of GreyBox's residual for a case without discrepancy, in units of the outputs."""
HIDDEN, STEPS = (64, 64), 12_000
"""Hidden layers and optimiser steps of particles (docs/decisions/0014)."""
POOL_POINTS = 1024
PRIOR_DRAWS = 2048
NOISE_ROWS = 2.0


class Model(Protocol):
    """A fitted method."""

    def predict(self, inputs: Tensor) -> Mixture:
        """Prediction at inputs (N, D)."""
        ...


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
    """One fit: a case, its rows, a seed, the way and the number of optimiser steps (None: the way's default)."""

    case: Case
    data: Data
    seed: int
    way: Way
    steps: int | None

    @property
    def normaliser(self) -> Normaliser:
        """Of the case, on the data's device."""
        return self.case.normaliser.to(self.data.inputs.device)

    @property
    def noise_std(self) -> Tensor:
        """Prior noise (O,), on the data's device."""
        return torch.tensor(self.case.prior_noise_std).to(self.data.inputs.device)

    def fsvgd_settings(self, *, with_simulator: bool = False) -> FsvgdSettings:
        """Settings of functional SVGD and of the ensemble's networks."""
        case, rows = self.case, len(self.data.inputs)
        if self.way == "ours":
            noise = tuple(s / o for s, o in zip(case.prior_noise_std, case.output_std, strict=True))
            return FsvgdSettings(
                steps=self.steps or STEPS, noise_std=noise, fit_noise=case.fit_noise, noise_rows=NOISE_ROWS,
                seed=self.seed,
            )  # fmt: skip
        noise = tuple(s / o for s, o in zip(case.likelihood_std, case.output_std, strict=True))
        steps = self.steps or min(60 * rows // 8 + 5000, 100_000) // 1000 * 1000
        if case.name == "1d":
            return FsvgdSettings(
                steps=self.steps or (20_000 if with_simulator else 10_000), batch=4, measurement_points=8,
                bandwidth=1.0 if with_simulator else 0.5, natural=False, anneal_rate=False, noise_std=noise,
                fit_noise=False, seed=self.seed,
            )  # fmt: skip
        return FsvgdSettings(
            steps=steps, batch=8, measurement_points=32, bandwidth=10.0 if case.name == "realcar" else 2.0,
            natural=False, anneal_rate=False, noise_std=noise, noise_rate=1.0, seed=self.seed,
        )  # fmt: skip

    def pool(self) -> Tensor:
        """Inputs of the domain (M, D)."""
        generator = torch.Generator().manual_seed(20_000 + self.seed)
        return self.case.prior.inputs(POOL_POINTS, generator).to(self.data.inputs)

    def function_prior(self) -> RbfCovariance:
        """Gaussian-process prior of FSVGD and of GreyBox: one normalised unit everywhere."""
        return RbfCovariance((1.0,) * len(self.case.output_std), (self.case.function_lengthscale,))

    def distilled(
        self,
        simulator: DomainModel | None,
        outputs: Tensor,
        prior_discrepancy: float | tuple[float, ...] | None,
        noise_std: tuple[float, ...] | None = None,
    ) -> SmoothedParticles:
        """Particles distilled from the posterior over functions.

        Args:
            simulator: the simulator; None: a zero mean.
            outputs: raw (n, O).
            prior_discrepancy: prior size of the discrepancy in units of the outputs; None: no discrepancy.
            noise_std: known noise (O,), raw; by default the case's prior noise.
        """
        case = self.case
        noise = self.noise_std if noise_std is None else torch.tensor(noise_std).to(self.noise_std)
        generator = torch.Generator().manual_seed(30_000 + self.seed)
        normaliser = self.normaliser
        discrepancy_std = None
        if prior_discrepancy is not None:
            discrepancy_std = torch.tensor(prior_discrepancy).to(noise) * normaliser.output_std
        posterior = infer(
            simulator, self.data.inputs, outputs, normaliser, noise, discrepancy_std=discrepancy_std,
            with_discrepancy=discrepancy_std is not None, noise_known=noise_std is not None or not case.fit_noise,
            seed=self.seed,
        )  # fmt: skip
        points = measurement_points(simulator or case.prior, self.data.inputs, normaliser, generator)
        settings = DistillationSettings(hidden=HIDDEN, steps=self.steps or STEPS, seed=self.seed)
        return SmoothedParticles(distil(posterior, points, settings))

    def sim_fsvgd(self, *, discrepancy: bool) -> Model:
        """Sim-FSVGD: particles with a simulator prior."""
        case, normaliser = self.case, self.normaliser
        if self.way == "ours":
            if discrepancy and case.prior_with_discrepancy is not None:
                return self.distilled(case.prior_with_discrepancy, self.data.outputs, None, case.noise_std)
            size = case.prior_discrepancy_for(len(self.data.inputs)) if discrepancy else None
            return self.distilled(case.prior, self.data.outputs, size)
        pool, generator = self.pool(), torch.Generator().manual_seed(30_000 + self.seed)
        prior_inputs = torch.cat([self.data.inputs, pool])
        with torch.no_grad():
            parameters = draw_parameters(case.prior, PRIOR_DRAWS, generator).to(prior_inputs)
            draws = normaliser.outputs(case.prior(prior_inputs, parameters))
        prior = SimulatorPrior(draws, prior_inputs, case.discrepancy() if discrepancy else None)
        settings = self.fsvgd_settings(with_simulator=True)
        return fit_fsvgd(self.data.inputs, self.data.outputs, pool, prior, normaliser, settings)

    def fsvgd(self) -> Model:
        """FSVGD: particles with a Gaussian-process prior."""
        if self.way == "ours":
            return self.distilled(None, self.data.outputs, PRIOR_FUNCTION)
        normaliser, pool = self.normaliser, self.pool()
        prior = GaussianProcessPrior(normaliser.inputs(torch.cat([self.data.inputs, pool])), self.function_prior())
        return fit_fsvgd(self.data.inputs, self.data.outputs, pool, prior, normaliser, self.fsvgd_settings())

    def sysid(self) -> IdentifiedSimulator:
        """SysID: the simulator at its maximum-likelihood parameters."""
        return identify(self.case.prior, self.data.inputs, self.data.outputs, self.noise_std, self.seed)

    def grey_box(self) -> Model:
        """GreyBox: SysID, and particles for its residual."""
        simulator = self.sysid()
        if self.way == "ours":
            size = self.case.prior_discrepancy_for(len(self.data.inputs)) or MIN_DISCREPANCY
            with torch.no_grad():
                residual = self.data.outputs - simulator.mean(self.data.inputs)
            return GreyBox(simulator, self.distilled(None, residual, size))
        return grey_box(
            simulator, self.data.inputs, self.data.outputs, self.pool(), self.function_prior(), self.normaliser,
            self.fsvgd_settings(),
        )  # fmt: skip

    def ensemble(self) -> Model:
        """Deep ensemble."""
        return deep_ensemble(self.data.inputs, self.data.outputs, self.normaliser, self.fsvgd_settings())

    def ridge(self) -> Model:
        """Ridge regression."""
        return _Linear(Ridge.fit(*(v.cpu().double().numpy() for v in (self.data.inputs, self.data.outputs))))


METHODS: dict[str, Callable[[FitTask], Model]] = {
    "Sim-FSVGD": lambda task: task.sim_fsvgd(discrepancy=True),
    "Sim-FSVGD without gap": lambda task: task.sim_fsvgd(discrepancy=False),
    "FSVGD": FitTask.fsvgd,
    "SysID": FitTask.sysid,
    "GreyBox": FitTask.grey_box,
    "ensemble": FitTask.ensemble,
    "ridge": FitTask.ridge,
}
"""Methods by their name in tables and on the command line; "without gap" means without model discrepancy."""

__all__ = ["METHODS", "STEPS", "FitTask", "Model", "SmoothedParticles", "Way"]
