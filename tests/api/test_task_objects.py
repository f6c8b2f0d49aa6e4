"""A task object that cannot be learned is refused before anything is written."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import carlab
from carlab.core.errors import ConfigError
from carlab.core.observation import encode
from carlab.core.quantities import CarState
from carlab.core.task import Task
from learning.world.model_env import policy_inputs


class Ahead(Task):
    """A correct task."""

    name = "ahead"
    max_ticks = 10

    def sample_start(self, rng: np.random.Generator) -> CarState:
        return CarState(y_m=float(rng.uniform(-0.05, 0.05)))

    def reward(self, features: Any, action: Any, next_features: Any) -> Any:
        return next_features[..., 0]


class Far(Ahead):
    """A task beyond the positions that a policy observes."""

    def sample_start(self, rng: np.random.Generator) -> CarState:
        return CarState(x_m=25.0)


def refusal(task: Task, out: Path) -> str:
    with pytest.raises(ConfigError, match="The process that trains cannot import the task") as error:
        carlab.learn("sim", task=task, episodes=1, out=out)
    assert not out.exists()
    return str(error.value)


def test_class_within_a_function_is_refused(tmp_path: Path) -> None:
    class Local(Ahead):
        pass

    assert "FILE.py:CLASS" in refusal(Local(), tmp_path / "runs")


def test_class_of_a_notebook_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The module of a notebook has no file."""
    notebook = ModuleType("__main__")
    kind = type("Cell", (Ahead,), {"__module__": "__main__"})
    setattr(notebook, "Cell", kind)  # noqa: B010
    monkeypatch.setitem(sys.modules, "__main__", notebook)
    assert "notebook" in refusal(kind(), tmp_path / "runs")


def test_task_beyond_the_observed_positions_is_refused(tmp_path: Path) -> None:
    near, far = (policy_inputs(encode(np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0]), np.zeros((0, 2)))) for x in (25.0, 26.0))
    assert (near == far).all(), "a policy cannot distinguish these positions"
    with pytest.raises(ConfigError, match=r"coordinate of 25 m; a learned policy observes positions up to 20 m"):
        carlab.learn("sim", task=Far(), episodes=1, out=tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


def test_empty_name_of_a_task_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--task : choose one of parking"):
        carlab.drive("sim", task="", policy="neutral", ticks=2, out=tmp_path)
