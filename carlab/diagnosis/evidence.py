"""Evidence for the accepted effects on held-out windows: strength, location, intervals, confidence, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from carlab.core.quantities import STATE_NAMES, FloatArray
from carlab.diagnosis.explained import explained_shares
from carlab.diagnosis.findings import (
    SLOW_POSES,
    DataFault,
    EffectFinding,
    ErrorLocation,
    Estimate,
    Evidence,
    Verdict,
)
from carlab.diagnosis.identification.block_jackknife import clustered_gain, interval_quantile
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.identification.fit_parameters import FitParameter, stated_values
from carlab.diagnosis.identification.held_out_errors import HeldOut
from carlab.diagnosis.identification.joint_fit import joint_fit
from carlab.diagnosis.selection.problem import SearchProblem, SearchResult
from carlab.diagnosis.selection.refit import refit
from carlab.diagnosis.settings import EVIDENCE
from carlab.diagnosis.unexplained.description import start_features, worst_regime
from carlab.prediction.errors import simulation_errors
from sim_backends.effects import EFFECTS
from sim_backends.registry import REGISTRY


@dataclass(frozen=True, slots=True)
class ScoredSearch:
    """A search with the held-out errors of its models.

    fit      fit with the accepted effects, with covariance
    errors   held-out errors (S, 6) of the models nominal, refit and with_effects, in SI units
    is_joint whether initial states were fitted together with the parameters of ``fit``
    excess   share of the error with effects that is not noise, ``sqrt(1 - 1 / score^2)``; 0 in a joint fit
    """

    problem: SearchProblem
    found: SearchResult
    held_out: HeldOut
    fit: Fit
    errors: Mapping[str, FloatArray]
    is_joint: bool = False
    excess: float = 0.0

    @classmethod
    def of(cls, problem: SearchProblem, found: SearchResult, held_out: HeldOut) -> ScoredSearch:
        """Refine the fits of a search, and predict the held-out windows with each model."""
        found, is_joint = _refined(problem, found)
        errors_of = {
            "nominal": held_out.final_error(problem.nominal),
            "refit": held_out.final_error(found.base.config),
            "with_effects": held_out.final_error(found.best.config),
        }
        fit = found.best if is_joint else problem.fitter(found.scale).with_covariance(found.best)
        score = held_out.score(errors_of["with_effects"])
        excess = 0.0 if is_joint else math.sqrt(max(1.0 - 1.0 / max(score, 1.0) ** 2, 0.0))
        return cls(problem, found, held_out, fit, errors_of, is_joint, excess)

    def scores(self) -> dict[str, float]:
        """Held-out score of each model, in noise floors."""
        return {name: self.held_out.score(error) for name, error in self.errors.items()}


def _refined(problem: SearchProblem, found: SearchResult) -> tuple[SearchResult, bool]:
    """The search with joint fits of parameters and initial states, and whether that with all effects is one.

    A fit whose errors exceed the noise stays as it is.
    """
    fitter = problem.fitter(found.scale)
    best = joint_fit(fitter, found.best, problem.measured_std)
    base = best if found.base is found.best else joint_fit(fitter, found.base, problem.measured_std)
    history = tuple((name, best or fit if fit is found.best else fit) for name, fit in found.history)
    refined = replace(found, base=base or found.base, best=best or found.best, history=history)
    return refined, best is not None


def effect_findings(
    scored: ScoredSearch, covers_catalogue: bool = True, progress: Callable[[float], None] = lambda share: None
) -> tuple[EffectFinding, ...]:
    """Each accepted effect with its evidence, the strongest first; without its sentence and drive.

    If the search ``covers_catalogue``, what the effects leave unexplained is physics that names may imitate.
    """
    if not scored.found.effects:
        return ()
    explained = _explained_share(scored) if covers_catalogue else 1.0
    jacobian = scored.problem.fitter(scored.found.scale).linearised(scored.fit).jacobian
    found = []
    for k, name in enumerate(scored.found.effects):
        progress(k / len(scored.found.effects))
        found.append(_finding(scored, name, jacobian, explained))
    return tuple(found)


def scores_by_step(scored: ScoredSearch) -> tuple[tuple[str, float], ...]:
    """Held-out scores of the nominal simulator, the refit, each step of the search, and the accepted effects."""
    held_out, found, scores = scored.held_out, scored.found, scored.scores()
    steps = [("nominal", scores["nominal"]), ("refit", scores["refit"])]
    for name, fit in found.history:
        steps.append((f"+ {name}", held_out.score(held_out.final_error(fit.config))))
    if found.history and found.history[-1][1] is not found.best:
        steps.append(("accepted effects", scores["with_effects"]))
    return tuple(steps)


def _explained_share(scored: ScoredSearch) -> float:
    """The larger share of the refit's excess that the effects explain, in [0, 1]."""
    shares = explained_shares(scored.problem, scored.found, scored.held_out)
    return min(max(*shares, 0.0), 1.0) if shares is not None else 1.0


