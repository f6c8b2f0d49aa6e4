"""Warnings about an episode in which neutral replaced commands without ending it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from carlab.core.documents import SafetyEvent
from carlab.core.episode_data import EpisodeData

MAX_NEUTRAL_SHARE = 0.1
"""Largest share of the moving commands that neutral may replace without a warning [1]."""
RATE_REMEDY = "Measure rate, losses and latency of motion capture with carlab listen."
REMEDIES = {"stale_pose": RATE_REMEDY, "unknown_speed": RATE_REMEDY, "pose_problems": ""}
"""Remedy for each kind of event of the safety gate that sets neutral; the text of a pose problem contains its own."""
TELEMETRY_REMEDY = (
    "The telemetry of the motor controller was late: check its cable, and measure its age with carlab check."
)


def neutral_warning(data: EpisodeData, events: Sequence[SafetyEvent]) -> str:
    """Warn if neutral replaced many moving commands of an episode, with the most frequent cause; else empty.

    Without an event of the safety gate the sender process has set neutral, because of late telemetry.
    """
    is_moving = np.any(data.requested != 0.0, axis=1)
    is_replaced = is_moving & ~np.any(data.sent != 0.0, axis=1)
    if is_replaced.sum() <= MAX_NEUTRAL_SHARE * is_moving.sum():
        return ""
    what = f"Neutral replaced {is_replaced.sum()} of {is_moving.sum()} moving commands."
    kinds = Counter(event.kind for event in events if event.kind in REMEDIES)
    if not kinds:
        return f"{what} {TELEMETRY_REMEDY}"
    kind = kinds.most_common(1)[0][0]
    text = next(event.text for event in events if event.kind == kind)
    return f"{what} {text} {REMEDIES[kind]}".rstrip()
