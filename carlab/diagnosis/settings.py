"""Settings of the diagnosis: thresholds and search parameters of all stages, with meaning, unit and reason.

"Development cases" are the concealed cases of ``carlab prove --set development``; figures of the test set were never
used to choose a setting. ``carlab prove --set development --calibrate`` sweeps the
thresholds that accept or reject effects.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class WindowSettings:
    """How recordings are split and cut into prediction windows."""

    fit_window_s: float = 0.8
    """Length [s] of a window to fit: long enough for lags to show, short enough for errors to stay linear."""
    fit_stride_s: float = 0.3
    """Time [s] between the starts of windows to fit."""
    held_out_window_s: float = 1.0
    """Horizon [s] of held-out errors and of the score, as report.json states it."""
    held_out_stride_s: float = 0.25
    """Time [s] between the starts of held-out windows."""
    max_fit_windows: int = 600
    """Maximum number of windows to fit, thinned evenly; bounds the time of a diagnosis."""
    max_held_out_windows: int = 1200
    """Maximum number of held-out windows, thinned evenly."""
    min_fit_s: float = 8.0
    """Minimum driving time [s] to fit; shorter recordings are inconclusive. Chosen on development cases."""
    default_held_out_share: float = 0.3
    """Last share of each recording that is held out if no recordings are given as held out."""
    max_held_out_share: float = 0.5
    """Maximum held-out share."""
    split_guard_s: float = 0.5
    """Gap [s], in addition to one horizon, between the part to fit and the held-out part (history of commands)."""
    unusable_share: float = 0.5
    """The verdict is "data" if faults leave less than this share of the driving usable."""
    min_speed_mps: float = 0.2
    """The 90 % quantile of the speed [m/s] must reach this for a verdict."""
    min_command_std: float = 0.01
    """A command with a lower standard deviation counts as constant."""


@dataclass(frozen=True, slots=True)
class IdentificationSettings:
    """Fit of a simulator to windows, noise of the recordings, and the window of their velocities."""

    huber_delta: float = 4.0
    """Whitened error [standard deviations] from which Huber's loss is linear (Huber 1964)."""
    loss_steps: int = 6
    """Steps of a window whose errors enter the loss."""
    max_fold_step: float = 4.0
    """Maximum step of a coordinate when a fold is removed from a fit."""
    fold_step_shares: tuple[float, ...] = (1.0, 0.5, 0.2)
    """Shares of that step that are evaluated; the share with the smallest loss on the other folds is used."""
    prior_std_share: float = 0.3
    """Prior standard deviation of a base parameter without a range, as a share of the car file's value."""
    latency_std_s: float = 0.01
    """Prior standard deviation [s] of a latency of motion capture that the car file does not state. Camera systems over
    a network have 3 to 30 ms."""
    max_latency_s: float = 0.15
    """Maximum latency [s] of motion capture."""
    min_noise_std: tuple[float, ...] = (1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4)
    """Minimum noise of x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s]: keeps weights of noise-free data finite."""
    min_power_share: float = 0.5
    """Share of noise power that the residual of the local cubic must keep for its spectrum to be used."""
    noise_max_z: float = 3.0
    """Residuals are clipped here [robust standard deviations]; larger ones are motion faster than the cubic."""
    noise_segment_rows: int = 64
    """Rows of a segment of Welch's spectrum (Welch 1967)."""
    slowest_share: float = 0.3
    """Share of the slowest rows, which give the noise of a car whose wheels vibrate."""
    max_error_quantile: float = 0.99
    """Quantile at which errors of initial states are clipped: a window at the edge of a spin contains no noise."""
    velocity_max_period_s: float = 0.06
    """Maximum period [s] at which velocities can be estimated from differences of poses."""
    velocity_max_width_s: float = 0.25
    """Maximum width [s] of a velocity window, as a box."""
    velocity_z_min: float = 3.0
    """Minimum variance of the velocity window [standard errors]."""
    curve_std: float = 10.0
    """Prior standard deviation of a measured curve's deviations, in typical sizes: keeps knots without data at 0."""
    curve_roughness_std: float = 1.0
    """The same for its changes of slope. From 0.1 to 1 the error on the last part of ETH train_1 changes by 4 %."""
    max_batch_sets: int = 24
    """Maximum number of parameter sets that are simulated in one batch; bounds the memory of a Jacobian."""
    velocity_min_samples: int = 50
    """Minimum number of samples of the regression of the velocity window."""


