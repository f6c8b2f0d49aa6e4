"""Settings of the quick check."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class QuickSettings:
    """The quick check: a fixed amount of work, independent of elapsed time."""

    window_s: float = 0.8
    """Length [s] of a prediction window; errors are evaluated at its end."""
    stride_s: float = 0.2
    """Time [s] between starts of windows."""
    max_windows: int = 100
    """Maximum number of windows, thinned evenly; bounds the time to that of five episodes."""
    min_windows: int = 4
    """Minimum number of windows; with fewer the check is undecided."""
    score_max: float = 1.3
    """Maximum score (noise floors) of a simulator that explains the recordings; the true simulator rarely exceeds it
    (tests/diagnosis/test_quick_check_study.py)."""
    min_blocks: int = 2
    """Minimum number of blocks (episodes, if there are several) with a score above ``score_max``."""
    block_s: float = 5.0
    """Length [s] of blocks that count as independent."""
    short_block_s: float = 0.8
    """The same with fewer than ``few_episodes`` episodes."""
    few_episodes: int = 3
    """Number of episodes below which ``short_block_s`` applies."""
    max_error: float = 100.0
    """Errors are clipped here [noise floors]."""
    screened_windows: int = 60
    """Number of windows for screening."""
    max_single_fits: int = 8
    """Maximum number of candidates that are fitted alone."""
    max_additional_fits: int = 4
    """Maximum number of effects that are fitted together with all parameters."""
    max_tested: int = 6
    """Maximum number of fitted candidates that are cross-validated."""
    fit_iterations: int = 6
    """Number of iterations of a fit."""
    half_fit_iterations: int = 4
    """Number of iterations of a fit to half of the windows, which starts from the fit to all windows."""
    single_cause_share: float = 0.8
    """If one cause explains this share of the excess, the parameters are not refitted."""
    min_share: float = 0.1
    """Minimum share of the excess that a reported cause explains."""
    min_additional_share: float = 0.25
    """Minimum share that an added effect explains of the excess after a refit."""
    min_additional_z: float = 2.0
    """Minimum gain of an added effect [standard errors]."""
    max_left_out_error: float = 25.0
    """Whitened errors on windows that were not fitted are clipped here [standard deviations]."""
    tie_z: float = 2.0
    """A cause whose loss differs by less [standard errors] from that of the first is indistinguishable from it."""
    max_causes: int = 3
    """Maximum number of reported causes, and of reported parameters of a refit."""
    condition_ratio_min: float = 1.5
    """Minimum ratio of the errors in a condition to those outside."""
    condition_windows_min: int = 4
    """Minimum number of windows in a condition and outside it."""
    condition_z_min: float = 2.5
    """Minimum difference of the squared errors [standard errors]."""
    max_conditions: int = 3
    """Maximum number of reported conditions."""
    place_radius_m: float = 0.5
    """Radius [m] of a place."""
    place_spacing_m: float = 0.5
    """Distance [m] between places."""
