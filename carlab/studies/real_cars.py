"""Prediction errors of several models on held-out drives of a real car, by recording and horizon."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from carlab.core.errors import DataError
from carlab.diagnosis.diagnose import Outcome
from carlab.prediction.errors import prediction_errors

HORIZONS_S = (0.3, 0.5, 1.0)
ALL = "all"
"""Name of the rows over all held-out recordings."""
MODEL_NAMES = {
    "constant_velocity": "constant velocity",
    "nominal": "car file",
    "refit": "refit",
    "with_effects": "diagnosed",
    "with_uncatalogued_physics": "diagnosed, physics outside the catalogue",
    "with_curves": "diagnosed, measured curves",
    "with_discrepancy": "diagnosed, learned discrepancy",
    "black_box": "black box",
    "adapted": "adapted",
}
"""Models of a diagnosis in the order of the table, with their names there."""


@dataclass(frozen=True, slots=True)
class RealCarError:
    """Errors of one model on one held-out recording after one horizon.

    Attributes:
        recording: name of the recording, or ``ALL``.
        model: name of the model.
        horizon_s: horizon [s].
        position_rms_m, position_median_m: root mean square and median distance [m].
        yaw_rms_rad: root mean square error of the heading [rad].
        windows: number of prediction windows.
    """

    recording: str
    model: str
    horizon_s: float
    position_rms_m: float
    position_median_m: float
    yaw_rms_rad: float
    windows: int


def real_car_errors(
    outcome: Outcome, names: Sequence[str], horizons_s: Sequence[float] = HORIZONS_S
) -> list[RealCarError]:
    """Errors of all models of a diagnosis on its held-out windows.

    Args:
        outcome: the diagnosis.
        names: name of the recording of each held-out episode.
        horizons_s: horizons, at most that of the windows [s].
    """
    windows = outcome.held_out_windows
    found = []
    for key, name in MODEL_NAMES.items():
        if key not in outcome.models:
            continue
        errors = prediction_errors(outcome.models[key].predict(windows), windows)
        for recording, rows in _by_recording(windows.recording, names):
            for horizon_s in horizons_s:
                at = errors[rows, round(horizon_s / windows.period_s)]
                distance = np.hypot(at[:, 0], at[:, 1])
                found.append(
                    RealCarError(
                        recording,
                        name,
                        horizon_s,
                        float(np.sqrt(np.mean(distance**2))),
                        float(np.median(distance)),
                        float(np.sqrt(np.mean(at[:, 2] ** 2))),
                        int(rows.sum()),
                    )
                )
    return found


def _by_recording(index: np.ndarray, names: Sequence[str]) -> Iterator[tuple[str, np.ndarray]]:
    """Each recording with its windows, then all windows if there are several recordings."""
    recordings = list(dict.fromkeys(names))
    for recording in recordings:
        own = np.isin(index, [k for k, name in enumerate(names) if name == recording])
        if own.any():
            yield recording, own
    if len(recordings) > 1:
        yield ALL, np.ones(len(index), dtype=bool)


def split_by_name(
    names: Sequence[str], held_out: Iterable[str], fit: Iterable[str] = ()
) -> tuple[list[str], list[str]]:
    """Recordings to fit and held-out ones.

    Args:
        names: all recordings of a folder.
        held_out: parts of the names of held-out recordings; the last recording if empty.
        fit: parts of the names of recordings to fit; all others if empty.

    Raises:
        DataError: a part matches no name, or nothing is left to fit.
    """
    held_parts, fit_parts = list(held_out), list(fit)
    for part in (*held_parts, *fit_parts):
        if not any(part in name for name in names):
            raise DataError(f"No recording has '{part}' in its name; there are {', '.join(names) or 'none'}.")
    held = [name for name in names if any(part in name for part in held_parts)] if held_parts else list(names[-1:])
    others = [name for name in names if name not in held]
    chosen = [name for name in others if not fit_parts or any(part in name for part in fit_parts)]
    if not chosen or not held:
        raise DataError("At least one recording to fit and one held-out recording are needed; add recordings.")
    return chosen, held


def as_json(errors: Sequence[RealCarError], command: str, split: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """The figures with the command and the split, for a file."""
    return {
        "schema": "carlab.realcars/1",
        "command": command,
        **{role: list(names) for role, names in split.items()},
        "errors": [asdict(e) for e in errors],
    }
