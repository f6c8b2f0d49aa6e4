"""Settings of the evidence, the verdict and the unexplained residual."""

from __future__ import annotations

from dataclasses import dataclass

from carlab.diagnosis.settings.comparison import MODEL_ERROR_SHARE


@dataclass(frozen=True, slots=True)
class EvidenceSettings:
    """Intervals, confidence, the verdict."""

    parameter_z_min: float = 4.0
    """First condition of the verdict "parameters": minimum gain of the refit [standard errors]."""
    parameter_gain_share: float = 0.05
    """Second condition: minimum gain of the refit, as a share of the nominal loss."""
    parameter_score_ratio: float = 0.98
    """Third condition: maximum held-out score of the refit, as a share of the nominal score."""
    interval_probability: float = 0.9
    """Nominal probability of an interval."""
    interval_factor: float = 1.25
    """Factor on standard errors by blocks, because errors of neighbouring blocks are dependent too."""
    model_interval_factor: float = 1.75
    """The same where the error of the model is much larger than the noise: it depends on the drive and the place
    (docs/decisions/0037)."""
    min_relative_std: float = 0.01
    """Minimum standard deviation of a number as a share of its value: allows for model error."""
    joint_interval_factor: float = 1.5
    joint_min_relative_std: float = 0.002
    """The same for joint fits of parameters and initial states, whose errors are a third as large
    (docs/decisions/0023)."""
    model_error_share: float = MODEL_ERROR_SHARE
    """Standard deviation of an effect's number due to the error of the model, as a share of its distance from the
    identity or from the car file, as far as the held-out error exceeds the noise."""
    identity_distance_min: float = 1.6449
    """An effect is withdrawn if its numbers in a joint fit differ from their identities, or from those of the car file,
    by less than this many standard deviations (Mahalanobis distance, without ``joint_interval_factor``). An infinite
    identity has no distance."""
    range_ratio_min: float = 1.0
    """An effect with an infinite identity (a limit) is withdrawn if the end of its number's range, divided by the upper
    end of the 90 % interval, is not above this: then the limit may as well be absent."""
    unexplained_score_min: float = 1.2
    """Refit score (noise floors) above which unnamed terms count as missing physics."""
    unexplained_score_min_without_term: float = 1.8
    """The same if no unnamed term is significant."""
    unexplained_score_min_of_slow_poses: float = 1.8
    """The same if velocities are estimated from poses that are too far apart (fault ``slow_poses``): the simulator of
    the car itself has up to 1.8 noise floors then."""
    confidence_half: float = 8.0
    """Square root of chi2 at which half of the effects are correct, by logistic regression on development cases."""
    confidence_slope: float = 5.0
    """Slope of that regression in the logarithm of the root."""
    min_explained_excess: float = 0.05
    """Squared excess of the refit below which the unexplained share is 0."""
    unexplained_share_min: float = 0.1
    """Minimum unexplained share of the squared excess that is reported."""
    skill_windows_min: int = 8
    """Minimum number of held-out windows of a regime that is compared with constant velocity."""
    skill_z_min: float = 2.0
    """Constant velocity is better if its position error is lower by this many standard errors."""
    steady_share: float = 0.1
    """Velocities hardly change if constant velocity errs by less than this share of the travelled distance."""


@dataclass(frozen=True, slots=True)
class UnexplainedSettings:
    """Unnamed terms, the worst regime, and vibration."""

    max_terms: int = 3
    """Maximum number of terms of the formula."""
    term_chi2_min: float = 28.0
    """Minimum chi2 of a term; 121 terms are compared on each of five channels."""
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
    """Minimum power of a line over the mean power; recordings without vibration stay below 3.2."""
    vibration_p_max: float = 1e-15
    """Maximum p-value of that power; matters for short recordings."""
    vibration_block_s: float = 4.0
    """Length [s] of blocks whose power spectra are added."""
    vibration_speed_min_mps: float = 0.3
    """Minimum mean speed [m/s] of a block."""
    vibration_max_z: float = 4.0
    """Residuals are clipped here [robust standard deviations]."""
