"""A training as files: what a machine needs to train, and what it returns.

| file of an order | content |
| --- | --- |
| order.json | plan, limits of the safety gate, names of the recordings |
| episodes/0001.mcap ... | recordings |
| models/000k/dynamics.npz, policy.npz | model and policy of the training before, if there was one |
| task.py | a user's task |

Recordings and policies are the files of a run folder. The model is sent as arrays, because the run folder's
``dynamics.pt`` contains a pickle. Readers run no code of these files; only a user's task is code.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from carlab.core.errors import ConfigError, DataError
from carlab.core.json_files import read_json
from carlab.core.observation import feature_size
from carlab.core.safety import SafetyEnvelope
from carlab.experiment.campaign.figures_file import FIGURES_FILE, read_training_figures
from carlab.experiment.campaign.training import DYNAMICS_FILE, PRIOR_FILE, TrainingRequest, model_folder
from carlab.experiment.campaign.training_plan import TrainingPlan, plan_as_json, plan_from_json
from learning.policy.sac_agent import AGENT_FILE, SacAgent, SacSettings
from learning.world.car_fit import load_car, load_car_arrays, save_car, save_car_arrays

ORDER_FILE, TASK_FILE = "order.json", "task.py"
EPISODES, MODELS = "episodes", "models"
ARRAYS_FILE = "dynamics.npz"
RESULT_FILES = frozenset({ARRAYS_FILE, AGENT_FILE, FIGURES_FILE})
"""Files of a result as the cluster sends them."""


class TrainingOrder(TrainingRequest):
    """A training as files."""

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
        files = {ORDER_FILE: json.dumps(content, default=float).encode()}  # NumPy numbers of a task's arena
        files |= {f"{EPISODES}/{path.name}": path.read_bytes() for path in self.recordings}
        earlier = model_folder(self.models, self.number - 1)
        if earlier.is_dir():
            sent = sent_files(earlier, (AGENT_FILE,))
            files |= {f"{MODELS}/{earlier.name}/{name}": content for name, content in sent.items()}
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
            for arrays in (folder / MODELS).glob(f"*/{ARRAYS_FILE}"):
                save_car(load_car_arrays(arrays), arrays.with_name(DYNAMICS_FILE))
            names = [Path(str(name)).name for name in content["recordings"]]
            return cls(
                plan, folder / MODELS, tuple(folder / EPISODES / name for name in names), _envelope(content["envelope"])
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(f"The order of a training cannot be read ({error!r}); install the same carlab.") from error

    def result(self) -> dict[str, bytes]:
        """The files of the finished training, as the cluster sends them."""
        return sent_files(self.folder, (AGENT_FILE, FIGURES_FILE))

    def publish(self, arrived: Path) -> dict[str, Any]:
        """Check the files of a finished training, and move them to their folder as files of the run.

        Args:
            arrived: folder next to that of the result.

        Returns:
            The figures of the training.

        Raises:
            DataError: a file is missing, surplus or damaged, or belongs to another training; nothing is moved.
        """
        figures = self._checked(arrived)
        (arrived / ARRAYS_FILE).unlink()
        (arrived / PRIOR_FILE).write_text(self.plan.prior_toml, encoding="utf-8")
        shutil.rmtree(self.folder, ignore_errors=True)
        os.replace(arrived, self.folder)
        return figures

    def _checked(self, arrived: Path) -> dict[str, Any]:
        names = {str(path.relative_to(arrived)) for path in arrived.rglob("*")}
        if names != RESULT_FILES:
            raise DataError(f"the files are {', '.join(sorted(names)) or 'missing'}")
        car = load_car_arrays(arrived / ARRAYS_FILE)
        agent = SacAgent.load(arrived, SacSettings(), self.plan.seed)
        if (car.history, agent.observation_size) != (self.plan.history, feature_size(self.plan.history)):
            raise DataError("model and policy have another number of past commands")
        figures = read_training_figures(arrived, self.number)
        save_car(car, arrived / DYNAMICS_FILE)
        return figures


def sent_files(model: Path, names: Sequence[str]) -> dict[str, bytes]:
    """The learned car of a folder as arrays, and further files, by name. Raises DataError if the car cannot be read."""
    with tempfile.TemporaryDirectory(prefix="arrays-") as folder:
        save_car_arrays(load_car(model / DYNAMICS_FILE), arrays := Path(folder) / ARRAYS_FILE)
        return {ARRAYS_FILE: arrays.read_bytes()} | {name: (model / name).read_bytes() for name in names}


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
