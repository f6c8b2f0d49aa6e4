"""Pairs of concealed effects for studies of learning."""

from __future__ import annotations

from carlab.benchmark.cases.proof_set import CaseSpec

EXCESS_NOISE_FLOORS = 4.0
"""Excess of the held-out error by each effect, in noise floors: the maximum of ``carlab prove``."""
PAIRS = (
    CaseSpec("pair", 2_000_248, ("motor_lag", "mocap_yaw_misalignment"), "catalogue", EXCESS_NOISE_FLOORS),
    CaseSpec("pair", 2_000_251, ("throttle_deadband", "velocity_filter_lag"), "other", EXCESS_NOISE_FLOORS),
    CaseSpec("pair", 2_000_254, ("steering_rate_limit", "longitudinal_slip"), "catalogue", EXCESS_NOISE_FLOORS),
)
"""The first pairs of the proof (seed 0) of excess 1 or more without effects of time or place, which a one-step model
cannot represent. They were chosen before any learning on them."""
