"""A light diagnosis in two sentences, never more certain than it is."""

from __future__ import annotations

import math

from carlab.diagnosis.light import LightDiagnosis
from carlab.diagnosis.light_causes import NUMBERS, Cause
from carlab.diagnosis.report_text import CHANNEL_WORDS, number, percent, with_unit


def sentences(told: LightDiagnosis, decide: str = "carlab diagnose decides") -> tuple[str, ...]:
    """One sentence, and a second with the guesses where reality has left the simulator.

    Args:
        told: the diagnosis.
        decide: who has the last word, as the end of a sentence.
    """
    stretches = f"{told.shots} stretches of {told.episodes} episode{'s' if told.episodes != 1 else ''}"
    if told.verdict == "undecided":
        return (f"Whether reality has left the simulator cannot be told yet: {told.why}",)
    floors = f"{told.score:.1f}"
    if math.isfinite(told.score_std):
        floors += f" ± {told.score_std:.1f}"
    if told.verdict == "explains":
        return (
            f"The simulator explains the recordings: errors of {floors} noise floors after {told.horizon_s:.1f} s "
            f"({stretches}).",
        )
    worst = told.channels[0]
    text = (
        f"Reality has left the simulator: errors of {floors} noise floors after {told.horizon_s:.1f} s ({stretches}), "
        f"most in {CHANNEL_WORDS[worst.channel]} ({with_unit(worst.rms, worst.unit)}; noise "
        f"{with_unit(worst.floor, worst.unit)})"
    )
    if told.conditions:
        c = told.conditions[0]
        text += f", above all {c.text} ({c.inside:.1f} against {c.outside:.1f} noise floors)".replace(
            "above all |", "above all where |"
        )
    else:
        text += ", in all conditions alike"
    return text + ".", _guesses(told, decide)


def short(told: LightDiagnosis) -> str:
    """A few words for a picture."""
    if told.verdict == "undecided":
        return "the simulator: cannot be told"
    if told.verdict == "explains":
        return f"the simulator explains the recordings ({told.score:.1f} noise floors)"
    guess = f"; first guess: {told.causes[0].id}" if told.causes else ""
    return f"reality has left the simulator ({told.score:.1f} noise floors, {told.channels[0].channel}){guess}"


def _guesses(told: LightDiagnosis, decide: str) -> str:
    if not told.causes:
        return f"No single effect of the catalogue and no number of the car file explains it; {decide}."
    parts = [_cause(c) for c in told.causes]
    text = f"First guess: {parts[0]} of the excess explained on stretches that were not fitted"
    for cause, part in zip(told.causes[1:], parts[1:], strict=True):
        text += f"; {'not told apart from it' if cause.like_the_first else 'less likely'}: {part}"
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
    beside = " beside other numbers of the car file" if cause.beside_numbers else ""
    return f"{name} ({', '.join(values)}){beside}, {percent(cause.share)}"


__all__ = ["sentences", "short"]
