"""The file with the figures of a training: ``models/0003/training.json``. It may come from another computer."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from carlab.core.errors import DataError
from carlab.core.json_files import read_json

FIGURES_FILE = "training.json"
_COUNTS = ("episode", "rows", "updates")
_NUMBERS = ("return_in_model", "model_seconds", "policy_seconds")
_OPTIONAL_COUNTS = ("supported_history", "needed_ticks")
_OPTIONAL_NUMBERS = (
    *("predicted_return", "predicted_low", "predicted_high", "cost_in_model", "success_in_model"),
    *("last_episode_nll", "last_episode_calibration_error"),
)
_TEXTS = ("history_message", "prior_change")


def read_training_figures(folder: Path, episode: int) -> dict[str, Any]:
    """Read the figures of the training before an episode from the folder of its model and policy.

    Raises:
        DataError: the file cannot be read, a figure is missing or has another type, or it is of another episode. The
            message is a clause without a remedy.
    """
    try:
        figures = read_json(folder / FIGURES_FILE)
        _check_types(figures)
    except (OSError, ValueError) as error:
        raise DataError(f"{FIGURES_FILE} cannot be read ({error})") from error
    if figures["episode"] != episode:
        raise DataError(f"{FIGURES_FILE} is of episode {figures['episode']}, not {episode}")
    return figures


def _check_types(figures: Mapping[str, Any]) -> None:
    """Raise ValueError for a figure that is missing or has another type."""
    for name in (*_COUNTS, *_NUMBERS):
        if name not in figures:
            raise ValueError(f"it has no {name}")
    for name in _COUNTS + _OPTIONAL_COUNTS:
        value = figures.get(name, 0)
        if type(value) is not int or value < 0:
            raise ValueError(f"{name} is {value!r}, not a count")
    for name in _NUMBERS + _OPTIONAL_NUMBERS:
        if type(figures.get(name, 0.0)) not in (int, float):
            raise ValueError(f"{name} is {figures[name]!r}, not a number")
    for name in _TEXTS:
        if not isinstance(figures.get(name, ""), str):
            raise ValueError(f"{name} is {figures[name]!r}, not a text")