def _finding(scored: ScoredSearch, name: str, jacobian: FloatArray, explained: float) -> EffectFinding:
    """An accepted effect.

    ``jacobian`` (n, S, U, 6) is that of the whitened errors at the fit, ``explained`` the share of the excess that all
    effects explain.
    """
    found, held_out, full = scored.found, scored.held_out, scored.errors["with_effects"]
    others = tuple(e for e in found.effects if e != name)
    without = refit(scored.problem, others, scored.fit, found.scale).fit
    fitter = scored.problem.fitter(found.scale)
    without = joint_fit(fitter, without, scored.problem.measured_std) or without
    error = held_out.final_error(without.config)
    gain, spread = held_out.gain(error, full)
    parameters = {p.name: estimate(scored, f"effects.{name}.{p.name}") for p in EFFECTS[name].parameters}
    car_file_values = stated_values(scored.problem.nominal, name)
    others = found.indistinguishable.get(name, ())
    evidence = Evidence(
        held_out_error_reduction=1.0 - held_out.score(full) / max(held_out.score(error), 1e-12),
        standard_errors=gain / spread,
        visibility=visibility(scored.fit, name, jacobian),
        deletion_fingerprint=HeldOut.fingerprint(error, full),
    )
    return EffectFinding(
        id=name,
        confidence=explained * _confidence(scored, name) / (1 + len(others)),
        parameters=parameters,
        where=_where(scored, name, parameters, error, without),
        evidence=evidence,
        sentence="",
        indistinguishable_from=others,
        car_file_values=car_file_values,
    )


def _confidence(scored: ScoredSearch, name: str) -> float:
    """Probability that the name is right if no other physics is missing: a logistic function of the root of chi2."""
    root = math.sqrt(max(scored.found.chi2[name], 1e-3))
    return float(1.0 / (1.0 + (EVIDENCE.confidence_half / root) ** EVIDENCE.confidence_slope))


def _where(
    scored: ScoredSearch, name: str, parameters: Mapping[str, Estimate], error: FloatArray, without: Fit
) -> ErrorLocation:
    """Channels sorted by the fall of their squared score, and regime, lag, time and place of the effect."""
    floor, windows = scored.held_out.floor, scored.problem.windows
    removed = np.mean((error / floor) ** 2, axis=0) - np.mean((scored.errors["with_effects"] / floor) ** 2, axis=0)
    main = removed >= min(0.5 * removed.max(), removed.max())
    channels = tuple(STATE_NAMES[k] for k in np.argsort(-removed) if main[k])
    effect = EFFECTS[name]
    lag = parameters[effect.lag_parameter].value if effect.lag_parameter else None
    place = None
    if effect.disc_parameters:
        x, y, radius = (parameters[p].value for p in effect.disc_parameters)
        place = (x, y, radius)
    time = (0.0, float(windows.t0_s.max())) if "time" in effect.depends_on else None
    final = simulation_errors(windows, without.config)[:, -1]
    size = np.abs(final[:, STATE_NAMES.index(channels[0])])
    return ErrorLocation(channels, worst_regime(start_features(windows), size), lag, time, place)


def estimate(scored: ScoredSearch, name: str) -> Estimate:
    """A fitted number with its 90 % interval."""
    fit = scored.fit
    index = [f.name for f in fit.free].index(name)
    free, z = fit.free[index], float(fit.z[index])
    assert fit.covariance is not None
    z90 = interval_quantile(len(np.unique(scored.problem.windows.block)), EVIDENCE.interval_probability)
    min_relative_std = EVIDENCE.joint_min_relative_std if scored.is_joint else EVIDENCE.min_relative_std
    std_z = standard_error_factor(scored) * math.sqrt(max(float(fit.covariance[index, index]), 0.0))
    low, value, high = (float(free.value(np.array(z + k * std_z))) for k in (-z90, 0.0, z90))
    margin = z90 * math.hypot(min_relative_std * abs(value), _model_error_std(scored, free, value))
    low = max(value - math.hypot(value - min(low, high), margin), free.low)
    high = min(value + math.hypot(max(low, high) - value, margin), free.high)
    at_limit = not free.choice and value in (free.low, free.high)
    return Estimate(value, (high - low) / (2 * z90), low, high, REGISTRY[name].unit, at_limit)


