"""Settings of the search for effects."""

from __future__ import annotations

from dataclasses import dataclass


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
    probe_sizes: tuple[float, ...] = (0.03, 0.3, 3.0)
    """Sizes [typical sizes] at which the change of the errors is simulated, to find the size of a wanted change. More
    than one, because some effects grow with the square of their parameter."""
    probe_exponents: tuple[float, float] = (0.3, 3.0)
    """Bounds of the exponent with which the change of the errors grows with the size, beyond the probes."""
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
    """Joint refits, tests on left-out blocks, acceptance, moves, elimination and pairwise tests."""

    max_refits: int = 10
    """Maximum number of candidates, by screening score, that are refitted together with the base parameters."""
    confusable_leaders: int = 3
    """Number of leading candidates whose confusable effects are refitted as well."""
    folds: int = 6
    """Number of folds of blocks for the test on left-out blocks."""
    min_score_share: float = 0.1
    """A candidate is refitted if its screening score is at least this share of the best."""
    min_score_chi2: float = 8.0
    """A candidate is refitted if twice its score over the design effect is at least this."""
    first_gain_iterations: int = 1
    """Number of iterations of a candidate's fit after which gains are compared for the first time. One iteration has
    92 % of the final gain (median of 348 fits, docs/decisions/0045)."""
    min_first_gain_share: float = 0.5
    """A candidate waits if its gain after these iterations is less than this share of the best, unless it is confusable
    with the best one or the model has no effect. It is fitted further only if no other is accepted."""
    min_gain_share: float = 0.3
    """A refitted candidate is tested on left-out blocks if its gain is at least this share of the best."""
    max_left_out_error: float = 12.0
    """Whitened errors on left-out blocks are clipped here [standard deviations], to limit the influence of one spin."""
    accept_chi2_min: float = 25.0
    """Minimum chi2 (twice the gain over the design effect) of an accepted effect with one parameter; well above the
    usual limit of one test, because all candidates of the catalogue are compared."""
    accept_chi2_per_number: float = 8.0
    """Additional chi2 per additional parameter and for an infinite identity value."""
    accept_left_out_share: float = 0.015
    """Minimum gain on left-out blocks of an accepted effect, as a share of the loss of a perfect simulator."""
    accept_left_out_ratio: float = 0.3
    """Minimum gain on left-out blocks of an accepted effect, as a share of its gain on the fitted blocks."""
    steady_z_min: float = 3.0
    """Alternative: minimum gain on left-out blocks [standard errors] together with ``steady_left_out_share``."""
    steady_left_out_share: float = 0.03
    """Alternative: minimum gain on left-out blocks, as a share of the loss of a perfect simulator."""
    simpler_z_max: float = 1.0
    """A candidate that is confusable with the best one and has fewer numbers is accepted in its place if its loss on
    left-out blocks is higher by less than this [standard errors]."""
    keep_chi2_min: float = 16.0
    """Minimum chi2 of an earlier effect after others were added, and minimum chi2 of a swap; a swap to an effect with
    more numbers also needs ``accept_chi2_per_number`` for each of them."""
    swap_score_share: float = 0.7
    """A confusable effect may replace an effect if its screening score is at least this share of the effect's gain."""
    search_time_share: float = 0.6
    """Share of ``--budget`` for the search; the rest is for eliminations, pairwise tests and the report."""
    max_effects: int = 12
    """Maximum number of effects."""
    min_remaining_excess: float = 0.1
    """Other choices are followed if the effects of the greedy path leave this share of the refit's squared excess."""
    min_effects_for_alternatives: int = 3
    """Minimum number of effects of the greedy path, so that other choices are followed. With one or two effects, they
    cost time and seldom change a name."""
    max_alternatives: int = 3
    """Maximum number of other choices that are followed to their end."""
    same_loss_share: float = 1e-3
    """Two choices are equal if their losses differ by at most this share, summed over left-out windows: fits end at a
    finite distance from their minimum."""
    scale_change_max: float = 0.03
    """Relative change of the error scale at convergence."""
    scale_iterations: int = 4
    """Maximum number of refits until the error scale converges."""
    start_iterations: int = 3
    """Number of iterations by which the initial points of a candidate are compared."""
    max_start_windows: int = 180
    """Number of windows on which initial points are compared, as many as for screening; bounds the time. Fits from the
    best point use all windows."""
    limit_start_ratios: tuple[float, ...] = (1.0, 1.7, 3.0)
    """Initial values of an effect's only limit, over that of the best screening point [1]."""
    keep_z_min: float = 1.2
    """One of several effects is removed if its removal costs this or less on left-out blocks [standard errors]."""
    supported_z_min: float = 1.6449
    """Minimum rise of the loss on left-out blocks without a requested effect, with decorrelated errors [standard
    errors]: a one-sided test at 5 % (docs/decisions/0036)."""
    error_ridge_share: float = 0.1
    """Added to the diagonal of the errors' covariance, as a share of it; a few hundred dependent windows do not
    determine the covariance of 36 errors."""
    min_model_error: float = 1.0
    """Squared excess of the robust errors over the noise floor from which errors count as those of the model."""
    min_practical_size: float = 0.2
    """Minimum size of an effect: the change of a channel at the end of the fitted windows by its removal and a refit,
    over the error that remains [noise floors, or robust errors of the simulator where these are larger]. A smaller
    effect lowers the root mean square error of no channel by more than 2 %. A concealed effect of the proof changes
    the score by at least 0.5 noise floors."""
    min_held_out_rise: float = 0.0
    """Minimum relative rise of the held-out score without an effect."""
    min_held_out_z: float = 0.0
    """Alternative: minimum fall of the held-out log-likelihood without the effect [standard errors]. The score gives
    much weight to single windows, for example in a spin; the robust likelihood does not. An effect that neither of the
    two supports is removed."""
    tie_z: float = 2.0
    """Another path replaces the greedy path if its loss on left-out blocks is lower by this [standard errors]."""
    indistinguishable_z: float = 3.0
    """Two confusable effects are indistinguishable if their losses on left-out blocks, with free initial states, differ
    by less [standard errors]."""
    replace_z_min: float = 1.0
    """A confusable effect replaces an effect if its loss on left-out blocks, with free initial states, is lower by this
    [standard errors]."""
    split_z_min: float = 2.0
    """An effect of each command replaces one effect of both commands if the loss on left-out blocks, with free initial
    states, is lower by this [standard errors], and if the gain is that of a further effect (``accept_chi2_min``)."""
    max_indistinguishable: int = 2
    """Maximum number of effects in ``indistinguishable_from`` of report.json."""


