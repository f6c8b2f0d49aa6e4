"""Correction of the simulator prior between episodes: effects and parameters are added or removed by their evidence.

The prior is the car file's simulator with corrections. After each episode the corrections are tested on the newest
episode, which none of them was fitted to. If the quick check finds that the prior does not explain the recordings, its
first cause enters, provided that it explains enough of the error on windows that were not fitted. Every few episodes a
diagnosis of the whole run replaces all corrections by the effects and parameters that hold on its held-out episodes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from carlab.core.errors import ConfigError
from carlab.core.state_estimator import StateEstimator
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import EFFECTS, ActuatorEffect
from sim_backends.registry import REGISTRY

PARAMETERS = "parameters"
"""Id of a correction of parameters of the car file."""
MAX_SHOWN = 4
"""Maximum number of numbers in a message."""
MIN_HISTORY, MAX_HISTORY = 3, 8
LARGEST_GIVEN_HISTORY = 100
"""Largest number of past commands of a file; a user may ask for more than ``MAX_HISTORY``."""
MIN_ENTRY_SHARE = 0.3
"""Minimum share of the excess loss on held-out windows that a cause of the quick check explains."""
MIN_STD_SHARE = 0.2
"""Minimum standard deviation of a number of the quick check, relative to its change: one cause is fitted alone."""


@dataclass(frozen=True, slots=True)
class Correction:
    """A difference between the prior and the car file's simulator.

    Attributes:
        id: an effect of the catalogue, or ``PARAMETERS``.
        values: numbers by dotted name.
        std: standard deviations of some of these numbers.
        episodes: number of recordings that it was fitted to.
        source: "quick check" or "diagnosis".
        evidence: a clause with the evidence.
    """

    id: str
    values: Mapping[str, float]
    std: Mapping[str, float]
    episodes: int
    source: str
    evidence: str = ""

    def text(self) -> str:
        """Name and numbers."""
        is_effect = self.id != PARAMETERS
        numbers = [
            f"{name.rsplit('.', 1)[1] if is_effect else name} {value:.3g} {REGISTRY[name].unit}".removesuffix(" 1")
            for name, value in self.values.items()
            if not REGISTRY[name].choices
        ]
        shown = ", ".join(numbers[:MAX_SHOWN]) + (" ..." if len(numbers) > MAX_SHOWN else "")
        return f"{self.id if is_effect else 'a change of parameters'} ({shown})"


@dataclass(frozen=True, slots=True)
class PriorVersion:
    """The corrections of the prior after an episode.

    Attributes:
        corrections: all corrections.
        history: number of past commands that model and policy observe.
        sentence: what changed after the episode, and why.
        diagnosed: number of recordings of the last diagnosis; 0 before the first.
    """

    corrections: tuple[Correction, ...] = ()
    history: int = MIN_HISTORY
    sentence: str = ""
    diagnosed: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Values for a JSON file."""
        return asdict(self)

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> PriorVersion:
        """Read the output of ``to_dict``. Raises KeyError, TypeError or ValueError for other content."""
        corrections = tuple(
            Correction(
                str(c["id"]), {str(k): float(v) for k, v in c["values"].items()},
                {str(k): float(v) for k, v in c["std"].items()}, int(c["episodes"]), str(c["source"]),
                str(c["evidence"]),
            )
            for c in content["corrections"]
        )  # fmt: skip
        if unknown := {name for c in corrections for name in (*c.values, *c.std)} - REGISTRY.keys():
            raise ValueError(f"unknown number {min(unknown)!r}")
        for c in corrections:
            problems = [problem for name, value in c.values.items() if (problem := REGISTRY[name].problem(value))]
            problems += [f"std of {name} is {std:g}" for name, std in c.std.items() if not 0.0 < std < math.inf]
            if problems:
                raise ValueError(problems[0])
        history = int(content["history"])
        if not 0 <= history <= LARGEST_GIVEN_HISTORY:
            raise ValueError(f"history is {history}")
        return cls(corrections, history, str(content["sentence"]), int(content["diagnosed"]))


@dataclass(frozen=True, slots=True)
class Findings:
    """What is known after an episode.

    Attributes:
        episodes: number of recordings.
        check: content of the file of the quick check against the current prior.
        contradicted: ids of corrections without which the newest episode is predicted better.
        diagnosed: corrections that a diagnosis supports; None without a diagnosis or a verdict.
        diagnosis: verdict of the diagnosis; empty without one.
        is_complete: whether the search of the diagnosis was complete.
    """

    episodes: int
    check: Mapping[str, Any] = field(default_factory=dict)
    contradicted: tuple[str, ...] = ()
    diagnosed: tuple[Correction, ...] | None = None
    diagnosis: str = ""
    is_complete: bool = True


def corrected(car: SimulatorConfig, corrections: Sequence[Correction]) -> SimulatorConfig:
    """The prior: the car file's simulator with corrections.

    A corrected number has its standard deviation in place of the range of the car file.
    """
    values = {name: value for c in corrections for name, value in c.values.items()}
    std = {name: s for c in corrections for name, s in c.std.items()}
    priors = {name: limits for name, limits in car.priors.items() if name not in values}
    return replace(replace(car, priors=priors).with_values(values), parameter_std={**car.parameter_std, **std})


