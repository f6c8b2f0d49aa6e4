"""A quick check in two sentences that are never more certain than its figures."""

from __future__ import annotations

import math

from carlab.diagnosis.quick.causes import NUMBERS, Cause
from carlab.diagnosis.quick.quick_check import QuickCheck
from carlab.diagnosis.report.sentences import CHANNEL_WORDS, number, percent, with_unit


def sentences(check: QuickCheck, decide: str = "carlab diagnose decides") -> tuple[str, ...]:
    """One sentence, and a second with the guesses where the simulator does not explain the recordings.

    Args:
        check: the result.
        decide: what decides, as the end of a sentence.
    """
    if check.verdict == "undecided":
        return (f"The recordings cannot tell yet whether the simulator explains them: {check.why}",)
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
        f"{CHANNEL_WORDS[worst.channel]} ({with_unit(worst.rms, worst.unit)}; "
        f"noise {with_unit(worst.floor, worst.unit)})"
    )
    if check.conditions:
        c = check.conditions[0]
        where = f"where {c.text}" if c.text.startswith("|") else c.text
        text += f", above all {where} ({c.inside:.1f} against {c.outside:.1f} noise floors)"
    else:
        text += ", in all conditions alike"
    return text + ".", _guesses(check, decide)


def short(check: QuickCheck) -> str:
    """A few words for a picture."""
    if check.verdict == "undecided":
        return "the simulator: undecided"
    if check.verdict == "explains":
        return f"the simulator explains the recordings ({check.score:.1f} noise floors)"
    guess = f"; first guess: {check.causes[0].id}" if check.causes else ""
    worst = check.channels[0].channel
    return f"the simulator does not explain the recordings ({check.score:.1f} noise floors, {worst}){guess}"


def _guesses(check: QuickCheck, decide: str) -> str:
    if not check.causes:
        return f"No single effect of the catalogue and no number of the car file explains it; {decide}."
    parts = [_cause(c) for c in check.causes]
    text = f"First guess: {parts[0]} of the excess explained on windows that were not fitted"
    for cause, part in zip(check.causes[1:], parts[1:], strict=True):
        text += f"; {'indistinguishable from it' if cause.ties_with_first else 'less likely'}: {part}"
    return f"{text}; {decide}."


def _cause(cause: Cause) -> str:
    name = "the numbers of the car file" if cause.id == NUMBERS else cause.id
    values = []
    for key, p in cause.parameters.items():
        what = key if cause.id == NUMBERS else key.rsplit(".", 1)[1]
        text = f"{what} {with_unit(p.value, p.unit)}"
        if p.before is not None and (cause.id == NUMBERS or not key.startswith("effects.")):
            text += f" instead of {number(p.before)}"
        values.append(text)
    refit = " with other numbers of the car file" if cause.with_refit else ""
    return f"{name} ({', '.join(values)}){refit}, {percent(cause.share)}"


__all__ = ["sentences", "short"]