@dataclass(frozen=True, slots=True)
class CurveSettings:
    """Fit of measured curves, and what a recording supports."""

    min_unexplained_share: float = 0.1
    """Share of the refit's squared excess that named effects must leave, so that curves are fitted."""
    max_windows: int = 200
    """Windows of the first fit and of the removal of curves; the last fit uses all."""
    first_iterations: int = 10
    iterations: int = 4
    last_iterations: int = 3
    """Iterations of the first fit, of the last fit, and with the updated error scale or without one curve."""
    tolerance: float = 1e-3  # relative fall of the cost at which a fit ends
    keep_z_min: float = 0.0
    """Minimum rise of the loss on unseen blocks without a curve that is kept [standard errors]; 2 is worse on ETH."""
    accept_z_min: float = 3.0
    """Minimum fall of the loss on unseen blocks with all curves [standard errors]."""
    min_support_s: float = 0.5
    """Minimum driving time [s] near a knot; without it the curve ends there in the report."""
    min_fitted_s: float = 0.05
    """The same for a knot whose fitted deviation is used; others have that of the nearest such knot."""


@dataclass(frozen=True, slots=True)
class ScreeningSettings:
    """The score test of all candidates (Rao 1948), evaluated at finite sizes."""

    max_windows: int = 180
    """Number of windows for screening; sufficient to rank the candidates."""
    error_rms_changes: tuple[float, ...] = (0.15, 0.6, 2.4)
    """Root mean square changes of the whitened errors at which a candidate is evaluated."""
    typical_size_ratios: tuple[float, ...] = (0.15, 0.25, 0.4, 0.6, 0.9, 1.3, 2.0, 3.0, 5.0)
    """Shares of the typical size at which a candidate with an infinite identity value is evaluated."""
    max_starts: int = 3
    """Maximum number of initial points of a candidate's fit."""
    min_start_score_share: float = 0.75
    """A further initial point must have this share of the best screening score."""
    probe_size: float = 0.03
    """Size of the probe, in typical sizes, that relates a parameter to a change of the errors."""
    max_whitened_change: float = 50.0
    """Changes of whitened errors are clipped here [standard deviations]."""
    batch_size: int = 8
    """Number of points that are simulated in one batch; bounds the memory."""
    step_range: tuple[float, float] = (0.3, 1.5)
    """Bounds of the factor by which an initial point is scaled along the best direction."""
    max_step: float = 2.0
    """Maximum step along a candidate's secant for the score."""


@dataclass(frozen=True, slots=True)
class SelectionSettings:
    """Joint refits, tests on unseen blocks, acceptance, moves, elimination and pairwise tests."""

    max_refits: int = 10
    """Maximum number of candidates, by screening score, that are refitted together with the base parameters."""
    confusable_leaders: int = 3
    """Number of leading candidates whose confusable effects are refitted as well."""
    folds: int = 6
    """Number of folds of blocks for the test on unseen blocks."""
    min_score_share: float = 0.1
    """A candidate is refitted if its screening score is at least this share of the best. Chosen on development
    cases."""
    min_score_chi2: float = 8.0
    """A candidate is refitted if twice its score over the design effect is at least this."""
    min_gain_share: float = 0.3
    """A refitted candidate is tested on unseen blocks if its gain is at least this share of the best."""
    max_unseen_error: float = 12.0
    """Whitened errors on unseen blocks are clipped here [standard deviations], to limit the influence of one spin."""
    accept_chi2_min: float = 25.0
    """Minimum chi2 (twice the gain over the design effect) of an accepted effect with one parameter. Chosen on
    development cases: about 60 candidates are compared."""
    accept_chi2_per_number: float = 8.0
    """Additional chi2 per additional parameter and for an infinite identity value. Chosen on development cases."""
    accept_unseen_share: float = 0.015
    """Minimum unseen gain of an accepted effect, as a share of the loss of a perfect simulator."""
    accept_unseen_ratio: float = 0.3
    """Minimum unseen gain of an accepted effect, as a share of its gain on the fitted blocks."""
    steady_z_min: float = 3.0
    """Alternative: minimum unseen gain [standard errors] together with ``steady_unseen_share``."""
    steady_unseen_share: float = 0.03
    """Alternative: minimum unseen gain, as a share of the loss of a perfect simulator."""
    keep_chi2_min: float = 16.0
    """Minimum chi2 of an earlier effect after others were added, and minimum chi2 of a swap."""
    swap_score_share: float = 0.7
    """A confusable effect may replace an effect if its screening score is at least this share of the effect's gain."""
    max_effects: int = 10
    """Maximum number of effects."""
    scale_change_max: float = 0.03
    """Relative change of the error scale at convergence."""
    scale_iterations: int = 4
    """Maximum number of refits until the error scale converges."""
    start_iterations: int = 3
    """Number of iterations by which the initial points of a candidate are compared."""
    keep_z_min: float = 1.2
    """One of several effects is removed if its removal costs less than this on unseen blocks [standard errors]."""
    tie_z: float = 2.0
    """Two effects are indistinguishable if their losses on unseen blocks differ by less [standard errors]."""
    max_set_rivals: int = 2
    """Maximum number of effects in ``indistinguishable_from`` of report.json."""


