"""Callbacks of runs."""

from __future__ import annotations

from pathlib import Path

import carlab


def test_learning_run_calls_the_hooks_of_any_run_once_an_episode(tmp_path: Path) -> None:
    episodes: list[int] = []
    results: list[int] = []
    hooks = carlab.RunHooks(
        on_episode=lambda number, ticks: episodes.append(number),
        on_result=lambda result: results.append(result.episode),
    )
    run = carlab.learn(
        "sim", episodes=1, ticks=10, updates=10, model_steps=10, history=1, out=tmp_path, rerun=False, hooks=hooks
    )
    assert run.is_complete
    assert (episodes, results) == ([1], [1])
