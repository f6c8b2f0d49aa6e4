"""Restarts of a fit from perturbed parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.selection import forward, restarts
from carlab.diagnosis.selection.forward import Path, extend
from carlab.diagnosis.selection.problem import Candidate, Model, RunControl, SearchProblem
from carlab.diagnosis.selection.restarts import needs_restart, restart
from carlab.diagnosis.settings import RESTARTS
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from sim_backends.car_parameters import MocapParameters
from tests.helpers.recorded_drives import PERIOD_S, drive

ELLIPSE, SCALE = "friction_ellipse", "effects.friction_ellipse.scale"
CAR = SimulatorConfig(control_period_s=PERIOD_S, mocap=MocapParameters(latency_s=0.0))
STD = 3e-4 * np.array([1.0, 1.0, 2.0, 20.0, 20.0, 40.0])


@pytest.fixture(autouse=True)
def _one_effect_suffices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(restarts, "RESTARTS", replace(RESTARTS, min_effects=1))


@pytest.fixture(scope="module")
def problem() -> SearchProblem:
    """A search on 20 s of a car whose tyres share their grip between driving and cornering."""
    true = replace(CAR, effects={ELLIPSE: {"scale": 2.5}})
    return SearchProblem(CAR, cut_windows(segments_of([drive(true, 20.0, 3)]), 0.8, 0.5), 3.0 * STD, STD, {})


@pytest.fixture(scope="module")
def stuck(problem: SearchProblem) -> Model:
    """A fit that ended at scale 0, with the scale of its errors."""
    config, free = problem.config_with((ELLIPSE,)), problem.free_parameters((ELLIPSE,))
    scale = problem.scale_of(config)
    return Model((ELLIPSE,), problem.fitter(scale).fit(config, free, iterations=0), scale)


def test_restart_finds_the_lower_minimum(problem: SearchProblem, stuck: Model) -> None:
    assert stuck.fit.values()[SCALE] == pytest.approx(0.0, abs=1e-3)
    found = restart(problem, stuck, RunControl())
    assert found.effects == stuck.effects
    assert found.fit.values()[SCALE] == pytest.approx(2.5, rel=0.05)


def test_model_that_reaches_the_noise_is_not_restarted(problem: SearchProblem, stuck: Model) -> None:
    accurate = replace(stuck, scale=Scale(np.array([8, 16, 24]), np.tile(problem.floor, (3, 1))))
    assert needs_restart(problem, stuck)
    assert not needs_restart(problem, accurate)


def test_stopped_search_is_not_restarted(problem: SearchProblem, stuck: Model) -> None:
    assert restart(problem, stuck, RunControl(ends_search=lambda: True)) is stuck


def test_model_with_few_effects_is_not_restarted(
    problem: SearchProblem, stuck: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(restarts, "RESTARTS", replace(RESTARTS, min_effects=2))
    assert not needs_restart(problem, stuck)


def test_path_continues_with_the_restarted_model(
    problem: SearchProblem, stuck: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = Model((), problem.fitter(stuck.scale).fit(CAR, ()), stuck.scale)
    restarted: list[Model] = []

    def other(problem: SearchProblem, model: Model, control: RunControl) -> Model:
        restarted.append(replace(model, fit=replace(model.fit, cost=1.0)))
        return restarted[-1]

    monkeypatch.setattr(forward, "restart", other)
    monkeypatch.setattr(forward, "needs_restart", lambda problem, model: True)
    monkeypatch.setattr(
        forward, "next_candidates", lambda problem, model, control: (Candidate(ELLIPSE, stuck.fit, 1.0),)
    )
    monkeypatch.setattr(
        forward, "accepted", lambda problem, model, candidates, control: candidates[: 1 - len(model.effects)]
    )
    path = extend(problem, Path(base), RunControl())
    assert len(restarted) == 1
    assert path.model is restarted[0]
    assert path.history == ((ELLIPSE, restarted[0].fit),)


@pytest.mark.parametrize(("found_lower", "expected"), [(False, 2), (True, 4)])
def test_path_is_restarted_until_two_successive_restarts_find_nothing(
    problem: SearchProblem, stuck: Model, monkeypatch: pytest.MonkeyPatch, found_lower: bool, expected: int
) -> None:
    """Four effects are accepted; the second restart finds a lower cost or not."""
    restarted: list[Model] = []

    def other(problem: SearchProblem, model: Model, control: RunControl) -> Model:
        restarted.append(model)
        return replace(model) if found_lower and len(restarted) == 2 else model

    def fitted(problem: SearchProblem, effects: tuple[str, ...], *start: object) -> Model:
        return replace(stuck, effects=effects)

    monkeypatch.setattr(forward, "restart", other)
    monkeypatch.setattr(forward, "fit_with_scale", fitted)
    monkeypatch.setattr(forward, "apply_moves", lambda problem, model, control: model)
    names = iter(("a", "b", "c", "d"))
    monkeypatch.setattr(
        forward, "next_candidates", lambda *_: tuple(Candidate(name, stuck.fit, 1.0) for name in (next(names, ""),))
    )
    monkeypatch.setattr(forward, "accepted", lambda _, __, candidates, ___: candidates if candidates[0].effect else ())
    path = extend(problem, Path(replace(stuck, effects=())), RunControl())
    assert path.model.effects == ("a", "b", "c", "d")
    assert len(restarted) == expected