@dataclass(frozen=True, slots=True)
class RivalSettings:
    """Uncatalogued physics as a rival of accepted effects, and spurious attributions."""

    max_refits: int = 2
    """Maximum number of rivals, by screening score, that are fitted."""
    min_score_share: float = 0.6
    """A rival is fitted in place of effects if its screening score is at least this share of their gain."""
    chi2_per_number: float = 4.0
    """Minimum chi2 per additional parameter of a rival."""
    max_single_names: int = 2
    """Maximum number of effects that are compared with rivals one by one; up to twice as many are compared together."""
    additional_chi2_min: float = 20.0
    """Minimum chi2 of uncatalogued physics that is reported in addition to effects."""
    spurious_share: float = 0.1
    """Effects are spurious if unnamed physics gains more than this share of the total gain. Chosen on development
    cases."""
    spurious_share_many: float = 0.3
    """The same for ``many_effects`` effects or more: such a car may also have physics outside the catalogue."""
    many_effects: int = 3
    """Number of effects from which ``spurious_share_many`` applies."""
    min_unnamed_share: float = 0.04
    """Minimum gain of unnamed physics that makes effects spurious, as a share of a perfect simulator's loss."""
    unnamed_ratio: float = 1.15
    """One or two effects are spurious if unnamed terms gain this many times the gain of the effects."""
    weak_term_chi2: float = 14.0
    """Minimum chi2 of a term that describes a residual that is already significant."""
    vibration_share: float = 0.02
    """Vibration comes first in the description if its lower bound is this share of the squared excess."""
    description_ratio: float = 0.85
    """Uncatalogued physics describes the residual if it gains this share of the gain of unnamed terms."""


@dataclass(frozen=True, slots=True)
class EvidenceSettings:
    """Intervals, confidence, the verdict."""

    parameter_z_min: float = 4.0
    """First condition of the verdict "parameters": minimum gain of the refit [standard errors]."""
    parameter_gain_share: float = 0.05
    """Second condition: minimum gain of the refit, as a share of the nominal loss."""
    parameter_score_ratio: float = 0.98
    """Third condition: maximum held-out score of the refit, as a share of the nominal score."""
    interval_z: float = 1.6449
    """Quantile of the normal distribution for 90 % intervals."""
    interval_factor: float = 1.25
    """Factor on the width of intervals of the sandwich covariance, which covered 79 % on development cases."""
    min_relative_std: float = 0.01
    """Minimum half width of an interval over ``interval_z``, as a share of the value: allows for model error."""
    unexplained_score_min: float = 1.2
    """Refit score (noise floors) above which unnamed terms count as missing physics. Chosen on development cases."""
    unexplained_score_min_without_term: float = 1.8
    """The same if no unnamed term is significant."""
    confidence_half: float = 8.0
    """Square root of chi2 at which half of the effects are correct: logistic regression on development cases."""
    confidence_slope: float = 5.0
    """Slope of that regression in the logarithm of the root."""
    min_explained_excess: float = 0.05
    """Squared excess of the refit below which the unexplained share is 0."""
    unexplained_share_min: float = 0.1
    """Minimum unexplained share of the squared excess that is reported."""


