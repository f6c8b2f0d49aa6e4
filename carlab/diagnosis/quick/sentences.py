"""Two sentences that report a quick check with its uncertainty."""

from __future__ import annotations

import math

from carlab.diagnosis.quick.causes import ALL_PARAMETERS, GRIP, Cause
from carlab.diagnosis.quick.quick_check import QuickCheck
from carlab.diagnosis.report.numbers import number, percent, unit_text, with_unit
from carlab.diagnosis.report.sentences import CHANNEL_NAMES
from sim_backends.effects import EFFECTS


def sentences(check: QuickCheck, decide: str = "carlab diagnose decides") -> tuple[str, ...]:
    """Sentence of the verdict, and one of the likely causes if the simulator does not explain the recordings.

    Args:
        check: the result.
        decide: last clause of the second sentence: how to confirm the cause.
    """
    if check.verdict == "undecided":
        return (f"The recordings are not sufficient to check the simulator: {check.why}",)
    used = f"{check.windows} windows of {check.episodes} episode{'s' if check.episodes != 1 else ''}"
    floors = f"{check.score:.1f}"
    if math.isfinite(check.score_std):
        floors += f" ± {check.score_std:.1f}"
    errors = f"its error after {check.horizon_s:.1f} s is {floors} noise floors ({used})"
    if check.verdict == "explains":
        return (f"The simulator explains the recordings: {errors}.",)
    worst = check.channels[0]
    text = (
        f"The simulator does not explain the recordings: {errors}. The largest error is in "
        f"{CHANNEL_NAMES[worst.channel]} ({with_unit(worst.rms, worst.unit)}; "
        f"noise {with_unit(worst.floor, worst.unit)})"
    )
    if check.conditions:
        c = check.conditions[0]
        where = f"where {unit_text(c.text)}" if {"<", ">"} & set(c.text) else c.text
        text += f", mostly {where} ({c.inside:.1f} against {c.outside:.1f} noise floors)"
    else:
        text += ", equally in all driving conditions"
    return text + ".", _likely_causes(check, decide)


def short(check: QuickCheck) -> str:
    """One line for a figure."""
    if check.verdict == "undecided":
        return "the simulator: undecided"
    if check.verdict == "explains":
        return f"the simulator explains the recordings ({check.score:.1f} noise floors)"
    cause = f"; likely cause: {_name(check.causes[0].id)}" if check.causes else ""
    worst = check.channels[0].channel
    return f"the simulator does not explain the recordings ({check.score:.1f} noise floors, {worst}){cause}"


def _likely_causes(check: QuickCheck, decide: str) -> str:
    if not check.causes:
        return f"No single effect of the catalogue and no parameter of the car file explains it; {decide}."
    first, *others = check.causes
    text = (
        f"Most likely cause: {_cause(first)}, which explains {percent(first.share)} of the excess loss on held-out "
        "windows"
    )
    for cause in others:
        label = "indistinguishable from it" if cause.ties_with_first else "less likely"
        text += f"; {label}: {_cause(cause)}, {percent(cause.share)}"
    return f"{text}; {decide}."


def _cause(cause: Cause) -> str:
    values = []
    for key, p in cause.parameters.items():
        label = key if cause.id in (ALL_PARAMETERS, GRIP) else key.rsplit(".", 1)[1]
        text = f"{label} {with_unit(p.value, p.unit)}"
        if p.before is not None and (cause.id == ALL_PARAMETERS or not key.startswith("effects.")):
            text += f" instead of {number(p.before)}"
        values.append(text)
    refit = " with other parameters of the car file" if cause.with_refit else ""
    id_of_effect = f"{cause.id}: " if cause.id in EFFECTS else ""
    return f"{_name(cause.id)} ({id_of_effect}{', '.join(values)}){refit}"


def _name(cause: str) -> str:
    """Name of a cause by its id; a base parameter has its dotted name."""
    if cause in EFFECTS:
        return EFFECTS[cause].name
    return {ALL_PARAMETERS: "the parameters of the car file", GRIP: "the grip of both axles"}.get(cause, cause)
