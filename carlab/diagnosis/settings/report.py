"""Settings of the report."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ReportSettings:
    """Contents of the report."""

    reading_z_min: float = 2.0
    """Minimum difference from the car file's curve at each knot of a reading [standard deviations]."""
    saturation_share: float = 0.3
    """A drive force saturates if it grows by less than this share of the car file's growth."""
    holding_slope_ratio: float = 2.0
    """A motor holds a speed if its acceleration falls there this many times as steeply as that of the car file."""
    score_above_noise: float = 1.5
    """Score (noise floors) above which a verdict without missing physics has a warning."""
    filter_lag_ratio: float = 0.6
    """Smallest ratio of the total delays of steering and drive that a filter of the poses can explain. Filters of 30 to
    100 ms in simulated recordings give 0.8 to 0.97."""
    latency_z_max: float = 1.6449
    """Largest fitted latency above its prior mean without a sentence about it [standard deviations of the prior]: 5 %
    of the prior are above."""
    min_parameter_share: float = 0.5
    """If fitted parameters explain more than this share of the car file's squared excess, a verdict about unexplained
    physics states them first."""
    uncertain_probability: float = 0.5
    """Probability of a name below which the console states it: the name is then more likely wrong than correct."""
    max_traces: int = 3
    """Maximum number of held-out recordings in figures."""
    max_correlations: int = 3
    """Maximum number of effects with a figure of their cross-correlation."""
    max_candidates: int = 12
    """Maximum number of rows in the table of candidate effects."""
    max_wrong_parameters: int = 3
    """Maximum number of parameters of the car file that the verdict sentence names."""
    max_limits: int = 3
    """Maximum number of effects in the sentence about sizes that the recordings exclude."""
    max_picture_names: int = 5
    """Maximum number of effects in the title of summary.png."""
    correlation_step_s: float = 0.2
    """Time [s] into a window at which the residual is correlated with earlier commands."""
    correlation_z: float = 2.58
    """Quantile of the normal distribution for the 99 % bound of a correlation."""
    worst_stretches: int = 3
    """Number of stretches with the largest errors that are marked in a recording."""
