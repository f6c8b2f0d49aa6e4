"""Settings of the comparison of two groups of recordings."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ComparisonSettings:
    """Fits of candidates in each group, significance, and the set of changes."""

    block_s: float = 5.0
    """Length [s] of blocks that count as independent: errors of a wrong model depend on the place and the manoeuvre."""
    min_blocks: int = 10
    """Minimum number of blocks of a group; fewer give no usable standard error."""
    max_windows: int = 250
    """Maximum number of windows of a group, thinned evenly; bounds the time."""
    iterations: int = 6
    """Maximum number of iterations of a candidate's fit in one group."""
    p_max: float = 0.01
    """Maximum p-value of a change, multiplied by the number of candidates (Bonferroni)."""
    min_unseen_share: float = 0.01
    """Minimum fall of the loss on unseen blocks by a change, as a share of the loss."""
    min_unseen_z: float = 3.0
    """Minimum of that fall [standard errors]: the halves of a real drive differ by up to two without a change."""
    min_share_of_first: float = 0.1
    """Minimum fall of the loss by a further change, as a share of that by the first: a weak one imitates the first."""
    max_changes: int = 3
    """Maximum number of changes."""
    tie_z: float = 2.0
    """Two candidates are indistinguishable if their losses on unseen blocks differ by less [standard errors]."""
    period_ratio_max: float = 1.2
    """Maximum ratio of the recording periods of one car."""
