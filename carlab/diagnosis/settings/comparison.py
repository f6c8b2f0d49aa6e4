"""Settings of the comparison of two groups of recordings."""

from __future__ import annotations

from dataclasses import dataclass

MODEL_ERROR_SHARE = 0.1
"""Standard deviation of a size due to the error of the model, as a share of the size: a wrong model predicts the
influence of a change with a relative error, about 0.1 for sizes of correctly named changes of a real car."""


@dataclass(frozen=True, slots=True)
class ComparisonSettings:
    """Windows, noise of the prediction errors, significance, and the set of changes."""

    block_s: float = 5.0
    """Length [s] of blocks that count as independent: errors of a wrong model depend on the place and the manoeuvre."""
    min_blocks: int = 10
    """Minimum number of blocks of a group; fewer give no usable standard error."""
    min_effective_blocks: float = 5.0
    """Minimum effective number of blocks of a group in which a candidate acts; the standard error of a candidate that
    acts in fewer, such as a small patch of low friction, is unknown."""
    max_windows: tuple[int, int] = (300, 150)
    """Maximum number of windows of the first and the second group, thinned evenly; bounds the time."""
    max_point_windows: int = 80
    """Maximum number of windows that the sizes of the candidates' points are chosen on."""
    max_points: int = 8
    """Maximum number of points of a candidate."""
    error_rms_changes: tuple[float, ...] = (0.3, 1.5)
    """Root mean square changes of the whitened errors at the points of a candidate."""
    typical_size_ratios: tuple[float, ...] = (0.4, 1.2, 3.0)
    """Shares of the typical size at the points of a candidate with an infinite identity value."""
    max_secant: float = 50.0
    """Changes of whitened errors are clipped here [standard deviations]."""
    student_dof: float = 5.0
    """Degrees of freedom of the errors' multivariate Student-t distribution."""
    ridge_shares: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
    """Shares of the diagonal that may be added to the errors' covariance; cross-validation chooses one."""
    ridge_variance: float = 0.01
    """Added to the diagonal of the errors' covariance [squared floors]."""
    min_parts: int = 4
    """Minimum number of parts of the first group, if they have ``min_part_blocks`` blocks."""
    min_part_blocks: int = 4
    """Minimum length of a part of a drive, in blocks."""
    min_part_share: float = 0.02
    """Minimum share of the information of a group that a part must have to count in the spread between parts."""
    max_prior_ratio: float = 3.0
    """Maximum ratio of the degrees of freedom of the spread of all candidates to those of one candidate."""
    error_folds: int = 5
    """Number of folds of whole parts whose errors are decorrelated by the covariance of the other folds."""
    weight_iterations: int = 3
    """Updates of the Student-t weights in a linear estimate."""
    max_start_step: float = 3.0
    """Maximum step along a secant at which a fit starts; a larger linear estimate is cut to it."""
    max_refined: int = 5
    """Maximum number of candidates that are fitted after the linear estimate."""
    iterations: int = 6
    """Maximum number of iterations of a fit."""
    tolerance: float = 1e-3
    """Relative fall of the loss at which a fit ends."""
    p_max: float = 0.05
    """Maximum p-value of a change, multiplied by the number of candidates (Bonferroni)."""
    null_draws: int = 99
    """Maximum number of comparisons within the first group; a change must have a smaller p-value than each of them."""
    min_share_of_first: float = 0.15
    """Minimum likelihood ratio of a further change, as a share of that of the first: a weak one imitates the first."""
    max_changes: int = 3
    """Maximum number of changes."""
    model_error_share: float = MODEL_ERROR_SHARE
    """Standard deviation of a change due to the error of the model, as a share of the change."""
    tie_z: float = 2.0
    """Two candidates are indistinguishable if their losses on the second group differ by less [standard errors]."""
    period_ratio_max: float = 1.2
    """Maximum ratio of the recording periods of one car."""
