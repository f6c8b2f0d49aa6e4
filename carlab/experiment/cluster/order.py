"""A training as files: what a machine needs to train, and what it returns.

| file of an order | content |
| --- | --- |
| order.json | plan, limits of the safety gate, names of the recordings |
| episodes/0001.mcap ... | recordings |
| models/000k/dynamics.pt, policy.npz | model and policy of the training before, if there was one |
| task.py | a user's task |

All files are data of a run folder. They are read by the loaders of the run folder, which run no code of them; only a
user's task is code.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from carlab.core.errors import ConfigError, DataError
from carlab.core.json_files import read_json
from carlab.core.observation import feature_size
from carlab.core.safety import SafetyEnvelope
from carlab.experiment.campaign.training import DYNAMICS_FILE, FIGURES_FILE, PRIOR_FILE, model_folder
from carlab.experiment.campaign.training_plan import TrainingPlan, plan_as_json, plan_from_json
from learning.policy.sac_agent import AGENT_FILE, SacAgent, SacSettings
from learning.world.car_fit import load_car

ORDER_FILE, TASK_FILE = "order.json", "task.py"
EPISODES, MODELS = "episodes", "models"
RESULT_FILES = frozenset({DYNAMICS_FILE, AGENT_FILE, PRIOR_FILE, FIGURES_FILE})


@dataclass(frozen=True, slots=True)
class TrainingOrder:
    """The arguments of ``train``.

    Attributes:
        plan: settings of the run.
        models: folder of the models.
        recordings: MCAP files of all episodes so far.
        envelope: limits of the car's safety gate.
    """

    plan: TrainingPlan
    models: Path
    recordings: tuple[Path, ...]
    envelope: SafetyEnvelope

    @property
    def number(self) -> int:
        """Number of the episode after the training."""
        return len(self.recordings) + 1

    @property
    def folder(self) -> Path:
        """Folder of the result."""
        return model_folder(self.models, self.number)

    def files(self) -> dict[str, bytes]:
        """The order as files, by relative path.

        Raises:
            ConfigError: the task is an object of a Python program, which cannot be sent as data.
            OSError: a file cannot be read.
        """
        check_task(self.plan)
        content = {
            "plan": plan_as_json(self.plan),
            "envelope": asdict(self.envelope),
            "recordings": [path.name for path in self.recordings],
        }
        files = {ORDER_FILE: json.dumps(content).encode()}
        files |= {f"{EPISODES}/{path.name}": path.read_bytes() for path in self.recordings}
        earlier = model_folder(self.models, self.number - 1)
        if earlier.is_dir():
            names = (DYNAMICS_FILE, AGENT_FILE)
            files |= {f"{MODELS}/{earlier.name}/{name}": (earlier / name).read_bytes() for name in names}
        if self.plan.task_choice.file:
            files[TASK_FILE] = Path(self.plan.task_choice.file).read_bytes()
        return files

    @classmethod
    def read(cls, folder: Path) -> TrainingOrder:
        """Read an order from its folder. Raises DataError if it cannot be read."""
        try:
            content = read_json(folder / ORDER_FILE, keep_infinite=True)
            plan = plan_from_json(content["plan"])
            if plan.task_choice.sha256:
                plan = replace(plan, task_choice=replace(plan.task_choice, file=str(folder / TASK_FILE)))
            names = [Path(str(name)).name for name in content["recordings"]]
            return cls(
                plan, folder / MODELS, tuple(folder / EPISODES / name for name in names), _envelope(content["envelope"])
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(f"The order of a training cannot be read ({error!r}); install the same carlab.") from error

    def publish(self, arrived: Path) -> dict[str, Any]:
        """Check the files of a finished training, and move them to their folder.

        Args:
            arrived: folder next to that of the result.

        Returns:
            The figures of the training.

        Raises:
            DataError: a file is missing, surplus or damaged, or belongs to another training; nothing is moved.
        """
        figures = self._checked(arrived)
        (arrived / PRIOR_FILE).write_text(self.plan.prior_toml, encoding="utf-8")
        shutil.rmtree(self.folder, ignore_errors=True)
        os.replace(arrived, self.folder)
        return figures

    def _checked(self, arrived: Path) -> dict[str, Any]:
        names = {str(path.relative_to(arrived)) for path in arrived.rglob("*")}
        if names != RESULT_FILES:
            raise DataError(f"the files are {', '.join(sorted(names)) or 'missing'}")
        car = load_car(arrived / DYNAMICS_FILE)
        agent = SacAgent.load(arrived, SacSettings(), self.plan.seed)
        if (car.history, agent.observation_size) != (self.plan.history, feature_size(self.plan.history)):
            raise DataError("model and policy have another number of past commands")
        try:
            figures = read_json(arrived / FIGURES_FILE)
        except (OSError, ValueError) as error:
            raise DataError(f"{FIGURES_FILE} cannot be read ({error})") from error
        if figures.get("episode") != self.number:
            raise DataError(f"they are of episode {figures.get('episode')}")
        return figures


def check_task(plan: TrainingPlan) -> None:
    """Raise ConfigError if the task of a plan cannot be sent as data."""
    if plan.task_choice.given is not None:
        raise ConfigError(
            f"The task {plan.task_choice.name} is an object of your program, which cannot train on a cluster; name it "
            "as FILE.py:CLASS, or leave out the cluster."
        )


def _envelope(table: Mapping[str, Any]) -> SafetyEnvelope:
    arena = tuple((float(x), float(y)) for x, y in table["arena_m"])
    limits: dict[str, Any] = {name: float(value) for name, value in table.items() if name != "arena_m"}
    return replace(SafetyEnvelope(**limits), arena_m=arena)


__all__ = ["RESULT_FILES", "TrainingOrder", "check_task"]
