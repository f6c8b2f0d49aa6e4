"""How many past commands a car needs: told by the data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from carlab.core.episode_data import EpisodeData
from learning.gap import TINY, learn_gap
from learning.outliers import left_out, log_student
from learning.transitions import transitions_of

TRIED = (0, 1, 2, 3, 4, 6, 8)
ENOUGH = 0.1
"""Nats by which a longer history must make a left-out row more likely."""
FEWEST_ROWS, ROWS = 60, 240
FREEDOM = 4.0


@dataclass(frozen=True, slots=True)
class HistoryChoice:
    """The history found.

    Attributes:
        history: commands before the last one.
        nll: mean negative log-likelihood of a row left out, by length [nat, in units of the outputs' spread].
    """

    history: int
    nll: dict[int, float]

    def words(self) -> str:
        """The choice in a sentence."""
        shown = ", ".join(f"{h}: {value:.2f}" for h, value in self.nll.items())
        return f"The data asks for {self.history} past commands (surprise at a row left out, by their number: {shown})."


def find_history(episodes: Sequence[EpisodeData], seed: int = 0) -> HistoryChoice | None:
    """The shortest history that no longer one beats, by how likely a Gaussian process makes rows that it did not see.

    The process has a lengthscale for each input and is fitted by its evidence to the same rows for every length;
    Student's distribution keeps collisions from having a say.

    Args:
        episodes: recordings.
        seed: of the rows that are drawn.

    Returns:
        The choice; None where there are too few rows to tell.
    """
    longest = TRIED[-1]
    if sum(max(e.ticks - longest, 0) for e in episodes) < FEWEST_ROWS:
        return None
    rows = transitions_of(episodes, longest)
    if len(rows) < FEWEST_ROWS:
        return None
    chosen = torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed))[:ROWS].numpy()
    everything, outputs = (torch.from_numpy(v[chosen]) for v in (rows.inputs, rows.targets))
    everything = (everything - everything.mean(dim=0)) / everything.std(dim=0).clamp_min(1e-6)
    outputs = (outputs - outputs.mean(dim=0)) / outputs.std(dim=0).clamp_min(1e-9)
    trust = torch.ones(len(outputs), dtype=torch.float64)
    one = torch.ones(outputs.shape[1], dtype=torch.float64)
    surprise = {}
    for history in TRIED:
        inputs = torch.cat([everything[:, :3], everything[:, 3 + 2 * (longest - history) :]], dim=1)
        gap, noise = learn_gap(inputs, outputs, None, 0.1 * one, one, trust)
        covariance = gap(inputs) + torch.diag_embed((noise**2 + TINY)[:, None] / trust)
        white, doubt = left_out(outputs, covariance, noise, trust)
        density = log_student(white**2, 1, FREEDOM) - 0.5 * doubt.log()
        surprise[history] = -float(density.sum(dim=1).mean())
    best = TRIED[0]
    for history in TRIED[1:]:
        if surprise[history] < surprise[best] - ENOUGH * math.sqrt(history - best):
            best = history
    return HistoryChoice(best, surprise)


__all__ = ["HistoryChoice", "find_history"]
