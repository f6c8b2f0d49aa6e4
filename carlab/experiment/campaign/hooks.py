"""Callbacks of a learning run. This module imports no heavy library."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from carlab.experiment.episodes.hooks import RunHooks

if TYPE_CHECKING:
    from carlab.experiment.campaign.figures import EpisodeFigures
    from carlab.experiment.campaign.prior_correction import PriorVersion
    from carlab.experiment.campaign.quick_check import EpisodeCheck


@dataclass(slots=True)
class LearnHooks(RunHooks):
    """Callbacks of a learning run; the defaults do nothing.

    Attributes:
        on_training: receives activity, steps done and total steps.
        on_learned: receives the figures of a finished training.
        on_figures: receives the figures of a finished episode.
        on_checking: called before the quick check of an episode against the simulator.
        on_check: receives the result of the quick check.
        on_correcting: called before the correction of the prior (``prior="auto"``).
        on_prior: receives the version of the prior after the correction, with the sentence that states what changed.
        on_link: receives a sentence when the cluster does not answer, is replaced by this computer, or answers again.
    """

    on_training: Callable[[str, int, int], None] = lambda activity, done, total: None
    on_learned: Callable[[dict[str, Any]], None] = lambda figures: None
    on_figures: Callable[[EpisodeFigures], None] = lambda figures: None
    on_checking: Callable[[], None] = lambda: None
    on_check: Callable[[EpisodeCheck], None] = lambda check: None
    on_correcting: Callable[[], None] = lambda: None
    on_prior: Callable[[PriorVersion], None] = lambda version: None
    on_link: Callable[[str], None] = lambda sentence: None