def standard_error_factor(scored: ScoredSearch) -> float:
    """Factor on the standard errors of the fit; it grows with the error of the model."""
    if scored.is_joint:
        return EVIDENCE.joint_interval_factor
    return EVIDENCE.interval_factor + scored.excess * (EVIDENCE.model_interval_factor - EVIDENCE.interval_factor)


def _model_error_std(scored: ScoredSearch, free: FitParameter, value: float) -> float:
    """Standard deviation of an effect's number due to the error of the model; 0 for other parameters.

    It is a share of the distance from the identity (0 if that is infinite) or from the car file, times ``excess``.
    """
    if not free.name.startswith("effects."):
        return 0.0
    reference = 0.0 if free.logarithmic else float(free.value(np.array(0.0)))
    return EVIDENCE.model_error_share * abs(value - reference) * scored.excess


def base_estimates(scored: ScoredSearch) -> dict[str, Estimate]:
    """Base parameters, fitted together with the accepted effects."""
    return {f.name: estimate(scored, f.name) for f in scored.fit.free if not f.name.startswith("effects.")}


def visibility(fit: Fit, effect: str, jacobian: FloatArray) -> float:
    """Share of an effect's influence on the errors that other parameters cannot reproduce, in [0, 1].

    Args:
        fit: the fit with the effect, n parameters.
        effect: its id.
        jacobian: derivatives (n, S, U, 6) of the whitened errors at the fit.
    """
    free = fit.free
    jacobian = jacobian.reshape(len(free), -1)
    own = [k for k, f in enumerate(free) if f.name.startswith(f"effects.{effect}.")]
    other = [k for k in range(len(free)) if k not in own]
    basis, _ = np.linalg.qr(jacobian[other].T)
    columns = jacobian[own]
    projected = columns - (columns @ basis) @ basis.T
    return float(np.linalg.norm(projected) / max(float(np.linalg.norm(columns)), 1e-12))


def verdict_of(scored: ScoredSearch, has_unnamed: bool, data_faults: Sequence[DataFault]) -> Verdict:
    """The verdict; ``has_unnamed``: whether physics outside the catalogue is missing."""
    if any(f.action.startswith("unusable") for f in data_faults):
        return "data"
    if scored.found.effects:
        return "mismatch"
    problem, score = scored.problem, scored.scores()
    best = min(score["refit"], score["nominal"])  # with few recordings a refit may be worse than the car file
    min_score = EVIDENCE.unexplained_score_min if has_unnamed else EVIDENCE.unexplained_score_min_without_term
    if any(f.id == SLOW_POSES for f in data_faults):
        min_score = max(min_score, EVIDENCE.unexplained_score_min_of_slow_poses)
    if best > min_score:
        return "unexplained"
    nominal_loss = problem.fitter(scored.found.scale).loss(problem.nominal)
    gain, spread = clustered_gain(nominal_loss, scored.found.base.loss, problem.windows)
    is_significant = gain / spread > EVIDENCE.parameter_z_min
    is_large = gain > EVIDENCE.parameter_gain_share * float(nominal_loss.sum())
    lowers_score = score["refit"] < EVIDENCE.parameter_score_ratio * score["nominal"]
    return "parameters" if is_significant and is_large and lowers_score else "none"


def unexplained_share(scored: ScoredSearch, described: Fit | None = None) -> float:
    """Share of the refit's squared excess that remains with the accepted effects, or with the fit ``described``."""
    score = scored.scores()
    excess = score["refit"] ** 2 - 1.0
    if excess <= EVIDENCE.min_explained_excess:
        return 0.0
    held_out = scored.held_out
    remaining = score["with_effects"] if described is None else held_out.score(held_out.final_error(described.config))
    return max(remaining**2 - 1.0, 0.0) / excess
