"""What a better simulator is worth to learning: held-out likelihood against the number of rows, by prior.

The same rows, seeds, gap, particles and measurement points for four priors: none (a Gaussian process, FSVGD), the
car's file with wheels that do not slip, the car's file, and the diagnosed one with its effects. Every physical prior is
also told what the rows themselves say of how late their velocities are, and at what time effects that drift are met.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from carlab.core.errors import DataError
from carlab.experiment.campaign import check_period, prior_simulator
from carlab.experiment.regression_recordings import DELAY_S, RecordedCase, check_periods
from carlab.experiment.regression_study import Progress, Score, scored
from learning.domain_models import DomainModel
from learning.simulator_model import DELAY, CarModel, known_ranges
from learning.transitions import velocity_delay_s
from sim_backends.car_parameters import SimulatorConfig

NONE, KINEMATIC, NOMINAL, DIAGNOSED = "none (FSVGD)", "kinematic", "nominal", "diagnosed"


@dataclass(frozen=True, slots=True)
class InDomain:
    """A simulator whose domain is another's, so that all priors are compared at the same inputs."""

    model: DomainModel
    domain: DomainModel

    @property
    def size(self) -> int:
        """Of the simulator."""
        return self.model.size

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        """Of the domain."""
        return self.domain.inputs(count, generator)

    def parameters(self, normal: Tensor) -> Tensor:
        """Of the simulator."""
        return self.model.parameters(normal)

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        """The simulator's."""
        return self.model(inputs, parameters)


def prior_models(case: RecordedCase, car: SimulatorConfig, diagnosed: SimulatorConfig) -> dict[str, DomainModel | None]:
    """The four priors by name; None is no simulator.

    Args:
        case: recordings, with the history that was found.
        car: simulator of the car's file.
        diagnosed: what was diagnosed from the recordings that are not held out, with its doubts.

    Raises:
        ConfigError: the diagnosed car has another control period than the rows.
    """
    assert case.rows is not None
    period_s = car.control_period_s
    check_period(diagnosed, period_s, "the car's file")
    late_s = velocity_delay_s(case.rows, period_s)
    at_s = float(case.rows.tick.mean()) * period_s
    history = case.rows.history

    def model(simulator: SimulatorConfig, ranges: Mapping[str, tuple[float, float]]) -> CarModel:
        return CarModel(simulator, history, ranges, at_s=at_s, velocity_delay_s=late_s)

    own = prior_simulator(car, "nominal")
    found: dict[str, DomainModel | None] = {NONE: None}
    nominal = model(own, {DELAY: DELAY_S, **known_ranges(own)})
    rolling = prior_simulator(car, "kinematic")
    found[KINEMATIC] = InDomain(model(rolling, {DELAY: DELAY_S, **rolling.priors}), nominal)
    found[NOMINAL] = nominal
    better = prior_simulator(diagnosed, "nominal")
    half = 0.5 * period_s
    about = max(better.command_delay_s - half, 0.0), better.command_delay_s + half
    found[DIAGNOSED] = InDomain(model(better, {DELAY: about, **known_ranges(better)}), nominal)
    return found


def run_prior_study(
    case: RecordedCase,
    priors: Mapping[str, DomainModel | None],
    *,
    rows: Sequence[int] = (),
    seeds: int = 3,
    steps: int | None = None,
    device: str = "cpu",
    progress: Progress = lambda what, done, total: None,
) -> Iterator[Score]:
    """Fit under every prior to every number of rows with every seed; scores as they come, with the prior as method.

    A fit that fails is a score that says why, and the others go on.

    Args:
        case: the recordings.
        priors: by name, as of ``prior_models``.
        rows: numbers of rows; those of the case unless given.
        seeds: how many; rows and fit have the same one.
        steps: of the particles' optimiser; the method's unless given.
        device: where models are fitted and judged.
        progress: told what is fitted, how many fits are done, and of how many.

    Raises:
        DataError: the recordings have too few rows.
    """
    assert case.rows is not None
    counts = tuple(rows) or case.counts
    if max(counts) > len(case.rows):
        raise DataError(f"The recordings have {len(case.rows)} rows, not {max(counts)}; ask for fewer with --rows.")
    domain = priors.get(NOMINAL) or case.prior
    plan = list(itertools.product(counts, range(seeds), priors))
    for done, (count, seed, name) in enumerate(plan):
        progress(f"{name}, {count} rows, seed {seed}", done, len(plan))
        data = case.recorded(Path(), count, seed).to(device)
        prior = priors[name]
        own = replace(case, prior=domain if prior is None else prior)
        score = scored(own, data, count, seed, "FSVGD" if prior is None else "Sim-FSVGD", steps=steps)
        yield replace(score, method=name)
    progress("", len(plan), len(plan))


__all__ = ["DIAGNOSED", "KINEMATIC", "NOMINAL", "NONE", "InDomain", "check_periods", "prior_models", "run_prior_study"]