def without_ranges(simulator: SimulatorConfig) -> SimulatorConfig:
    """The simulator without the ranges of the car file, which the recordings may contradict."""
    return replace(simulator, priors={})


def needed_history(simulator: SimulatorConfig) -> int:
    """Number of past commands that affect the next measured state, from three to eight.

    It covers the delays and lags of the commands, the latency of motion capture and the window of the velocities.
    """
    lags_s = [
        given[EFFECTS[name].lag_parameter]
        for name, given in simulator.effects.items()
        if isinstance(EFFECTS[name], ActuatorEffect) and EFFECTS[name].lag_parameter
    ]
    span_s = max(simulator.delays_s()) + max(lags_s, default=0.0)
    span_s += simulator.values()["mocap.latency"] + StateEstimator().window_s
    return min(max(round(span_s / simulator.control_period_s), MIN_HISTORY), MAX_HISTORY)


def next_version(before: PriorVersion, car: SimulatorConfig, found: Findings) -> PriorVersion:
    """The next version of the prior, with the sentence that states what changed and why."""
    if found.diagnosed is not None:
        after, why = _by_diagnosis(before, found)
    else:
        after, why = _by_check(before, car, found)
    try:
        history = max(before.history, needed_history(corrected(car, after)))
    except ConfigError as error:  # numbers that do not go together
        return replace(before, sentence=f"The prior is unchanged: its correction is impossible ({error}).")
    if history > before.history:
        why.append(f"model and policy observe {history} past commands instead of {before.history}")
    diagnosed = found.episodes if found.diagnosis else before.diagnosed
    return PriorVersion(after, history, _sentence(why, found), diagnosed)


def _by_diagnosis(before: PriorVersion, found: Findings) -> tuple[tuple[Correction, ...], list[str]]:
    assert found.diagnosed is not None
    after = list(found.diagnosed)
    why = [f"{c.text()} is added ({c.evidence})" for c in after if c.id not in _ids(before.corrections)]
    for c in before.corrections:
        if c.id in _ids(after):
            continue
        if found.is_complete or c.id in found.contradicted:
            why.append(f"{c.id} is removed (the diagnosis of {found.episodes} episodes does not confirm it)")
        else:
            after.append(c)  # A search that was cut short refutes nothing.
    if not why:
        why = [f"the diagnosis of {found.episodes} episodes confirms {', '.join(c.id for c in after)}"] if after else []
    return tuple(after), why


def _by_check(before: PriorVersion, car: SimulatorConfig, found: Findings) -> tuple[tuple[Correction, ...], list[str]]:
    after = [c for c in before.corrections if c.id not in found.contradicted]
    why = [
        f"{c.id} is removed (episode {found.episodes} is predicted better without it)"
        for c in before.corrections
        if c.id in found.contradicted
    ]
    entry = None if why else _entry(found)
    if entry is not None:
        replaced = [c for c in after if c.id == entry.id]
        merged = {**(replaced[0].values if replaced else {}), **entry.values}
        std = {**(replaced[0].std if replaced else {}), **entry.std}
        after = [c for c in after if c.id != entry.id] + [replace(entry, values=merged, std=std)]
        why.append(f"{entry.text()} {'changes' if replaced else 'is added'} ({entry.evidence})")
    return tuple(after), why


def _entry(found: Findings) -> Correction | None:
    """The most likely usable cause of the quick check as a correction; None if the prior explains the recordings."""
    causes = found.check.get("causes") or ()
    likely = [c for k, c in enumerate(causes) if k == 0 or c["like_the_first"]]
    usable = [c for c in likely if _is_usable(c)]
    if found.check.get("verdict") != "left" or not usable:
        return None
    cause = usable[0]
    values = {name: float(p["value"]) for name, p in cause["parameters"].items()}
    std = {}
    for name, p in cause["parameters"].items():
        first, second = p["halves"]
        info = REGISTRY[name]
        start = next(x for x in (p["before"], info.default, 0.0) if x is not None and math.isfinite(x))
        spread = max(abs(first - second), MIN_STD_SHARE * abs(values[name] - start))
        if spread > 0.0 and not info.choices:
            std[name] = spread
    name = str(cause["id"]).removeprefix("effects.")
    share = f"it explains {100.0 * cause['share']:.0f} % of the excess loss on held-out windows"
    return Correction(name if name in EFFECTS else PARAMETERS, values, std, found.episodes, "quick check", share)


def _is_usable(cause: Mapping[str, Any]) -> bool:
    """Whether a cause explains enough, and the prior can represent it: a row of the model has no place and no time."""
    effect = EFFECTS.get(str(cause["id"]).removeprefix("effects."))
    is_representable = effect is None or not effect.depends_on
    return bool(cause["share"] >= MIN_ENTRY_SHARE and cause["parameters"] and is_representable)


def _sentence(why: Sequence[str], found: Findings) -> str:
    if why:
        return f"The prior changes after episode {found.episodes}: {'; '.join(why)}."
    verdict = found.check.get("verdict")
    reason = {
        "explains": "it explains the recordings",
        "left": "no cause of its errors is certain enough",
    }.get(str(verdict), "the recordings are not sufficient to change it")
    return f"The prior is unchanged after episode {found.episodes}: {reason}."


def _ids(corrections: Sequence[Correction]) -> set[str]:
    return {c.id for c in corrections}
