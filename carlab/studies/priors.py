"""Value of a better simulator as a prior: held-out likelihood against the number of rows, by prior.

Four priors with the same rows, seeds, discrepancy, particles and measurement points: none (a zero mean), kinematic (the
car file without tyre slip), nominal (the car file), and the diagnosed simulator with its effects. All simulators have
the same velocity delay, estimated from the rows, and the same time for the evaluation of time-dependent effects.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from carlab.core.errors import DataError
from carlab.experiment.campaign.campaign import check_period, prior_simulator
from carlab.studies.regression.recordings import DELAY_S, RecordedCase
from carlab.studies.regression.scores import Score
from carlab.studies.regression.study import Progress, scored
from learning.priors.domain_models import DomainModel
from learning.priors.simulator_model import DELAY, CarModel, known_ranges
from learning.transitions import velocity_delay_s
from sim_backends.car_parameters import SimulatorConfig

NONE, KINEMATIC, NOMINAL, DIAGNOSED = "none (gp-posterior)", "kinematic", "nominal", "diagnosed"


@dataclass(frozen=True, slots=True)
class InDomain:
    """A simulator with the domain of another, so that all priors are compared at the same inputs."""

    model: DomainModel
    domain: DomainModel

    @property
    def size(self) -> int:
        """Number of parameters of the simulator."""
        return self.model.size

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        """Inputs of the domain (N, D)."""
        return self.domain.inputs(count, generator)

    def parameters(self, normal: Tensor) -> Tensor:
        """Parameters of the simulator (P, K) for standard normal draws (P, K)."""
        return self.model.parameters(normal)

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        """Outputs of the simulator (P, N, O) at inputs (N, D) for parameters (P, K)."""
        return self.model(inputs, parameters)


def prior_models(case: RecordedCase, car: SimulatorConfig, diagnosed: SimulatorConfig) -> dict[str, DomainModel | None]:
    """The four priors by name; None is a prior without simulator.

    Args:
        case: recordings, with their history.
        car: simulator of the car file.
        diagnosed: simulator diagnosed from all recordings but the held-out one, with its standard deviations.

    Raises:
        ConfigError: the diagnosed car has another control period than the rows.
    """
    period_s = car.control_period_s
    check_period(diagnosed, period_s, "the car's file")
    velocity_delay = velocity_delay_s(case.rows, period_s)
    at_s = float(case.rows.tick.mean()) * period_s
    history = case.rows.history

    def model(simulator: SimulatorConfig, ranges: Mapping[str, tuple[float, float]]) -> CarModel:
        return CarModel(simulator, history, ranges, at_s=at_s, velocity_delay_s=velocity_delay)

    nominal_car = prior_simulator(car, "nominal")
    priors: dict[str, DomainModel | None] = {NONE: None}
    nominal = model(nominal_car, {DELAY: DELAY_S, **known_ranges(nominal_car)})
    kinematic_car = prior_simulator(car, "kinematic")
    priors[KINEMATIC] = InDomain(model(kinematic_car, {DELAY: DELAY_S, **kinematic_car.priors}), nominal)
    priors[NOMINAL] = nominal
    diagnosed_car = prior_simulator(diagnosed, "nominal")
    half_s, delay_s = 0.5 * period_s, diagnosed_car.command_delay_s
    delay_range_s = max(delay_s - half_s, 0.0), delay_s + half_s
    ranges = {DELAY: delay_range_s, **known_ranges(diagnosed_car)}
    priors[DIAGNOSED] = InDomain(model(diagnosed_car, ranges), nominal)
    return priors


def checked_counts(case: RecordedCase, rows: Sequence[int]) -> tuple[int, ...]:
    """Numbers of rows, by default those of the case. Raises DataError if the recordings have fewer rows."""
    counts = tuple(rows) or case.counts
    if max(counts) > len(case.rows):
        raise DataError(f"The recordings have {len(case.rows)} rows, not {max(counts)}; give fewer with --rows.")
    return counts


def run_prior_study(
    case: RecordedCase,
    priors: Mapping[str, DomainModel | None],
    *,
    rows: Sequence[int] = (),
    seeds: int = 3,
    first_seed: int = 0,
    steps: int | None = None,
    device: str = "cpu",
    progress: Progress = lambda what, done, total: None,
) -> Iterator[Score]:
    """Fit with every prior, number of rows and seed; yield each score with the prior's name as its method.

    The score of a failed fit has the reason; the study continues.

    Args:
        case: the recordings.
        priors: by name, from ``prior_models``.
        rows: numbers of rows; by default those of the case.
        seeds: number of seeds; rows and fit have the same seed.
        first_seed: the smallest seed.
        steps: of the particles' optimiser; by default those of the method.
        device: of fits and predictions.
        progress: called before each fit and at the end.

    Raises:
        DataError: the recordings have too few rows.
    """
    counts = checked_counts(case, rows)
    domain = priors.get(NOMINAL) or case.prior
    plan = list(itertools.product(counts, range(first_seed, first_seed + seeds), priors))
    for done, (count, seed, name) in enumerate(plan):
        progress(f"{name}, {count} rows, seed {seed}", done, len(plan))
        data = case.recorded(Path(), count, seed).to(device)
        prior = priors[name]
        prior_case = replace(case, prior=domain if prior is None else prior)
        score = scored(
            prior_case, data, count, seed, "gp-posterior" if prior is None else "gp-sim-posterior", steps=steps
        )
        yield replace(score, method=name)
    progress("", len(plan), len(plan))
