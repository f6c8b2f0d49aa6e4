"""The learning curve for the rerun viewer, read back with the reader of rerun."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rerun.chunk import RrdReader

from carlab.core.quantities import STATE_NAMES
from carlab.recording.rerun.learning_curve import write_learning_curve


def values_of(path: Path, timeline: str) -> dict[str, dict[int, list[float]]]:
    """Scalars by entity and time."""
    values: dict[str, dict[int, list[float]]] = {}
    for chunk in RrdReader(str(path)).stream().to_chunks():
        batch = chunk.to_record_batch()
        names = batch.schema.names
        for name in names:
            component = (batch.schema.field(name).metadata or {}).get(b"rerun:component", b"")
            if component == b"Scalars:scalars" and timeline in names:
                times, cells = batch.column(timeline).to_pylist(), batch.column(name).to_pylist()
                values.setdefault(chunk.entity_path.strip("/"), {}).update(zip(times, cells, strict=True))
    return values


def test_figures_are_written_by_episode_and_states_with_bands_by_tick(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    measured_states = [rng.normal(size=(7, 6)), rng.normal(size=(5, 6))]
    ticks = np.array([[1, 2, 3], [3, 4, 5]])
    mean, std = rng.normal(size=(2, 3, 6)), rng.uniform(0.1, 1.0, (2, 3, 6))
    no_windows = (np.zeros((0, 3), dtype=int), np.zeros((0, 3, 6)), np.zeros((0, 3, 6)))
    rows = [{"episode": 1.0, "total_reward": 4.0}, {"episode": 2.0, "total_reward": np.nan}]
    write_learning_curve(
        tmp_path / "learn.rrd", rows, measured_states, [(ticks, mean, std), no_windows], ["", "it explains"]
    )
    assert [p.name for p in tmp_path.iterdir()] == ["learn.rrd"]
    assert values_of(tmp_path / "learn.rrd", "episode") == {"learning/total_reward": {1: [4.0]}}
    values = values_of(tmp_path / "learn.rrd", "tick")
    assert set(values) == {f"states/{name}/{kind}" for name in STATE_NAMES for kind in ("measured", "predicted")}
    for k, name in enumerate(STATE_NAMES):
        measured = values[f"states/{name}/measured"]
        assert [measured[t][0] for t in range(12)] == [*measured_states[0][:, k], *measured_states[1][:, k]]
        predicted = values[f"states/{name}/predicted"]
        assert sorted(predicted) == [2, 3, 4, 5]
        for tick, m, s in ((2, mean[0, 1, k], std[0, 1, k]), (5, mean[1, 2, k], std[1, 2, k])):
            np.testing.assert_allclose(predicted[tick], [m, m - 2.0 * s, m + 2.0 * s])
