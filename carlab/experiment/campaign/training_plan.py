"""Settings of model and policy training of a run."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, get_args

from carlab.core.method_names import current_method
from carlab.core.seeds import MAX_SEED
from carlab.core.task import Task
from carlab.core.task_choice import PARKING, TaskChoice
from carlab.core.ticks import MAX_TICKS
from carlab.core.toml_files import toml_tables
from carlab.experiment.campaign.prior_correction import LARGEST_GIVEN_HISTORY
from learning.world.car_fit import Method, Particles
from sim_backends.car_parameters import SimulatorConfig

log = logging.getLogger(__name__)

PLAN_VERSION = 2
EARLIER_NAMES = {"sim-fsvgd": "gp-sim-posterior", "fsvgd": "gp-posterior", "fsvgd-authors": "fsvgd"}
"""Methods of plans of version 1 by their current names."""
MIN_VALUES = {"history": 0, "updates": 1, "seed": 0, "threads": 1, "model_steps": 1, "ticks": 1}
MAX_VALUES = {"history": LARGEST_GIVEN_HISTORY, "seed": MAX_SEED, "ticks": MAX_TICKS}
"""Ranges of the integers of a plan."""


@dataclass(frozen=True, slots=True)
class TrainingPlan:
    """Settings of model and policy training, the same before every episode of a run.

    Attributes:
        prior_toml: car file of the prior simulator, with ranges and effects.
        history: number of past commands that model and policy observe.
        method: ``gp-sim-posterior`` has a simulator prior, ``gp-posterior`` has none; ``sim-fsvgd``,
            ``sim-fsvgd-corrected`` and ``fsvgd`` are the paper's, with its settings.
        particles: ``network``, or ``simulator`` for networks that correct the steps of the prior simulator.
        model_steps: steps of the particles' optimiser; None: the default of the method.
        updates: gradient steps of SAC (``updates_before``).
        ticks: ticks of an episode; None: those of the task.
        seed: seed of all random numbers.
        threads: number of threads of torch.
        device: device of the training; the policy drives on the CPU.
        task_choice: the task.
    """

    prior_toml: str
    history: int = 3
    method: Method = "gp-sim-posterior"
    model_steps: int | None = None
    updates: int = 30_000
    ticks: int | None = None
    seed: int = 0
    threads: int = 1
    device: str = "cpu"
    task_choice: TaskChoice = PARKING
    particles: Particles = "network"

    @property
    def task(self) -> Task:
        """The task at the control period of the prior, with the history of the model and the ticks of this run."""
        return self.task_choice.load().at_period(self.control_period_s).resized(self.history, self.ticks)

    @property
    def control_period_s(self) -> float:
        """Control period of the prior [s]."""
        return SimulatorConfig.from_tables(toml_tables(self.prior_toml)).control_period_s

    def updates_before(self, episode: int) -> int:
        """Gradient steps of SAC before an episode: 1.5 times ``updates`` before the first, 3 / episode after the third.

        Training continues from the previous policy, and the share of new rows decreases.
        """
        if episode == 1:
            return self.updates * 3 // 2
        return self.updates * 3 // max(episode, 3)


def plan_as_json(plan: TrainingPlan) -> dict[str, Any]:
    """The plan as values for a JSON file; of a user's task only the name and the hash of its file."""
    values = asdict(replace(plan, task_choice=PARKING))
    return {**values, "task_choice": plan.task_choice.to_table(), "version": PLAN_VERSION}


def method_of(plan: Mapping[str, Any]) -> str:
    """Method of a plan in a JSON file by its current name; files before version 2 have other names."""
    method = str(plan["method"]) if "method" in plan else "gp-sim-posterior"
    return current_method(method if plan.get("version", 1) >= PLAN_VERSION else EARLIER_NAMES.get(method, method))


def plan_from_json(content: Mapping[str, Any]) -> TrainingPlan:
    """Read the output of ``plan_as_json``; runs no code.

    Raises:
        KeyError, TypeError, ValueError: wrong names, types or ranges.
    """
    if not isinstance(content, Mapping):
        raise TypeError("the plan is not an object")
    task_choice = TaskChoice.from_table(content["task_choice"]) if "task_choice" in content else PARKING
    method = method_of(content)
    if method != content.get("method", method):
        log.warning("The run's method '%s' is now called '%s'.", content["method"], method)
    values = {k: v for k, v in content.items() if k != "version"}
    plan = TrainingPlan(**{**values, "method": method, "task_choice": task_choice})
    choices = ((plan.method, get_args(Method)), (plan.device, ("cpu", "cuda")), (plan.particles, get_args(Particles)))
    if not isinstance(plan.prior_toml, str) or any(value not in allowed for value, allowed in choices):
        raise ValueError("prior, method, device or particles of the plan")
    for name, minimum in MIN_VALUES.items():
        value = getattr(plan, name)
        if value is None and name in ("model_steps", "ticks"):
            continue
        if type(value) is not int or not minimum <= value <= MAX_VALUES.get(name, value):
            raise ValueError(f"{name} of the plan is {value!r}")
    return plan
