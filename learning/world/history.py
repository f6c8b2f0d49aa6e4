"""Choice of the number of past commands in the inputs of a model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from carlab.core.episode_data import EpisodeData
from learning.outliers import leave_one_out, log_student
from learning.posterior.discrepancy import CHOLESKY_JITTER, fit_discrepancy
from learning.transitions import transitions_of

CANDIDATE_LENGTHS = (0, 1, 2, 3, 4, 6, 8)
MIN_GAIN_NATS = 0.1
"""Minimum gain in leave-one-out log-likelihood per row for one more command; times sqrt(k) for k more commands."""
MIN_ROWS, MAX_ROWS = 60, 240
STUDENT_DOF = 4.0


@dataclass(frozen=True, slots=True)
class HistoryChoice:
    """A chosen history.

    Attributes:
        history: number of commands before the last one.
        nll: mean leave-one-out negative log-likelihood per row for each length [nat, outputs in units of their
            standard deviation].
    """

    history: int
    nll: dict[int, float]

    def message(self) -> str:
        """One sentence about the choice."""
        shown = ", ".join(f"{h}: {value:.2f}" for h, value in self.nll.items())
        return (
            f"The data supports {self.history} past commands (leave-one-out negative log-likelihood by their number: "
            f"{shown})."
        )


def find_history(episodes: Sequence[EpisodeData]) -> HistoryChoice | None:
    """Choose the shortest history by the leave-one-out likelihood of a Gaussian process (``MIN_GAIN_NATS``).

    The process has a lengthscale for each input and is fitted by its evidence to the same rows for every length. The
    density is Student-t, so that collisions have little influence.

    Args:
        episodes: recordings.

    Returns:
        The choice; None with fewer than ``MIN_ROWS`` rows.

    Raises:
        DataError: the recordings hold enough ticks, but no complete step.
    """
    longest = CANDIDATE_LENGTHS[-1]
    if sum(max(e.ticks - longest, 0) for e in episodes) < MIN_ROWS:
        return None
    rows = transitions_of(episodes, longest)
    if len(rows) < MIN_ROWS:
        return None
    chosen = torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))[:MAX_ROWS].numpy()
    all_inputs, outputs = (torch.from_numpy(v[chosen]) for v in (rows.inputs, rows.targets))
    all_inputs = (all_inputs - all_inputs.mean(dim=0)) / all_inputs.std(dim=0).clamp_min(1e-6)
    outputs = (outputs - outputs.mean(dim=0)) / outputs.std(dim=0).clamp_min(1e-9)
    nll = {}
    for history in CANDIDATE_LENGTHS:
        inputs = torch.cat([all_inputs[:, :3], all_inputs[:, 3 + 2 * (longest - history) :]], dim=1)
        nll[history] = _leave_one_out_nll(inputs, outputs)
    best = CANDIDATE_LENGTHS[0]
    for history in CANDIDATE_LENGTHS[1:]:
        if nll[history] < nll[best] - MIN_GAIN_NATS * math.sqrt(history - best):
            best = history
    return HistoryChoice(best, nll)


def _leave_one_out_nll(inputs: Tensor, outputs: Tensor) -> float:
    """Mean leave-one-out negative log-likelihood of standardised outputs (n, O) at standardised inputs (n, D) [nat]."""
    row_weights = torch.ones(len(outputs), dtype=torch.float64)
    one = torch.ones(outputs.shape[1], dtype=torch.float64)
    discrepancy, noise = fit_discrepancy(inputs, outputs, None, 0.1 * one, one, row_weights)
    covariance = noise.add_to(discrepancy(inputs), row_weights)
    covariance.diagonal(dim1=1, dim2=2).add_(CHOLESKY_JITTER)
    standardised, variance = leave_one_out(outputs, covariance, noise.std, row_weights)
    density = log_student(standardised**2, 1, STUDENT_DOF) - 0.5 * variance.log()
    return -float(density.sum(dim=1).mean())
