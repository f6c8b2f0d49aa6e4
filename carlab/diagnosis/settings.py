"""Settings of the diagnosis: every number that a stage decides or searches by, with its meaning, unit and reason.

"Development cases" are the concealed cases of ``carlab prove --set development``; figures of the test set were never
used to choose a setting. ``carlab prove --set development --calibrate`` sweeps those that decide about a name.
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
    """More windows to fit are thinned evenly; bounds the time of a diagnosis."""
    max_held_out_windows: int = 1200
    """More held-out windows are thinned evenly."""
    min_fit_s: float = 8.0
    """Least driving [s] to fit; shorter recordings are inconclusive. Chosen on development cases."""
    default_held_out_share: float = 0.3
    """Last share of each recording that is held out where no recording is held out whole."""
    max_held_out_share: float = 0.5
    """Largest share that may be held out."""
    split_guard_s: float = 0.5
    """Driving [s] beyond one horizon that is left out between the part to fit and the held-out part (history)."""
    unusable_share: float = 0.5
    """Where faults leave less than this share of the driving, the recording is at fault and not the drive."""
    min_speed_mps: float = 0.2
    """The 90 % quantile of the speed [m/s] must reach this for a verdict."""
    min_command_std: float = 0.01
    """A command whose standard deviation is below this is constant."""


@dataclass(frozen=True, slots=True)
class IdentificationSettings:
    """Fit of a simulator to windows, noise of the recordings, and the window of their velocities."""

    huber_delta: float = 4.0
    """Whitened error [standard deviations] from which Huber's loss is linear (Huber 1964)."""
    loss_steps: int = 6
    """Steps of a window whose errors enter the loss."""
    max_fold_step: float = 4.0
    """Longest step of a coordinate when a fold is removed from a fit."""
    fold_step_shares: tuple[float, ...] = (1.0, 0.5, 0.2)
    """Shares of that step that are evaluated; the one with the smallest loss on the other folds is taken."""
    prior_std_share: float = 0.3
    """Prior standard deviation of a base parameter without a range, as a share of the car file's value."""
    latency_std_s: float = 0.01
    """Prior standard deviation [s] of a latency of motion capture that the car file does not state. Camera systems over
    a network have 3 to 30 ms."""
    max_latency_s: float = 0.15
    """Largest such latency [s]."""
    min_noise_std: tuple[float, ...] = (1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4)
    """Least noise of x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s]: keeps weights of noise-free data finite."""
    min_power_share: float = 0.5
    """Share of noise power that the residual of the local cubic must keep for its spectrum to be used."""
    noise_max_z: float = 3.0
    """Residuals are clipped here [robust standard deviations]; beyond is motion faster than the cubic."""
    noise_segment_rows: int = 64
    """Rows of a segment of Welch's spectrum (Welch 1967)."""
    slowest_share: float = 0.3
    """Share of the rows, the slowest, that give the noise of a car that vibrates with its speed."""
    max_error_quantile: float = 0.99
    """Quantile at which errors of initial states are clipped: a window at the edge of a spin contains no noise."""
    velocity_max_period_s: float = 0.06
    """Longest period [s] at which differences of poses are velocities."""
    velocity_max_width_s: float = 0.25
    """Width [s] of the widest box that counts as a velocity window."""
    velocity_z_min: float = 3.0
    """Least variance of the velocity window [standard errors]."""
    velocity_min_samples: int = 50
    """Least samples of its regression."""


@dataclass(frozen=True, slots=True)
class ScreeningSettings:
    """The score test of all candidates (Rao 1948), evaluated at finite sizes."""

    max_windows: int = 180
    """Windows that are screened; enough to rank the candidates."""
    error_rms_changes: tuple[float, ...] = (0.15, 0.6, 2.4)
    """Root mean square changes of the whitened errors at which a candidate is evaluated."""
    typical_size_ratios: tuple[float, ...] = (0.15, 0.25, 0.4, 0.6, 0.9, 1.3, 2.0, 3.0, 5.0)
    """Shares of the typical size at which a candidate whose identity is infinite is evaluated."""
    max_starts: int = 3
    """Initial points of a candidate's fit."""
    min_start_score_share: float = 0.75
    """A further initial point must have this share of the best screening score."""
    probe_size: float = 0.03
    """Size of the probe, in typical sizes, that relates a parameter to a change of the errors."""
    max_whitened_change: float = 50.0
    """Changes of whitened errors are clipped here [standard deviations]."""
    batch_size: int = 8
    """Points that are simulated in one batch; bounds the memory."""
    step_range: tuple[float, float] = (0.3, 1.5)
    """Bounds of the factor by which an initial point is scaled along the best direction."""
    max_step: float = 2.0
    """The score is the best along a candidate's secant up to this factor."""


