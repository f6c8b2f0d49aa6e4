"""Learning from few rows: Sim-FSVGD and its baselines on the cases of the paper, with likelihood, error, calibration.

Two ways of fitting: ``ours`` (what data, simulator and a gap of learned covariance say together, and particles led
there by Stein's direction; FSVGD and GreyBox alike, without simulator), and ``authors`` (the plain direction with the
steps, batches, points, bandwidth and starting noise of the authors' public code; prior moments from a bank of draws,
and the Gaussian process of FSVGD with its full weight).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from carlab.core.clock import MonotonicClock
from carlab.core.errors import ConfigError, DataError
from carlab.experiment.regression_cases import CASES, Case, Data
from learning.devices import described
from learning.domain_models import DomainModel, draw_parameters
from learning.ensemble import deep_ensemble
from learning.evaluation import Mixture, calibration_error, negative_log_likelihood, root_mean_square_error
from learning.fsvgd import FsvgdSettings, GaussianProcessPrior, Posterior, SimulatorPrior, fit
from learning.function_posterior import infer
from learning.function_prior import RbfCovariance
from learning.normaliser import Normaliser
from learning.residuals import residuals
from learning.ridge import Ridge
from learning.sim_fsvgd import ParticleSettings, fit_particles, measurement_points
from learning.system_identification import GreyBox, Identified, grey_box, identify
from learning.world_outputs import measured_seven_outputs, seven_outputs

Way = Literal["ours", "authors"]
Progress = Callable[[str, int, int], None]
EXPECTED_FUNCTION = 1.0
"""Size of a function of which nothing is known, in units of the outputs."""
LEAST_GAP = 0.03
HIDDEN, STEPS = (64, 64), 12_000
"""Of particles: on 200 rows of train_1 of the ETH car they are as good as their target after 4000 steps, on 100 of race
cars in simulation 0.1 nats worse after 12 000 and 0.7 after 4000."""
POOL = 1024
DRAWS = 2048
LEAST_RIDGE = 3
NOISE_ROWS = 2.0
_LINEAR_ALGEBRA = ("linalg", "lapack", "cusolver", "magma")
"""Named in the RuntimeErrors of torch's linear algebra and of the libraries below it."""


class Model(Protocol):
    """What every method gives."""

    def predict(self, inputs: Tensor) -> Mixture:
        """Prediction at inputs (N, D)."""
        ...


@dataclass(frozen=True, slots=True)
class Score:
    """One method, fitted once.

    Attributes:
        case, method, rows, seed: what was fitted.
        nll: mean joint negative log density of all outputs [nat].
        rmse: root of the squared error summed over outputs, in mixed units.
        calibration: mean absolute difference of coverage.
        seconds: that the fit took.
        nll_in_world: of the seven outputs that the authors score, for a real car.
        failed: why there is no model; its figures are NaN then.
    """

    case: str
    method: str
    rows: int
    seed: int
    nll: float
    rmse: float
    calibration: float
    seconds: float
    nll_in_world: float | None = None
    failed: str | None = None


