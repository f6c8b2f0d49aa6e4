"""Sentences about the drift of a car since the fitted recordings."""

from __future__ import annotations

from carlab.diagnosis.findings import Diagnosis, Drift, QuantityChange
from carlab.diagnosis.report.numbers import listed, number, percent, with_unit
from carlab.diagnosis.settings import DRIFT


def has_changed(diagnosis: Diagnosis, recording: int) -> bool:
    """Whether a held-out recording (number from 1) shows a change of the car, in states that were fitted."""
    return any(d.recording == recording and d.is_drift and _is_in_similar_states(d) for d in diagnosis.drift)


def _is_in_similar_states(drift: Drift) -> bool:
    return drift.similar_share >= DRIFT.min_similar_share


def drift_sentence(drift: Drift, horizon_s: float) -> str:
    """What changed in one recording, and what adaptation to it gains."""
    what = " ".join(_change_sentence(c) for c in drift.changes)
    if not what:
        what = "None of the four quantities (drive force, steering trim, grip, force forward) explains it alone."
    head = f"In held-out recording {drift.recording} the car differs from the fitted recordings."
    if not _is_in_similar_states(drift):
        head = f"In held-out recording {drift.recording} the car differs from the model."
        what += (
            f" Only {percent(drift.similar_share)} of its states are similar to fitted ones, so this is a change of "
            "the car or an error of the model in these states."
        )
    before, after = with_unit(drift.model_m, "m"), with_unit(drift.adapted_m, "m")
    gain = f"With adaptation, the position error after {with_unit(horizon_s, 's')} goes from"
    return f"{head} {what} {gain} {before} to {after}."


def drift_sentences(diagnosis: Diagnosis) -> list[str]:
    """Evidence and time constant of each drift, and one sentence for all recordings without one."""
    made = [
        f"Drift in held-out recording {d.recording}: a slow adaptation predicts its windows better by "
        f"{number(d.standard_errors)} standard errors. The most likely time constant is "
        f"{with_unit(d.time_constant_s, 's')}."
        for d in diagnosis.drift
        if d.is_drift
    ]
    without = [str(d.recording) for d in diagnosis.drift if not d.is_drift]
    if without:
        word = "recordings" if len(without) > 1 else "recording"
        made.append(
            f"No drift is found in held-out {word} {listed(without)}: a slow adaptation predicts the windows no better "
            "than the model does, or the errors of the model depend on the state rather than on time."
        )
    return made


def _change_sentence(change: QuantityChange) -> str:
    """The size of a change with its standard deviation, and the change along the recording if it is significant."""
    value = change.value
    if change.quantity == "steering trim":
        side = "left" if value > 0.0 else "right"
        text = f"The wheels point {with_unit(abs(value), 'rad')} (± {number(change.std)}) further to the {side}"
    elif change.quantity == "force forward":
        kind = "drives" if value > 0.0 else "brakes"
        text = f"An additional force {kind} the car with {with_unit(abs(value), 'm/s2')} (± {number(change.std)})"
    else:
        kind = "higher" if value > 0.0 else "lower"
        text = f"The {change.quantity} is {percent(abs(value))} (± {percent(change.std)}) {kind}"
    if abs(change.last - change.first) >= 2.0 * change.std:
        ends = [percent(v) if change.unit == "1" else with_unit(v, change.unit) for v in (change.first, change.last)]
        text += f", from {ends[0]} in the first quarter to {ends[1]} in the last"
    return f"{text}."