@dataclass(frozen=True, slots=True)
class SelectionSettings:
    """Joint refits, tests on unseen blocks, acceptance, moves, elimination and pairwise tests."""

    max_refits: int = 10
    """Candidates with the best screening scores that are refitted together with the base parameters."""
    confusable_leaders: int = 3
    """The confusable effects of so many leading candidates are refitted as well."""
    folds: int = 6
    """Folds of blocks for the test on unseen blocks."""
    min_score_share: float = 0.1
    """A candidate is refitted if its screening score is at least this share of the best. Chosen on development
    cases."""
    min_score_chi2: float = 8.0
    """A candidate is refitted if twice its score over the design effect is at least this."""
    min_gain_share: float = 0.3
    """A refitted candidate is tested on unseen blocks if its gain is at least this share of the best."""
    max_unseen_error: float = 12.0
    """Whitened errors on unseen blocks are clipped here [standard deviations]: one spin must not decide."""
    accept_chi2_min: float = 25.0
    """Least chi2 (twice the gain over the design effect) of an accepted effect with one number. Chosen on development
    cases: about 60 candidates are compared."""
    accept_chi2_per_number: float = 8.0
    """Further chi2 for each further number and for an infinite identity. Chosen on development cases."""
    accept_unseen_share: float = 0.015
    """Least unseen gain of an accepted effect, as a share of the loss of a perfect simulator."""
    accept_unseen_ratio: float = 0.3
    """Least unseen gain of an accepted effect, as a share of its gain on the blocks that were fitted."""
    steady_z_min: float = 3.0
    """An unseen gain of so many standard errors is accepted too, if it has ``steady_unseen_share``."""
    steady_unseen_share: float = 0.03
    """See ``steady_z_min``; a share of the loss of a perfect simulator."""
    keep_chi2_min: float = 16.0
    """An accepted effect with less chi2 is taken out again when others have come; a swap must gain this."""
    swap_score_share: float = 0.7
    """A confusable effect is tried in an effect's place if its screening score is this share of the effect's gain."""
    max_effects: int = 10
    """The search ends with so many effects."""
    scale_change_max: float = 0.03
    """Relative change of the scale of errors below which it has converged."""
    scale_iterations: int = 4
    """Refits by which the scale of errors converges, at most."""
    start_iterations: int = 3
    """Iterations by which initial points of one candidate are compared."""
    keep_z_min: float = 1.2
    """Of several effects, one whose removal costs less than this on unseen blocks [standard errors] is taken out."""
    tie_z: float = 2.0
    """Two effects whose losses on unseen blocks differ by less [standard errors] are one set: indistinguishable."""
    max_set_rivals: int = 2
    """Members of a set beside the effect itself, as report.json defines a set."""