@dataclass(frozen=True, slots=True)
class _Task:
    case: Case
    data: Data
    seed: int
    way: Way
    steps: int | None

    @property
    def normaliser(self) -> Normaliser:
        """Of the case, where the data is."""
        return self.case.normaliser.to(self.data.inputs.device)

    @property
    def noise_std(self) -> Tensor:
        """Expected noise (O,), where the data is."""
        return torch.tensor(self.case.expected_noise_std).to(self.data.inputs.device)

    def settings(self, *, own: bool = False) -> FsvgdSettings:
        """How particles are fitted the authors' way (``own``: under a simulator), and the networks of an ensemble."""
        case, rows = self.case, len(self.data.inputs)
        if self.way == "ours":
            noise = tuple(s / o for s, o in zip(case.expected_noise_std, case.output_std, strict=True))
            return FsvgdSettings(
                steps=self.steps or STEPS, noise_std=noise, learn_noise=case.learn_noise, noise_rows=NOISE_ROWS,
                seed=self.seed,
            )  # fmt: skip
        noise = tuple(s / o for s, o in zip(case.likelihood_std, case.output_std, strict=True))
        steps = self.steps or min(60 * rows // 8 + 5000, 100_000) // 1000 * 1000
        if case.name == "1d":
            return FsvgdSettings(
                steps=self.steps or (20_000 if own else 10_000), batch=4, measurement_points=8,
                bandwidth=1.0 if own else 0.5, natural=False, falling_rate=False, noise_std=noise, learn_noise=False,
                seed=self.seed,
            )  # fmt: skip
        return FsvgdSettings(
            steps=steps, batch=8, measurement_points=32, bandwidth=10.0 if case.name == "realcar" else 2.0,
            natural=False, falling_rate=False, noise_std=noise, noise_rate=1.0, seed=self.seed,
        )  # fmt: skip

    def pool(self) -> Tensor:
        """Inputs of the domain."""
        return self.case.prior.inputs(POOL, torch.Generator().manual_seed(20_000 + self.seed)).to(self.data.inputs)

    def function_prior(self) -> RbfCovariance:
        """Of FSVGD and of a grey box: one normalised unit everywhere."""
        return RbfCovariance((1.0,) * len(self.case.output_std), (self.case.function_lengthscale,))

    def inferred(
        self,
        simulator: DomainModel | None,
        outputs: Tensor,
        expected_gap: float | tuple[float, ...] | None,
        noise_std: tuple[float, ...] | None = None,
    ) -> Particles:
        """Our way: particles led to what data, simulator and gap say together."""
        case = self.case
        noise = self.noise_std if noise_std is None else torch.tensor(noise_std).to(self.noise_std)
        generator = torch.Generator().manual_seed(30_000 + self.seed)
        normaliser = self.normaliser
        gap = None if expected_gap is None else torch.tensor(expected_gap).to(noise) * normaliser.output_std
        posterior = infer(
            simulator, self.data.inputs, outputs, normaliser, noise, gap_std=gap, with_gap=gap is not None,
            noise_known=noise_std is not None or not case.learn_noise, seed=self.seed,
        )  # fmt: skip
        points = measurement_points(simulator or case.prior, self.data.inputs, normaliser, generator)
        settings = ParticleSettings(hidden=HIDDEN, steps=self.steps or STEPS, seed=self.seed)
        return Particles(fit_particles(posterior, points, settings))

    def sim_fsvgd(self, *, gap: bool) -> Model:
        """Particles under draws of the simulator."""
        case, normaliser = self.case, self.normaliser
        if self.way == "ours":
            if gap and case.process is not None:
                return self.inferred(case.process, self.data.outputs, None, case.noise_std)
            return self.inferred(case.prior, self.data.outputs, case.gap_from(len(self.data.inputs)) if gap else None)
        pool, generator = self.pool(), torch.Generator().manual_seed(30_000 + self.seed)
        everything = torch.cat([self.data.inputs, pool])
        with torch.no_grad():
            drawn = draw_parameters(case.prior, DRAWS, generator).to(everything)
            bank = normaliser.outputs(case.prior(everything, drawn))
        prior = SimulatorPrior(bank, everything, case.gap() if gap else None)
        return fit(self.data.inputs, self.data.outputs, pool, prior, normaliser, self.settings(own=True))

    def fsvgd(self) -> Model:
        """Particles under a Gaussian process, properly weighted."""
        if self.way == "ours":
            return self.inferred(None, self.data.outputs, EXPECTED_FUNCTION)
        normaliser, pool = self.normaliser, self.pool()
        prior = GaussianProcessPrior(normaliser.inputs(torch.cat([self.data.inputs, pool])), self.function_prior())
        return fit(self.data.inputs, self.data.outputs, pool, prior, normaliser, self.settings())

    def sysid(self) -> Identified:
        """The simulator with its parameters at maximum likelihood."""
        return identify(self.case.prior, self.data.inputs, self.data.outputs, self.noise_std, self.seed)

    def grey_box(self) -> Model:
        """The same and particles for what it leaves."""
        simulator = self.sysid()
        if self.way == "ours":
            expected = self.case.gap_from(len(self.data.inputs)) or LEAST_GAP
            with torch.no_grad():
                left = self.data.outputs - simulator.mean(self.data.inputs)
            return GreyBox(simulator, self.inferred(None, left, expected))
        return grey_box(
            simulator, self.data.inputs, self.data.outputs, self.pool(), self.function_prior(), self.normaliser,
            self.settings(),
        )  # fmt: skip

    def ensemble(self) -> Model:
        """Networks that differ by their start and by the rows that they leave out."""
        return deep_ensemble(self.data.inputs, self.data.outputs, self.normaliser, self.settings())

    def ridge(self) -> Model:
        """Linear regression."""
        return _Linear(Ridge.fit(*(v.cpu().double().numpy() for v in (self.data.inputs, self.data.outputs))))


@dataclass(frozen=True, slots=True)
class Particles:
    """Particles whose mixture is widened to the density that it stands for."""

    posterior: Posterior

    def predict(self, inputs: Tensor) -> Mixture:
        """Prediction at inputs (N, D)."""
        return self.posterior.predict(inputs).smoothed()


@dataclass(frozen=True, slots=True)
class _Linear:
    ridge: Ridge

    def predict(self, inputs: Tensor) -> Mixture:
        mean = torch.from_numpy(self.ridge(inputs.cpu().double().numpy()))
        return residuals(torch.from_numpy(self.ridge.errors)).about(mean[None].to(inputs.device))


METHODS: dict[str, Callable[[_Task], Model]] = {
    "Sim-FSVGD": lambda task: task.sim_fsvgd(gap=True),
    "Sim-FSVGD without gap": lambda task: task.sim_fsvgd(gap=False),
    "FSVGD": _Task.fsvgd,
    "SysID": _Task.sysid,
    "GreyBox": _Task.grey_box,
    "ensemble": _Task.ensemble,
    "ridge": _Task.ridge,
}


def run_study(
    case: str | Case,
    *,
    rows: Sequence[int] = (),
    seeds: int = 3,
    methods: Sequence[str] = (),
    way: Way = "ours",
    data: Path | None = None,
    steps: int | None = None,
    device: str = "cpu",
    progress: Progress = lambda what, done, total: None,
) -> Iterator[Score]:
    """Fit every method to every number of rows with every seed, and score it as soon as it is fitted.

    A fit that fails is a score that says why, and the others go on.

    Args:
        case: of ``CASES``, or one that was made.
        rows: numbers of rows; those of the case unless given.
        seeds: how many; data and fit have the same one.
        methods: of ``METHODS``; all unless given.
        way: how particles are fitted.
        data: folder of the authors' arrays; the data is drawn here without it.
        steps: of the optimiser; those of the way unless given.
        device: where models are fitted and judged; what is drawn is drawn on the CPU. Ridge is NumPy's everywhere.
        progress: told what is fitted, how many fits are done, and of how many.

    Raises:
        ConfigError: an unknown case or method, or too few rows for all methods.
        DataError: arrays are missing, or there are fewer rows; before the first fit.
    """
    if isinstance(case, str) and case not in CASES:
        raise ConfigError(f"There is no case '{case}'; choose {', '.join(CASES)}.")
    if unknown := [m for m in methods if m not in METHODS]:
        raise ConfigError(f"There is no method '{unknown[0]}'; choose among {', '.join(METHODS)}.")
    chosen = CASES[case] if isinstance(case, str) else case
    counts = tuple(rows) or chosen.counts
    if way == "ours" and chosen.ours is not None:
        chosen = chosen.ours
    names = tuple(methods) or tuple(METHODS)
    plan = [p for p in itertools.product(counts, range(seeds), names) if not (p[2] == "ridge" and p[0] < LEAST_RIDGE)]
    if not plan:
        raise ConfigError(f"Ridge regression needs {LEAST_RIDGE} rows or more; give --rows, or other methods.")
    # Data that is missing is told before the first fit, not after hours of them.
    drawn = {
        (count, seed): chosen.data(count, seed) if data is None else chosen.recorded(data, count, seed)
        for count, seed in itertools.product(counts, range(seeds))
    }
    for done, (count, seed, name) in enumerate(plan):
        progress(f"{name}, {count} rows, seed {seed}", done, len(plan))
        yield scored(chosen, drawn[count, seed].to(device), count, seed, name, way=way, steps=steps)
    progress("", len(plan), len(plan))


def scored(
    case: Case, data: Data, count: int, seed: int, method: str, *, way: Way = "ours", steps: int | None = None
) -> Score:
    """Fit one method of ``METHODS`` to rows of a case, and score it on the others; or say why it cannot be fitted."""
    clock = MonotonicClock()
    began_s = clock.now_s()
    try:
        model = METHODS[method](_Task(case, data, seed, way, steps))
        seconds = clock.now_s() - began_s
        prediction = model.predict(data.test_inputs)
        found = (
            negative_log_likelihood(prediction, data.test_outputs),
            root_mean_square_error(prediction, data.test_outputs),
            calibration_error(prediction, data.test_outputs),
        )
        in_world = _nll_in_world(prediction, data)
    except (DataError, RuntimeError, np.linalg.LinAlgError) as error:
        if (why := _broken_down(error)) is None:
            raise
        return _failed(case, method, count, seed, why)
    if not all(map(math.isfinite, found)):
        return _failed(case, method, count, seed, "What it predicts is not finite.")
    return Score(case.name, method, count, seed, *found, seconds, in_world)


def _failed(case: Case, method: str, count: int, seed: int, why: str) -> Score:
    return Score(case.name, method, count, seed, *(math.nan,) * 4, failed=why)


def _broken_down(error: Exception) -> str | None:
    """Why a fit failed; None for an error of the program, after which nothing else may be believed either."""
    why = next(iter(str(error).splitlines()), "") or type(error).__name__
    if isinstance(error, (DataError, np.linalg.LinAlgError)):
        return why
    return why if any(name in str(error).lower() for name in _LINEAR_ALGEBRA) else None


def _nll_in_world(prediction: Mixture, data: Data) -> float | None:
    if data.test_yaw is None:
        return None
    there = (data.test_inputs[:, :2], data.test_yaw)
    return negative_log_likelihood(seven_outputs(prediction, *there), measured_seven_outputs(data.test_outputs, *there))


@dataclass(frozen=True, slots=True)
class Row:
    """One method at one number of rows over the seeds: means of its scores, and the standard errors of those means.

    Means are of the ``seeds`` fits that did not fail, NaN where there is none; standard errors need two.
    """

    method: str
    rows: int
    seeds: int
    nll: float
    nll_standard_error: float
    rmse: float
    calibration: float
    seconds: float
    nll_in_world: float | None = None
    rmse_standard_error: float = math.nan
    calibration_standard_error: float = math.nan
    seconds_standard_error: float = math.nan
    failed: int = 0


def summarised(scores: Sequence[Score]) -> list[Row]:
    """One row for each method and number of rows, in the order in which they were fitted."""
    groups: dict[tuple[int, str], list[Score]] = {}
    for score in scores:
        groups.setdefault((score.rows, score.method), []).append(score)
    found = []
    for (count, method), tried in groups.items():
        own = [s for s in tried if s.failed is None]
        mean, error = {}, {}
        for name in FIGURES:
            values = np.array([getattr(s, name) for s in own])
            mean[name] = float(values.mean()) if own else math.nan
            error[f"{name}_standard_error"] = (
                float(values.std(ddof=1) / np.sqrt(len(own))) if len(own) > 1 else math.nan
            )
        worlds = [s.nll_in_world for s in own if s.nll_in_world is not None]
        in_world = float(np.mean(worlds)) if worlds else None
        failed = len(tried) - len(own)
        found.append(Row(method, count, len(own), nll_in_world=in_world, failed=failed, **mean, **error))
    return found


FIGURES = ("nll", "rmse", "calibration", "seconds")


def as_json(scores: Sequence[Score], command: str, device: str = "cpu") -> dict[str, object]:
    """Everything that was measured, and what made it; what is no number is null."""

    def plain(row: Row | Score) -> dict[str, object]:
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in asdict(row).items()}

    return {
        "schema": "carlab.regression/1",
        "command": command,
        "device": described(device),
        "torch_threads": torch.get_num_threads(),
        "rows": [plain(row) for row in summarised(scores)],
        "scores": [plain(score) for score in scores],
    }


__all__ = ["FIGURES", "METHODS", "Row", "Score", "Way", "as_json", "run_study", "scored", "summarised"]
