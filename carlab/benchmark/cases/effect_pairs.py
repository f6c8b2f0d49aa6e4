"""Pairs of concealed effects of the proof for which studies make new recordings."""

from __future__ import annotations

from dataclasses import dataclass

from carlab.benchmark.effects.catalogue import FormName


@dataclass(frozen=True, slots=True)
class ConcealedPair:
    """Two effects, the form of their equations, and the seed of car, drive and noise."""

    effects: tuple[str, str]
    form: FormName
    seed: int


PAIRS = (
    ConcealedPair(("motor_lag", "mocap_yaw_misalignment"), "catalogue", 2_000_248),
    ConcealedPair(("throttle_deadband", "velocity_filter_lag"), "other", 2_000_251),
    ConcealedPair(("steering_rate_limit", "longitudinal_slip"), "catalogue", 2_000_254),
)
"""The first pairs of the proof (seed 0) of excess 1 or more without effects of time or place, which a one-step model
cannot represent. They were chosen before any learning on them."""