@dataclass(frozen=True, slots=True)
class RivalSettings:
    """Uncatalogued physics as a rival of the names, and spurious attributions."""

    max_refits: int = 2
    """Rivals with the best screening scores that are fitted."""
    min_score_share: float = 0.6
    """A rival is fitted in the place of names if its screening score is this share of their gain."""
    chi2_per_number: float = 4.0
    """Chi2 that each further number of a rival must gain."""
    max_single_names: int = 2
    """Up to so many names are compared with rivals one by one, and up to twice as many together."""
    additional_chi2_min: float = 20.0
    """Least chi2 of uncatalogued physics that is reported in addition to the names."""
    spurious_share: float = 0.1
    """Names are spurious if physics without a name gains more than this share of all gain. Chosen on development
    cases."""
    spurious_share_many: float = 0.3
    """The same where there are ``many_effects`` names or more: such a car may have something without a name too."""
    many_effects: int = 3
    """See ``spurious_share_many``."""
    min_unnamed_share: float = 0.04
    """Gain of physics without a name below this share of a perfect simulator's loss makes no name spurious."""
    unnamed_ratio: float = 1.15
    """One or two names are spurious if terms without a name gain this many times what the names gain."""
    weak_term_chi2: float = 14.0
    """Least chi2 of a term that describes a residual which is certainly there."""
    vibration_share: float = 0.02
    """Vibration comes first in the description if its lower bound is this share of the squared excess."""
    description_ratio: float = 0.85
    """Uncatalogued physics describes the residual if it gains this share of what free terms gain."""


@dataclass(frozen=True, slots=True)
class EvidenceSettings:
    """Intervals, confidence, the verdict."""

    parameter_z_min: float = 4.0
    """Base parameters are reported as off if the refit gains so many standard errors."""
    parameter_gain_share: float = 0.05
    """They are, if the refit gains this share of the nominal loss too."""
    parameter_score_ratio: float = 0.98
    """They are, if the refit lowers the held-out score below this share of the nominal score too."""
    interval_z: float = 1.6449
    """Quantile of the normal distribution for 90 % intervals."""
    interval_factor: float = 1.25
    """Intervals are this much wider than the sandwich covariance's: on development cases those covered 79 %."""
    min_relative_std: float = 0.01
    """Least half width of an interval, over ``interval_z``, as a share of the value: the model's own error."""
    unexplained_score_min: float = 1.2
    """Refit score (noise floors) above which terms without a name amount to missing physics. Chosen on development
    cases."""
    unexplained_score_min_without_term: float = 1.8
    """The same where no term explains anything."""
    confidence_half: float = 8.0
    """Square root of chi2 at which half of the names are right: logistic regression on names of development cases."""
    confidence_slope: float = 5.0
    """Slope of that regression in the logarithm of the root."""
    min_explained_excess: float = 0.05
    """Squared excess of the refit below which nothing is unexplained."""
    unexplained_share_min: float = 0.1
    """Least share of the squared excess that is reported as unexplained, as report.json defines it."""


@dataclass(frozen=True, slots=True)
class UnexplainedSettings:
    """Terms without a name, the worst regime, and vibration."""

    max_terms: int = 3
    """Terms of the formula."""
    term_chi2_min: float = 28.0
    """Least chi2 of a term; about 400 terms are compared."""
    next_term_share: float = 0.12
    """A further term must gain this share of the first."""
    simplest_gain_share: float = 0.97
    """The simplest is taken of the terms that gain this share of the best."""
    impulses: int = 8
    """Impulses along a window by which the response to an acceleration is computed."""
    impulse_sizes: tuple[float, float, float] = (0.02, 0.02, 0.1)
    """Size of an impulse on vx, vy [m/s] and yaw rate [rad/s]: small enough for a linear response."""
    regime_quantile: float = 2 / 3
    """A regime is where a feature is above this quantile."""
    regime_ratio_min: float = 1.3
    """Errors must be so much larger within a regime than outside."""
    regime_windows_min: int = 5
    """Least windows within and outside a regime."""
    vibration_ratio_min: float = 4.5
    """Least power of a line over the mean power; development recordings without vibration stay below 3.2."""
    vibration_p_max: float = 1e-15
    """Largest probability of that power by chance: guards short recordings."""
    vibration_block_s: float = 4.0
    """Blocks [s] whose powers are added without phase."""
    vibration_speed_min_mps: float = 0.3
    """Least mean speed [m/s] of a block."""
    vibration_max_z: float = 4.0
    """Residuals are clipped here [robust standard deviations]."""


