"""Arguments of ``learn``, and the training plan that follows from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from carlab.api.cars import car_name, car_options_text
from carlab.api.tasks import check_trainable, given_task, load_checked
from carlab.core.errors import ConfigError
from carlab.core.method_names import current_method
from carlab.core.task import Task
from carlab.experiment.cluster.settings import LinkSettings

if TYPE_CHECKING:
    from carlab.cars import CarChoice, CarFile
    from carlab.experiment.campaign.training_plan import TrainingPlan
    from sim_backends.car_parameters import SimulatorConfig

AUTO = "auto"
RAY_WAIT_S = LinkSettings().wait_s
BUILT_IN_PRIORS = ("kinematic", "nominal", AUTO)
Method = Literal["gp-sim-posterior", "gp-posterior", "sim-fsvgd", "sim-fsvgd-corrected", "fsvgd"]
Device = Literal["cpu", "cuda"]
Particles = Literal["network", "simulator"]


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnRequest:
    """The arguments of ``learn``, with the defaults of a new run.

    Attributes:
        given: names of the arguments that the caller gives.
    """

    car: str | Path | CarFile
    live: bool
    dry_run: bool
    ray: str
    ray_wait: float
    episodes: int | None = None
    device: Device | None = None
    resume: Path | None = None
    viewer: str | None = None
    vehicle: str | Path | CarFile | None = None
    reality: str | Path | CarFile | None = None
    task: str | Task | None = None
    track: Path | str | None = None
    ticks: int | None = None
    prior: str | Path | CarFile = "nominal"
    method: Method = "gp-sim-posterior"
    particles: Particles = "network"
    history: int | None = None
    model_steps: int | None = None
    updates: int = 30000
    seed: int = 0
    place: bool = True
    rerun: bool = True
    out: Path | str = "runs"
    name: str = "learn"
    given: frozenset[str]

    @property
    def car_options(self) -> str:
        """Command-line options that select the car."""
        return car_options_text(self.car, self.vehicle, self.reality, self.dry_run)


def learn_request(given: dict[str, Any]) -> LearnRequest:
    """The request with the arguments that the caller gives."""
    kinds: dict[str, Callable[[Any], Any]] = {"resume": Path, "method": current_method}
    converted = {name: kind(given[name]) for name, kind in kinds.items() if name in given}
    return LearnRequest(**given | converted, given=frozenset(given))


def training_plan(request: LearnRequest, choice: CarChoice) -> TrainingPlan:
    """The settings of a new run. Raises ConfigError if an argument does not fit the car or the task."""
    import tomli_w

    from carlab.core.task_choice import PARKING
    from carlab.experiment.campaign.campaign import PAPER_HISTORY
    from carlab.experiment.campaign.prior_correction import needed_history
    from carlab.experiment.campaign.training_plan import TrainingPlan
    from learning.world.car_fit import PAPER_METHODS

    history = request.history
    if history is None:
        history = PAPER_HISTORY if request.method in PAPER_METHODS else needed_history(choice.simulator)
    task_choice = given_task(request.task, request.track, choice.track) or PARKING
    task = load_checked(task_choice, choice.envelope.arena_m).at_period(choice.control_period_s)
    check_trainable(task_choice)
    _check_extent(task)
    if (ticks := request.ticks or task.max_ticks) <= history:
        raise ConfigError(f"--ticks {ticks}: give more than --history ({history}), for at least one transition.")
    task.resized(history, request.ticks)
    text = tomli_w.dumps(_prior(request, choice).to_tables())
    return TrainingPlan(
        text, history, request.method, request.model_steps, request.updates, request.ticks, request.seed,
        device=request.device or "cpu", task_choice=task_choice, particles=request.particles,
    )  # fmt: skip


def _check_extent(task: Task) -> None:
    """Raise ConfigError if start, goal or path lie beyond the positions that a policy observes."""
    from learning.world.model_env import FEATURE_UNITS, MAX_POLICY_INPUT

    limit_m = MAX_POLICY_INPUT * FEATURE_UNITS[0]
    start = task.sample_start(np.random.default_rng(0))
    points = [(start.x_m, start.y_m), *task.path_m, *([task.goal[:2]] if task.goal else [])]
    if (farthest_m := max(abs(value) for point in points for value in point)) > limit_m:
        raise ConfigError(
            f"The task {task.name} has a coordinate of {farthest_m:.4g} m; a learned policy observes positions up to "
            f"{limit_m:g} m, so move the origin of motion capture into the arena."
        )


def _prior(request: LearnRequest, choice: CarChoice) -> SimulatorConfig:
    """The prior simulator."""
    from carlab.experiment.campaign.campaign import check_period, prior_simulator

    if request.prior in BUILT_IN_PRIORS:
        kind: Literal["kinematic", "nominal"] = "kinematic" if request.prior == "kinematic" else "nominal"
        return prior_simulator(choice.simulator, kind)
    simulator = prior_simulator(_prior_file(request.prior).simulator, "nominal")
    check_period(simulator, choice.control_period_s, f"car '{car_name(request.car)}'")
    return simulator


def _prior_file(prior: str | Path | CarFile) -> CarFile:
    from carlab.cars import CarFile, is_preset, load_car_file

    if isinstance(prior, CarFile):
        return prior
    file = Path(prior)
    if file.suffix != ".toml" and not is_preset(file) and not file.is_file():
        raise ConfigError(f"--prior {prior}: give {', '.join(BUILT_IN_PRIORS)} or an existing car file.")
    return load_car_file(file)


def checked_simulator(request: LearnRequest) -> SimulatorConfig | None:
    """The simulator of the quick check, if it is not that of the car file. Raises ConfigError for an invalid file."""
    return None if request.prior in BUILT_IN_PRIORS else _prior_file(request.prior).simulator
