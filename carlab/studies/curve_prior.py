"""A prior simulator with measured curves that are fitted to the recordings of a study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from carlab.core.episode_data import EpisodeData
from carlab.diagnosis.curves.simulator_with_curves import simulator_with_curves
from carlab.studies.regression.recordings import RecordedCase
from learning.priors.simulator_model import CarModel
from sim_backends.car_parameters import SimulatorConfig


def with_curves(case: RecordedCase, episodes: Sequence[EpisodeData], nominal: SimulatorConfig) -> RecordedCase:
    """The case whose prior simulator has measured curves.

    Curves, base parameters and effects are fixed at their fitted values; the discrepancy process covers their errors
    (docs/decisions/0022-prior-with-curves.md).

    Args:
        case: with the simulator of the car file as prior.
        episodes: recordings to which the curves are fitted.
        nominal: the simulator of the car file.

    Raises:
        Inconclusive: too little driving, speed or variation of the commands.
    """
    fitted = replace(simulator_with_curves(episodes, nominal), priors={}, parameter_std={})
    given = case.prior
    assert isinstance(given, CarModel)
    return replace(case, prior=replace(given, config=fitted, ranges={}))


def unbroken_parts(episode: EpisodeData, selected: NDArray[np.bool_]) -> list[EpisodeData]:
    """The parts of an episode without gaps in the commands that ``selected`` (T,) marks.

    Each part has the states before its commands and the state after its last command.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], selected, [False]]).astype(np.int8)))
    return [_part(episode, int(first), int(end)) for first, end in zip(edges[::2], edges[1::2], strict=True)]


def _part(episode: EpisodeData, first: int, end: int) -> EpisodeData:
    """Commands ``first`` to ``end - 1``."""
    rows, ticks = slice(first, end + 1), slice(first, end)
    times_s, poses = episode.times_s[rows], episode.poses
    inside = (poses[:, 0] >= times_s[0]) & (poses[:, 0] <= times_s[-1])
    return replace(
        episode,
        times_s=times_s,
        states=episode.states[rows],
        requested=episode.requested[ticks],
        sent=episode.sent[ticks],
        rewards=episode.rewards[ticks],
        poses=poses[inside],
        extra={name: column[rows] for name, column in episode.extra.items()},
    )
