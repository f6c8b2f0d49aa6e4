"""Writes a diagnosis into a folder: report.json, report.html, report.rrd, summary.png and model.toml."""

from __future__ import annotations

import json
from pathlib import Path

from carlab.diagnosis.decisions import to_dict
from carlab.diagnosis.findings import Diagnosis, FigureData
from carlab.diagnosis.report.html_page import render_page
from carlab.diagnosis.report.model_file import model_toml
from carlab.diagnosis.report.picture import draw_picture
from carlab.diagnosis.report.rerun_recording import write_rrd
from carlab.recording.atomic_files import write_text
from carlab.recording.sink import make_folder, writing
from sim_backends.car_parameters import SimulatorConfig

JSON_NAME, HTML_NAME, RRD_NAME, MODEL_NAME = "report.json", "report.html", "report.rrd", "model.toml"
PICTURE_NAME = "summary.png"
DECISIONS_NAME = "decisions.json"


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