@dataclass(frozen=True, slots=True)
class QuickSettings:
    """The quick check: a fixed amount of work, whatever the clock says."""

    window_s: float = 0.8
    """Length [s] of a prediction window, after which errors count."""
    stride_s: float = 0.2
    """Time [s] between starts of windows."""
    max_windows: int = 100
    """Windows, evenly taken of all recordings: bounds the time to that of five episodes."""
    min_windows: int = 4
    """With fewer windows the check is undecided."""
    score_max: float = 1.3
    """Largest score (noise floors) of a simulator that explains the recordings; the simulator that made recordings is
    hardly ever above (tests/diagnosis/test_quick_check_study.py)."""
    min_blocks: int = 2
    """Blocks (episodes, where there are several) that must each be above ``score_max``."""
    block_s: float = 5.0
    """Length [s] of a block that counts as independent."""
    short_block_s: float = 0.8
    """The same where there are fewer than ``few_episodes`` episodes."""
    few_episodes: int = 3
    """See ``short_block_s``."""
    max_error: float = 100.0
    """Errors are clipped here [noise floors]."""
    screened_windows: int = 60
    """Windows on which candidates are screened."""
    max_single_fits: int = 8
    """Candidates that are fitted by themselves."""
    max_additional_fits: int = 4
    """Effects that are fitted in addition to all numbers."""
    max_tested: int = 6
    """Fitted candidates that are tested on windows that they were not fitted to."""
    fit_iterations: int = 6
    """Iterations of a fit."""
    half_fit_iterations: int = 4
    """Iterations of a fit to half of the windows, which begins where the whole fit ended."""
    used_steps: int = 6
    """Steps of a window at which errors count in a fit."""
    single_cause_share: float = 0.8
    """If one cause explains this share of the excess, the numbers are not refitted."""
    min_share: float = 0.1
    """Least share of the excess that a cause explains."""
    min_additional_share: float = 0.25
    """Least share that an effect explains of what refitted numbers leave."""
    min_additional_z: float = 2.0
    """Least gain of such an effect [standard errors]."""
    max_unseen_error: float = 25.0
    """Whitened errors on windows that were not fitted are clipped here [standard deviations]."""
    tie_z: float = 2.0
    """Causes whose losses differ by less [standard errors] from the first are indistinguishable from it."""
    max_causes: int = 3
    """Causes, and numbers of a refit, that are reported."""
    condition_ratio_min: float = 1.5
    """Errors must be so much larger in a condition than outside it."""
    condition_windows_min: int = 4
    """Least windows in a condition and outside it."""
    condition_z_min: float = 2.5
    """Least difference of the squared errors [standard errors]."""
    max_conditions: int = 3
    """Conditions that are reported."""
    place_radius_m: float = 0.5
    """Radius [m] of a place."""
    place_spacing_m: float = 0.5
    """Distance [m] between places."""


@dataclass(frozen=True, slots=True)
class ReportSettings:
    """What the report shows."""

    score_above_noise: float = 1.5
    """A verdict without missing physics warns if the score (noise floors) is above this."""
    max_traces: int = 3
    """Held-out recordings that are drawn."""
    max_correlations: int = 3
    """Effects whose cross-correlation is drawn."""
    max_candidates: int = 12
    """Candidates in the table of what else was considered."""
    max_picture_names: int = 5
    """Effects in the title of summary.png."""
    correlation_step_s: float = 0.2
    """Time [s] after which the residual of a window is correlated with commands."""
    correlation_z: float = 2.58
    """Quantile of the normal distribution for the 99 % bound of a correlation."""
    worst_stretches: int = 3
    """Stretches of a recording that are marked as worst."""


@dataclass(frozen=True, slots=True)
class DiagnosisSettings:
    """All settings of a diagnosis, by stage."""

    windows: WindowSettings = field(default_factory=WindowSettings)
    identification: IdentificationSettings = field(default_factory=IdentificationSettings)
    screening: ScreeningSettings = field(default_factory=ScreeningSettings)
    selection: SelectionSettings = field(default_factory=SelectionSettings)
    rivals: RivalSettings = field(default_factory=RivalSettings)
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)
    unexplained: UnexplainedSettings = field(default_factory=UnexplainedSettings)
    quick: QuickSettings = field(default_factory=QuickSettings)
    report: ReportSettings = field(default_factory=ReportSettings)


DEFAULT = DiagnosisSettings()
"""The settings of ``carlab diagnose`` and of the proof."""
