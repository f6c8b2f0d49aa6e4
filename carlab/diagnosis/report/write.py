"""Writes a diagnosis into a folder: report.json, report.html, report.rrd, summary.png and model.toml."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import tomli_w

from carlab.core.recording_noise import RecordingNoise
from carlab.diagnosis.curves.support import MEASURED_CURVES
from carlab.diagnosis.decisions import to_dict
from carlab.diagnosis.findings import Diagnosis, FigureData
from carlab.diagnosis.report.html_page import render_page
from carlab.diagnosis.report.numbers import listed, number
from carlab.diagnosis.report.picture import draw_picture
from carlab.diagnosis.report.rerun_recording import write_rrd
from carlab.recording.atomic_files import write_text
from carlab.recording.sink import make_folder, writing
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.registry import REGISTRY

JSON_NAME, HTML_NAME, RRD_NAME, MODEL_NAME = "report.json", "report.html", "report.rrd", "model.toml"
PICTURE_NAME = "summary.png"
DECISIONS_NAME = "decisions.json"
COMMENT_CHARACTERS = 110


def write_report(diagnosis: Diagnosis, figure_data: FigureData, folder: Path, model: SimulatorConfig) -> None:
    """Write the whole report and replace an existing one.

    Each file is written atomically. report.json is written last, so if it exists, all files exist.

    Args:
        diagnosis: the result.
        figure_data: data of the figures; may be empty.
        folder: created if missing.
        model: the simulator with the fitted parameters and effects, for model.toml.

    Raises:
        DataError: the folder cannot be created or written; the message states reason and remedy.
    """
    folder = Path(folder)
    report = json.dumps(diagnosis.to_dict(), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    texts = {
        MODEL_NAME: model_toml(diagnosis, model, figure_data.noise),
        HTML_NAME: render_page(diagnosis, figure_data),
        JSON_NAME: report,
    }
    with writing(folder):
        make_folder(folder)
        # Files of an earlier report must not stand next to new ones.
        for name in (JSON_NAME, PICTURE_NAME, DECISIONS_NAME):
            (folder / name).unlink(missing_ok=True)
    write_rrd(diagnosis, figure_data, folder / RRD_NAME)
    if figure_data.scores_by_step:
        draw_picture(diagnosis, figure_data, folder / PICTURE_NAME)
    for name, content in texts.items():
        write_text(folder / name, content)


def write_decisions(figure_data: FigureData, folder: Path) -> Path:
    """Write decisions.json into a folder and return its path."""
    path = folder / DECISIONS_NAME
    write_text(path, json.dumps(to_dict(figure_data.decisions), indent=1, allow_nan=False) + "\n")
    return path


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
