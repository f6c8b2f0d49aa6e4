"""The fitted simulator as a car file, without the libraries of the figures: their import takes seconds."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import tomli_w

from carlab.core.recording_noise import RecordingNoise
from carlab.diagnosis.curves.support import MEASURED_CURVES
from carlab.diagnosis.findings import Diagnosis
from carlab.diagnosis.report.numbers import listed, number
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.registry import REGISTRY

COMMENT_CHARACTERS = 110


def model_toml(diagnosis: Diagnosis, model: SimulatorConfig, noise: RecordingNoise | None) -> str:
    """The simulator as a car file with the noise of the recordings; comments state the origin of its numbers."""
    fitted = [use.path for use in diagnosis.recordings if use.role == "fit" and diagnosis.parameters]
    found = listed([effect.id for effect in diagnosis.effects])
    held = diagnosis.held_out
    lines = ["Car file written by carlab diagnose; use it with --car, or diagnose again from it."]
    lines.append(f"Verdict: {diagnosis.verdict}." + (f" Named effects: {found}." if found else " No named effects."))
    for effect in diagnosis.effects:
        lines.append(effect.sentence)
        if effect.indistinguishable_from:
            others = listed(list(effect.indistinguishable_from), "or")
            lines.append(f"These recordings do not distinguish {effect.id} from {others}.")
    lines += [f"Fitted to: {path}" for path in fitted] or ["Not fitted: the car file as given."]
    scores = [
        f"{name} {number(held[name].score)}"
        for name in ("nominal", "refit", "with_effects", "with_uncatalogued_physics", "with_curves")
        if name in held
    ]
    if scores:
        lines.append(f"Held-out error in noise floors: {', '.join(scores)}.")
    comments = "".join(f"# {row}\n" for line in lines for row in _rows(line))
    tables = with_parameter_std(diagnosis, model).to_tables()
    if noise is not None:
        tables = {**tables, "recording_noise": noise.to_table()}
    return f"{comments}\n{_compact(tomli_w.dumps(tables))}"


def _compact(toml: str) -> str:
    """Write each list of numbers in one line."""
    return re.sub(r"\[\s+([^\[\]{}\"]+?),?\s+\]", lambda m: f"[{', '.join(m[1].replace(',', ' ').split())}]", toml)


def with_parameter_std(diagnosis: Diagnosis, model: SimulatorConfig) -> SimulatorConfig:
    """The simulator with the standard deviation of every estimate, and of values that stay; widths of later priors."""
    estimates = dict(diagnosis.parameters)
    for effect in diagnosis.effects:
        estimates |= {f"effects.{effect.id}.{name}": found for name, found in effect.parameters.items()}
    known = model.values()
    parameter_std = {
        name: found.std
        for name, found in estimates.items()
        if name in known and not REGISTRY[name].choices and 0.0 < found.std < math.inf and math.isfinite(known[name])
    }
    unchanged = {name: std for name, std in model.parameter_std.items() if name in known and name not in estimates}
    return replace(model, parameter_std=unchanged | parameter_std | _curve_std(diagnosis, known))


def _curve_std(diagnosis: Diagnosis, known: Mapping[str, float]) -> dict[str, float]:
    """Standard deviations of measured curves at knots with data, by dotted name."""
    found: dict[str, float] = {}
    for curve in diagnosis.curves:
        own = MEASURED_CURVES[curve.id].numbers_of_table(np.nan_to_num(curve.std).tolist()) or {}
        found |= {f"effects.{curve.id}.{name}": std for name, std in own.items() if std > 0.0}
    return {name: std for name, std in found.items() if name in known}


def _rows(line: str) -> list[str]:
    """Wrap a comment; characters that TOML forbids in comments become question marks."""
    words = "".join(c if c.isprintable() else "?" for c in line).split(" ")
    rows = [words[0]]
    for word in words[1:]:
        if len(rows[-1]) + 1 + len(word) <= COMMENT_CHARACTERS:
            rows[-1] += f" {word}"
        else:
            rows.append(f"  {word}")
    return rows
