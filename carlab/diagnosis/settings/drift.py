"""Settings of the drift of a car between and along recordings."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class DriftSettings:
    """When a change of the car since the fitted recordings is reported."""

    min_time_constant_s: float = 100.0
    """Minimum time constant [s] of a drift; what changes within 10 s may be an error that depends on the state."""
    gain_z_min: float = 2.0
    """Minimum gain of the adapted prediction on held-out windows [standard errors], and of each reported quantity."""
    change_z_min: float = 2.0
    """Minimum change of a reported quantity [standard deviations]."""
    min_blocks: int = 4
    """Minimum number of blocks of a recording; fewer give no usable standard error."""
    neighbours: int = 10
    """Number of fitted windows in a similar state whose mean error corrects the prediction of a window: the prediction
    of a car whose error depends on the state alone."""
    similar_quantile: float = 0.9
    """A state is similar to fitted ones if the nearest fitted window is nearer than this quantile of the distances from
    each fitted window to the nearest one of another block."""
    min_similar_share: float = 0.5
    """Minimum share of windows in similar states for a drift to be stated as a change of the car."""
    fit_stride_s: float = 0.25
    """Time [s] between the starts of fitted windows."""
    max_fit_windows: int = 1200
    """Maximum number of fitted windows among which neighbours are searched, thinned evenly."""
    ends_share: float = 0.25
    """First and last share of a recording, between which the change along it is stated."""
    series_points: int = 300
    """Maximum number of points of a series in report.json."""
