"""The texts of a diagnosis: its sentences, and the drive that it advises."""

from __future__ import annotations

from dataclasses import replace

from carlab.core.manoeuvres import MANOEUVRES
from carlab.diagnosis.findings import Diagnosis
from carlab.diagnosis.report.numbers import listed
from carlab.diagnosis.report.parameters import stated_number
from carlab.diagnosis.report.recording_causes import limited_channels
from carlab.diagnosis.report.residual import differs_when_held_out, relevant_residual, remaining_share
from carlab.diagnosis.report.sentences import (
    effect_noun,
    effect_sentence,
    separating_drive,
    separating_reason,
    verdict_sentence,
)
from carlab.diagnosis.settings import EVIDENCE


def next_drive(diagnosis: Diagnosis) -> tuple[str, str]:
    """The manoeuvre to drive next (empty if none would help) and the reason."""
    for effect in diagnosis.effects:
        if effect.indistinguishable_from:
            reason = separating_reason(effect.id, effect.indistinguishable_from)
            others = listed([effect_noun(name) for name in effect.indistinguishable_from], "or")
            why = f"These recordings do not distinguish {effect_noun(effect.id)} from {others}. {reason}"
            return separating_drive(effect.id, effect.indistinguishable_from), why
    advice = diagnosis.advice or (diagnosis.sentence if diagnosis.verdict == "inconclusive" else "")
    if diagnosis.verdict == "data":
        return "", advice or "Correct the recording or record again. Then diagnose again."
    if diagnosis.verdict == "inconclusive":
        drive = next((m for m in MANOEUVRES if m in advice), "excitation")
        own = advice if advice != diagnosis.sentence else ""
        return drive, own or "Diagnose this drive together with these recordings."
    if limited_channels(diagnosis) and diagnosis.verdict in ("mismatch", "unexplained"):
        return "", "Record again with a log of the commands that the car executes, before another search for physics."
    if differs_when_held_out(diagnosis):
        return "", (
            "Compare both groups with carlab compare, which names what changed (50 s of driving in each group), or "
            "diagnose recordings of both together."
        )
    rest = relevant_residual(diagnosis)
    if (rest is not None or diagnosis.verdict == "unexplained") and not diagnosis.search.covers_catalogue:
        search = diagnosis.search
        cut_short = "without a stop" if search.stopped_by == "user" else "with a longer time limit"
        how = "without --effects" if search.effects else cut_short
        return "", f"Diagnose these recordings again {how}, before another drive."
    is_described = remaining_share(diagnosis) < EVIDENCE.unexplained_share_min
    if rest is not None and not is_described:
        channels = rest.channels
        along = bool(channels) and channels[0] in ("x", "vx")
        motion = "longitudinal" if along else "lateral"
        return (
            "coast_down" if along else "steering_chirp",
            advice or f"The residual is in the {motion} motion. Record a drive that excites it.",
        )
    if diagnosis.verdict in ("mismatch", "unexplained"):
        return "figure_eight", advice or (
            "The best test of model.toml is a new recording that was neither fitted nor held out here."
        )
    return "", advice or "No further drive is needed. Diagnose again when the car, its tyres or the floor change."


def drive_command(manoeuvre: str) -> str:
    """The command line that drives a manoeuvre; empty for none."""
    return f"carlab drive --policy {manoeuvre} --no-place" if manoeuvre else ""


def with_texts(diagnosis: Diagnosis) -> Diagnosis:
    """The diagnosis with its sentences, separating drives and advice."""
    effects = tuple(
        replace(
            e,
            sentence=effect_sentence(e.id, e.parameters, e.car_file_values)
            + stated_number(e, diagnosis.car_file_parameters),
            separating_drive=separating_drive(e.id, e.indistinguishable_from),
        )
        for e in diagnosis.effects
    )
    diagnosis = replace(diagnosis, sentence=verdict_sentence(diagnosis), effects=effects)
    drive, why = next_drive(diagnosis)
    command = drive_command(drive)
    return replace(diagnosis, advice=f"{why} Drive it with: {command}" if command else why)