@dataclass(frozen=True, slots=True)
class RestartSettings:
    """Restarts of a fit from perturbed parameters."""

    count: int = 5
    """Number of perturbed starts. On train_1 of the ETH car, five of six end at a lower cost than the fit without."""
    width: float = 0.3
    """Standard deviation of the perturbation, over that of the prior (effects: over their typical sizes)."""
    seed: int = 0
    """Seed of the perturbations."""
    iterations: int = 8
    """Number of iterations after which the costs are compared; 20 give the same minimum."""
    min_effects: int = 4
    """Number of effects from which a model is restarted; on train_1 fits with fewer ended at one minimum."""
    max_failed: int = 2
    """Number of successive restarts without a lower cost after which a path is restarted no more; each takes about a
    quarter of the time of a step."""
    min_fall_share: float = 0.01
    """Minimum relative fall of the cost; smaller ones are differences between fits that end near one minimum."""
    min_model_error: float = 1.0
    """Squared excess of the robust errors over the noise floor from which a model is restarted."""


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
    """Effects are spurious if unnamed physics gains more than this share of the total gain."""
    spurious_share_of_most: float = 0.25
    """The same for effects that explain ``min_explained_share_of_most``. It is larger, because unnamed physics
    also gains where the form of a true effect differs from that of the catalogue, but less than with a spurious
    name."""
    min_explained_share_of_most: float = 0.85
    """Share of the refit's excess, in the loss with free initial states, from which ``spurious_share_of_most`` applies.
    On development cases true effects explain more, and effects that imitate other physics less
    (docs/decisions/0019)."""
    spurious_share_many: float = 0.3
    """The same for ``many_effects`` effects or more: such a car may also have physics outside the catalogue."""
    many_effects: int = 3
    """Number of effects from which ``spurious_share_many`` applies, and limits for one or two effects do not."""
    min_unnamed_share: float = 0.04
    """Minimum gain of unnamed physics that makes effects spurious, as a share of a perfect simulator's loss."""
    unnamed_ratio: float = 1.15
    """One or two effects are spurious if unnamed terms gain this many times the gain of the effects."""
    min_explained_share: float = 0.5
    """Minimum share of the refit's excess that one or two effects explain: of the loss with free initial states, or of
    the held-out squared score. On development cases true effects explain more than half, spurious names less."""
    curve_z_min: float = 2.0
    """A measured curve of a command replaces named effects that it contains if its loss on left-out blocks, with free
    initial states, is lower by this [standard errors], and by ``min_curve_share`` (docs/decisions/0019, 0051)."""
    min_curve_share: float = 0.1
    """Minimum of this fall, as a share of the fall from the refit to the curve. A curve that only follows a named
    effect gains almost nothing."""
    min_held_out_excess: float = 0.1
    """Minimum squared excess of the refit for this share; a smaller one is as uncertain as the noise floor."""
    weak_term_chi2: float = 14.0
    """Minimum chi2 of a term that describes a residual that is already significant."""
    vibration_share: float = 0.02
    """Vibration comes first in the description if its lower bound is this share of the squared excess."""
    description_ratio: float = 0.85
    """Uncatalogued physics describes the residual if it gains this share of the gain of unnamed terms."""
