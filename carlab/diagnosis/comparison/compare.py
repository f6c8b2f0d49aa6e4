"""Comparison of two groups of recordings by forward selection of the parameters that differ.

The simulator is fitted to the first group. The change of its errors by each candidate is computed once. A linear
estimate in both groups then gives the likelihood ratio and the significance of each candidate. The best ones are fitted
to the second group. Physics that the simulator lacks is in the errors of both groups, so it cancels in the difference.
A change must also be more significant than any that comparisons within the first group show. A delay of all commands
is no change if a clock offset was repaired, because a repair is accurate to about a row.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from carlab.core.clock import MonotonicClock
from carlab.core.episode_data import EpisodeData
from carlab.core.quantities import FloatArray
from carlab.diagnosis.comparison.candidates import candidate_points, change_candidates, size_of, with_candidate
from carlab.diagnosis.comparison.change_fit import ChangeFit, fit_change
from carlab.diagnosis.comparison.difference import GroupErrors, p_value
from carlab.diagnosis.comparison.drive_spread import longest_drive_blocks, part_blocks
from carlab.diagnosis.comparison.groups import ComparedGroups, compared_groups
from carlab.diagnosis.comparison.linear_change import (
    LinearChange,
    Secants,
    linear_changes,
    null_p_values,
    short_name,
)
from carlab.diagnosis.comparison.result import Change, Comparison, ComparisonVerdict, Tested, verdict_sentence
from carlab.diagnosis.findings import Estimate
from carlab.diagnosis.identification.block_jackknife import clustered_gain
from carlab.diagnosis.identification.fit import Fitter
from carlab.diagnosis.recording_faults.find import hide_delay
from carlab.diagnosis.selection.problem import delays_all_commands
from carlab.diagnosis.settings import COMPARISON
from carlab.diagnosis.state_alignment import naming_lost_frames
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import EFFECTS
from sim_backends.registry import REGISTRY


@dataclass(frozen=True, slots=True)
class _Refined:
    """A candidate fitted to the second group with all changes before it."""

    linear: LinearChange
    fit: ChangeFit
    likelihood_ratio: float
    p_value: float
    offset: FloatArray


def compare(
    reference: Sequence[EpisodeData],
    changed: Sequence[EpisodeData],
    nominal: SimulatorConfig,
    *,
    candidates: Sequence[str] | None = None,
    progress: Callable[[str, float], None] = lambda activity, share: None,
    stop: Callable[[], bool] = lambda: False,
) -> Comparison:
    """Find what changed between two groups of recordings of one car.

    Args:
        reference: recordings of the first group.
        changed: recordings of the second group.
        nominal: the simulator of the car file, best that of a diagnosis; its base parameters are refitted.
        candidates: effects and base parameters that may differ; all by default.
        progress: callback with the activity and the completed share in [0, 1].
        stop: callback; if it returns true, the changes so far are the result.

    Raises:
        DataError: the recordings are too short or too uniform, or have different periods; the message has the remedy.
    """
    began_s = MonotonicClock().now_s()
    progress("fitting the simulator to the first group", 0.0)
    with naming_lost_frames((*reference, *changed)):
        compared = compared_groups(reference, changed, nominal)
    screened = _screen(compared, candidates, progress, stop)
    changes, tested, is_complete = _select(compared, screened, progress, stop)
    if hide_delay(compared.data_faults):
        changes = tuple(c for c in changes if c.id not in EFFECTS or not delays_all_commands(c.id))
    verdict: ComparisonVerdict = "changed" if changes else "nothing" if is_complete else "inconclusive"
    seconds = MonotonicClock().now_s() - began_s
    sentence = verdict_sentence(verdict, changes, is_complete=is_complete)
    return Comparison(verdict, sentence, changes, seconds, tested, is_complete, compared.data_faults)


def _screen(
    compared: ComparedGroups,
    only: Sequence[str] | None,
    progress: Callable[[str, float], None],
    stop: Callable[[], bool],
) -> list[Secants]:
    """Secants of all candidates in both groups."""
    first = compared.fitters[0]
    few = Fitter(first.windows.thinned(COMPARISON.max_point_windows), first.scale)
    candidates = change_candidates(compared.config, only)
    found = []
    for k, candidate in enumerate(candidates):
        if stop():
            break
        progress(f"influence of {candidate.id}", 0.1 + 0.6 * k / len(candidates))
        at = candidate_points(few, compared.config, candidate)
        secants = [at.secants(fitter, errors) for fitter, errors in zip(compared.fitters, compared.errors, strict=True)]
        found.append(Secants(at, compared.decorrelated(secants)))
    return found


def _select(
    compared: ComparedGroups,
    screened: Sequence[Secants],
    progress: Callable[[str, float], None],
    stop: Callable[[], bool],
) -> tuple[tuple[Change, ...], tuple[Tested, ...], bool]:
    """Forward selection, the largest likelihood ratio first; also all tests, and whether no stop ended it."""
    windows = [fitter.windows for fitter in compared.fitters]
    first, second = (
        GroupErrors(errors, w.block, part)
        for errors, w, part in zip(compared.decorrelated(compared.errors), windows, compared.parts, strict=True)
    )
    length_ratio = longest_drive_blocks(windows[1]) / part_blocks(windows)
    model = compared.model
    progress("comparing parts of the first group", 0.7)
    null = null_p_values(screened, first, int(second.part.max()) + 1, model, stop)

    def adjusted(p: float) -> float:
        return 1.0 if len(null) and p >= null[0] else min(1.0, len(screened) * p)

    found: list[_Refined] = []
    ties: list[tuple[str, ...]] = []
    tested: tuple[Tested, ...] = ()
    is_complete = True
    while len(found) < COMPARISON.max_changes and not stop():
        progress(f"change {len(found) + 1}", 0.75 + 0.08 * len(found))
        groups = (first, replace(second, errors=found[-1].fit.errors) if found else second)
        known = list(found[-1].fit.jacobian) if found else []
        taken = {f.linear.secants.at.candidate.id for f in found}
        others = [s for s in screened if s.at.candidate.id not in taken]
        linear = linear_changes(others, groups, model, length_ratio=length_ratio, known=known)
        tested = tested or tuple(x.tested() for x in linear)
        if not any(adjusted(x.p_value) < COMPARISON.p_max for x in linear):
            break
        refined = [_refine(x, found, compared) for x in linear[: COMPARISON.max_refined]]
        significant = [r for r in refined if adjusted(max(r.p_value, r.linear.p_value)) < COMPARISON.p_max]
        best = max(significant, key=lambda r: r.likelihood_ratio, default=None)
        if best is None or (
            found and best.likelihood_ratio < COMPARISON.min_share_of_first * found[0].likelihood_ratio
        ):
            break
        ties.append(_ties(best, refined, compared))
        found.append(best)
    else:
        is_complete = len(found) == COMPARISON.max_changes
    changes = [_change(one, found[-1].fit, near, adjusted(one.p_value)) for one, near in zip(found, ties, strict=True)]
    return tuple(changes), tested, is_complete


def _refine(linear: LinearChange, found: Sequence[_Refined], compared: ComparedGroups) -> _Refined:
    """Fit a candidate to the second group, together with the changes found before."""
    at = linear.secants.at
    before = found[-1] if found else None
    config = with_candidate(before.fit.fitted if before else compared.config, at.candidate)
    free = (*(before.fit.free if before else ()), *at.candidate.free)
    known = before.fit.z if before else np.zeros(0)
    step = min(linear.difference.step, COMPARISON.max_start_step)
    point = at.points[linear.point]
    starts = np.array([np.concatenate([known, z]) for z in (at.z0, at.z0 + step * (point - at.z0), point)])
    offset = linear.difference.common * linear.secants.of_group[1][linear.point]
    offset = offset + (before.offset if before else 0.0)
    fit = fit_change(compared.fitters[1], config, free, starts, compared.model, offset)
    ratio = 2.0 * fit.gain / linear.difference.variance_ratio
    p = p_value(linear.difference, ratio, len(at.z0))
    return _Refined(linear, fit, ratio, p, offset)


def _ties(best: _Refined, refined: Sequence[_Refined], compared: ComparedGroups) -> tuple[str, ...]:
    """Candidates whose loss on the second group is not significantly larger, the closest first, at most two.

    The comparison is that of non-nested models (Vuong 1989), with a standard error clustered by block and multiplied by
    the spread between drives.
    """
    windows, model = compared.fitters[1].windows, compared.model
    loss = model.loss(best.fit.errors)
    near = []
    for other in refined:
        if other is best:
            continue
        difference, error = clustered_gain(model.loss(other.fit.errors), loss, windows)
        if difference < COMPARISON.tie_z * error * math.sqrt(best.linear.difference.spread.ratio):
            near.append((difference, other.linear.secants.at.candidate.id))
    return tuple(name for _, name in sorted(near)[:2])


def _change(one: _Refined, last: ChangeFit, ties: tuple[str, ...], p: float) -> Change:
    """A change with its numbers in the ``last`` fit, which contains all changes."""
    at, found = one.linear.secants.at, one.linear.difference
    names = [f.name for f in last.free]
    index = [names.index(f.name) for f in at.candidate.free]
    z = last.z[index]
    variance = np.diag(last.naive_covariance)[index] * found.design_effect * found.variance_ratio
    std = np.sqrt(variance + (COMPARISON.model_error_share * (z - at.z0)) ** 2)
    quantile = float(stats.t.ppf(0.95, max(min(found.dof - (len(index) - 1), found.spread.dof), 1.0)))
    low, value, high = (size_of(at.candidate, z + side * quantile * std, at.z0) for side in (-1.0, 0.0, 1.0))
    parameters, reference = {}, {}
    for k, f in enumerate(at.candidate.free):
        name = short_name(f.name)
        limits = sorted((float(low[k]), float(high[k])))
        spread = (limits[1] - limits[0]) / (2.0 * quantile)
        parameters[name] = Estimate(float(value[k]), spread, limits[0], limits[1], REGISTRY[f.name].unit)
        reference[name] = float(f.value(np.asarray(at.z0[k])))
    standard_errors = float(np.sqrt(max(one.likelihood_ratio, 0.0) / found.design_effect))
    return Change(at.candidate.id, parameters, reference, p, one.fit.loss_share, standard_errors, ties)