@dataclass(frozen=True, slots=True)
class UnexplainedSettings:
    """Unnamed terms, the worst regime, and vibration."""

    max_terms: int = 3
    """Maximum number of terms of the formula."""
    term_chi2_min: float = 28.0
    """Minimum chi2 of a term; about 400 terms are compared."""
    next_term_share: float = 0.12
    """Minimum gain of an additional term, as a share of the first term's gain."""
    simplest_gain_share: float = 0.97
    """The simplest of the terms with at least this share of the best gain is chosen."""
    impulses: int = 8
    """Number of impulses along a window for the response to an acceleration."""
    impulse_sizes: tuple[float, float, float] = (0.02, 0.02, 0.1)
    """Size of an impulse on vx, vy [m/s] and yaw rate [rad/s]: small enough for a linear response."""
    regime_quantile: float = 2 / 3
    """A regime is the range of a feature above this quantile."""
    regime_ratio_min: float = 1.3
    """Minimum ratio of the errors in a regime to those outside."""
    regime_windows_min: int = 5
    """Minimum number of windows in a regime and outside it."""
    vibration_ratio_min: float = 4.5
    """Minimum power of a line over the mean power; development recordings without vibration stay below 3.2."""
    vibration_p_max: float = 1e-15
    """Maximum p-value of that power; matters for short recordings."""
    vibration_block_s: float = 4.0
    """Length [s] of blocks whose power spectra are added."""
    vibration_speed_min_mps: float = 0.3
    """Minimum mean speed [m/s] of a block."""
    vibration_max_z: float = 4.0
    """Residuals are clipped here [robust standard deviations]."""


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
    used_steps: int = 6
    """Number of steps of a window whose errors enter a fit."""
    single_cause_share: float = 0.8
    """If one cause explains this share of the excess, the parameters are not refitted."""
    min_share: float = 0.1
    """Minimum share of the excess that a reported cause explains."""
    min_additional_share: float = 0.25
    """Minimum share that an added effect explains of the excess after a refit."""
    min_additional_z: float = 2.0
    """Minimum gain of an added effect [standard errors]."""
    max_unseen_error: float = 25.0
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


@dataclass(frozen=True, slots=True)
class ReportSettings:
    """Contents of the report."""

    reading_z_min: float = 2.0
    """Minimum difference from the car file's curve at each knot of a reading [standard deviations]."""
    saturation_share: float = 0.3
    """A drive force saturates if it grows by less than this share of the car file's growth."""
    score_above_noise: float = 1.5
    """Score (noise floors) above which a verdict without missing physics has a warning."""
    max_traces: int = 3
    """Maximum number of held-out recordings in figures."""
    max_correlations: int = 3
    """Maximum number of effects with a figure of their cross-correlation."""
    max_candidates: int = 12
    """Maximum number of rows in the table of candidate effects."""
    max_picture_names: int = 5
    """Maximum number of effects in the title of summary.png."""
    correlation_step_s: float = 0.2
    """Time [s] into a window at which the residual is correlated with earlier commands."""
    correlation_z: float = 2.58
    """Quantile of the normal distribution for the 99 % bound of a correlation."""
    worst_stretches: int = 3
    """Number of stretches with the largest errors that are marked in a recording."""


@dataclass(frozen=True, slots=True)
class DiagnosisSettings:
    """All settings of a diagnosis, by stage."""

    windows: WindowSettings = field(default_factory=WindowSettings)
    identification: IdentificationSettings = field(default_factory=IdentificationSettings)
    curves: CurveSettings = field(default_factory=CurveSettings)
    screening: ScreeningSettings = field(default_factory=ScreeningSettings)
    selection: SelectionSettings = field(default_factory=SelectionSettings)
    rivals: RivalSettings = field(default_factory=RivalSettings)
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)
    unexplained: UnexplainedSettings = field(default_factory=UnexplainedSettings)
    quick: QuickSettings = field(default_factory=QuickSettings)
    report: ReportSettings = field(default_factory=ReportSettings)


DEFAULT = DiagnosisSettings()
"""The settings of ``carlab diagnose`` and of the proof."""
