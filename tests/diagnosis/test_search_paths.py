"""Paths of the search that follow other choices than the greedy one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.selection import forward
from carlab.diagnosis.selection.forward import Choice, Path, best_path, extend
from carlab.diagnosis.selection.problem import Candidate, Model, RunControl, SearchProblem
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive

LOSS = np.array([4.0, 0.5, 9.0])


@pytest.fixture(scope="module")
def problem() -> SearchProblem:
    car = SimulatorConfig(control_period_s=PERIOD_S)
    windows = cut_windows(segments_of([drive(car, 5.0, 3)]), 0.8, 0.5)
    return SearchProblem(car, windows, np.full(6, 1e-2), np.full(6, 1e-2), {}, ())


@pytest.fixture
def followed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """First effects of the followed paths. Each path ends after that effect, and none replaces the greedy one."""
    effects: list[str] = []

    def add(problem: SearchProblem, path: Path, chosen: tuple[Candidate, ...], control: RunControl) -> Path:
        effects.append(chosen[0].effect)
        model = replace(path.model, effects=(*path.model.effects, chosen[0].effect))
        return replace(path, model=model, visited=path.visited | {frozenset(model.effects)})

    monkeypatch.setattr(forward, "_add", add)
    monkeypatch.setattr(forward, "next_candidates", lambda *given: ())
    monkeypatch.setattr(forward, "remaining_excess", lambda *given: 1.0)
    monkeypatch.setattr(forward, "_is_better", lambda *given: False)
    return effects


def model_of(problem: SearchProblem, *effects: str) -> Model:
    fit = Fit(problem.nominal, (), np.zeros(0), 0.0, LOSS)
    return Model(effects, fit, Scale(np.array([1]), np.ones((1, 6))))


def candidate(model: Model, effect: str, gain: float, loss: np.ndarray) -> Candidate:
    return Candidate(effect, model.fit, gain, 100.0, gain, 1.0, loss)


def greedy_path(problem: SearchProblem, *choices: Choice) -> Path:
    sets = [("wind",), ("wind", "torque_steer"), ("wind", "torque_steer", "drag_brake")]
    visited = frozenset(map(frozenset, sets))
    return Path(model_of(problem, *sets[-1]), alternatives=choices, visited=visited)


def test_choices_with_equal_predictions_are_followed_once(problem: SearchProblem, followed: list[str]) -> None:
    """On a recording, a delay of both commands and a latency of motion capture predict the same measurements."""
    base, other = Path(model_of(problem, "wind")), Path(model_of(problem, "wind", "torque_steer"))
    choices = [
        Choice(base, candidate(base.model, "command_delay", 9.0, LOSS)),
        Choice(base, candidate(base.model, "mocap_latency", 8.9, LOSS * (1.0 + 1e-5))),
        Choice(base, candidate(base.model, "motor_lag", 8.8, LOSS[::-1])),
    ]
    best_path(problem, base.model, greedy_path(problem, *choices), RunControl())
    assert followed == ["command_delay", "motor_lag"]
    followed.clear()
    from_other_path = Choice(other, candidate(other.model, "mocap_latency", 8.9, LOSS))
    best_path(problem, base.model, greedy_path(problem, choices[0], from_other_path), RunControl())
    assert followed == ["command_delay", "mocap_latency"]


def test_path_ends_where_it_joins_an_earlier_one(
    problem: SearchProblem, followed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The greedy path had wind and torque steer in the other order, so this choice has no path of its own."""
    base = Path(model_of(problem, "torque_steer"))
    searched: list[tuple[str, ...]] = []
    compared: list[Any] = []
    monkeypatch.setattr(forward, "next_candidates", lambda p, model, control: searched.append(model.effects) or ())
    monkeypatch.setattr(forward, "_is_better", lambda *given: bool(compared.append(given)))
    joining = Choice(base, candidate(base.model, "wind", 9.0, LOSS))
    new = Choice(base, candidate(base.model, "motor_lag", 8.0, LOSS[::-1]))
    best_path(problem, base.model, greedy_path(problem, joining, new), RunControl())
    assert followed == ["wind", "motor_lag"]
    assert searched == [("torque_steer", "motor_lag")]
    assert len(compared) == 1


def test_path_that_reaches_a_visited_set_is_not_extended(problem: SearchProblem, followed: list[str]) -> None:
    path = Path(model_of(problem, "wind", "torque_steer"))
    assert extend(problem, path, RunControl(), {frozenset({"torque_steer", "wind"})}) is path
