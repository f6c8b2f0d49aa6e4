"""Closed paths and tracks: arc length, distance and width of the nearest point; a track from a CSV file or a table."""

from __future__ import annotations

import csv
import functools
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from array_api_compat import array_namespace

from carlab.core.errors import ConfigError
from carlab.core.keep_out import Corners
from carlab.core.quantities import FloatArray
from carlab.core.tables import check_keys, number

MIN_WIDTH_M, MAX_LENGTH_M, MAX_POINTS = 0.25, 2000.0, 2000
"""Limits of a plausible track; a file in millimetres or centimetres exceeds one of them."""
MAX_CLOSING_RATIO = 5.0
"""Maximum distance from the last point to the first, over that of other neighbours; a longer one is a missing part."""
COLUMNS = ("x", "y", "width")
_AMBIGUITY_COST_M = 1e3
_REACH_M = 0.5


class Projection(NamedTuple):
    """The nearest point of a closed path, each (...,): arc length, distance, and the value at that point, all [m]."""

    arc_m: Any
    distance_m: Any
    value_m: Any


@dataclass(frozen=True, slots=True)
class ClosedPath:
    """A closed polyline with a value [m] at each point, for example the track's half width."""

    points_m: Corners
    values_m: tuple[float, ...]

    @property
    def length_m(self) -> float:
        """Length of the closed path [m]."""
        return float(_segments(self)[2].sum())

    def project(self, positions_m: Any, near_m: Any | None = None) -> Projection:
        """Project positions (..., 2), NumPy or torch, on the path.

        Args:
            positions_m: the positions (..., 2).
            near_m: arc lengths (...,) that restrict the search to within 0.5 m, so that crossings are unambiguous.
        """
        xp = array_namespace(positions_m)

        def constant(values: FloatArray) -> Any:
            made = xp.asarray(values, dtype=positions_m.dtype)
            return made.to(positions_m.device) if hasattr(positions_m, "is_cuda") else made

        first, edge, length, start, value, slope = (constant(v) for v in _segments(self))
        offset = positions_m[..., None, :] - first
        along = xp.clip(xp.sum(offset * edge, axis=-1), 0.0 * length, length)
        rest = offset - along[..., None] * edge
        distance = xp.sqrt(xp.sum(rest * rest, axis=-1) + 1e-12)
        arc = start + along
        cost = distance
        if near_m is not None:
            apart = xp.abs(wrap_length(arc - near_m[..., None], self.length_m))
            cost = distance + _AMBIGUITY_COST_M * xp.astype(apart > _REACH_M, positions_m.dtype)
        index = xp.argmin(cost, axis=-1)[..., None]
        return Projection(
            *(xp.take_along_axis(v, index, axis=-1)[..., 0] for v in (arc, distance, value + slope * along))
        )

    def travelled_m(self, positions_m: FloatArray) -> FloatArray:
        """Distance along the path (T,) of consecutive positions (T, 2), from the first point; several laps add up."""
        travelled = np.empty(len(positions_m))
        for k, position in enumerate(positions_m):
            near = None if k == 0 else np.asarray(travelled[k - 1] % self.length_m)
            arc = float(self.project(position, near).arc_m)
            before = 0.0 if k == 0 else travelled[k - 1]
            travelled[k] = before + wrap_length(arc - before, self.length_m)
        return travelled


@functools.lru_cache(maxsize=32)
def _segments(path: ClosedPath) -> tuple[FloatArray, ...]:
    """First points (N, 2), directions (N, 2), lengths, arc lengths, values and their slopes (N,) of the segments."""
    points, values = np.asarray(path.points_m), np.asarray(path.values_m)
    edges = np.roll(points, -1, axis=0) - points
    lengths = np.hypot(*edges.T)
    starts = np.concatenate([[0.0], np.cumsum(lengths)[:-1]])
    return points, edges / lengths[:, None], lengths, starts, values, (np.roll(values, -1) - values) / lengths


def wrap_length(length_m: Any, total_m: float) -> Any:
    """Signed arc length (...) [m] on a closed path, in [-total / 2, total / 2)."""
    return (length_m + 0.5 * total_m) % total_m - 0.5 * total_m


@dataclass(frozen=True, slots=True)
class Track:
    """A closed track: centre line in driving direction (N points [m], the first is not repeated), and widths [m]."""

    centre_line_m: Corners
    width_m: tuple[float, ...]

    @property
    def path(self) -> ClosedPath:
        """The centre line with half the width."""
        return ClosedPath(self.centre_line_m, tuple(0.5 * w for w in self.width_m))

    @property
    def borders_m(self) -> tuple[Corners, Corners]:
        """Left and right border."""
        points, half = np.asarray(self.centre_line_m), 0.5 * np.asarray(self.width_m)[:, None]
        along = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
        left = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(*along.T)[:, None]
        borders = (points + half * left, points - half * left)
        first, second = (tuple((float(x), float(y)) for x, y in border) for border in borders)
        return first, second

    def to_table(self) -> dict[str, Any]:
        """The track as values for JSON or TOML; ``track_from_table`` reads them."""
        return {"centre_line_m": [list(p) for p in self.centre_line_m], "width_m": list(self.width_m)}


def oval_track(straight_m: float = 1.6, radius_m: float = 0.9, width_m: float = 0.8, spacing_m: float = 0.2) -> Track:
    """Two straights and two half circles about the origin, driven counter-clockwise from the middle of a straight."""
    half = math.pi * radius_m
    total = 2.0 * (straight_m + half)
    points = []
    for s in np.linspace(0.0, total, round(total / spacing_m), endpoint=False):
        along = (s + 0.5 * straight_m) % total
        side = 1.0 if along < straight_m + half else -1.0
        along %= straight_m + half
        if along < straight_m:
            x, y = along - 0.5 * straight_m, -radius_m
        else:
            angle = (along - straight_m) / radius_m - 0.5 * math.pi
            x, y = 0.5 * straight_m + radius_m * math.cos(angle), radius_m * math.sin(angle)
        points.append((float(side * x), float(side * y)))
    return Track(tuple(points), (width_m,) * len(points))


def track_from_table(table: Any, where: str) -> Track:
    """Read ``centre_line_m`` (list of [x, y]) and ``width_m`` (a number or one per point). Raises ConfigError."""
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where} must be a table.")
    check_keys(table, ("centre_line_m", "width_m"), where)
    points, width = table.get("centre_line_m"), table.get("width_m")
    if not isinstance(points, list) or not all(isinstance(p, list) and len(p) == 2 for p in points):
        raise ConfigError(f"'centre_line_m' in {where} must be a list of points [x, y] in metres.")
    widths = width if isinstance(width, list) else [width] * len(points)
    rows = [
        [number(value, f"an entry of {where}") for value in (*point, w)]
        for point, w in zip(points, widths, strict=False)
    ]
    if len(widths) != len(points):
        raise ConfigError(f"'width_m' in {where} has {len(widths)} entries for {len(points)} points; give one each.")
    return _checked(rows, where)


def read_track(path: Path | str) -> Track:
    """Read a track from a CSV file with the columns x, y and width [m] and a header.

    Columns are separated by commas, or by semicolons, with which numbers may have decimal commas.

    Raises:
        ConfigError: it cannot be read or driven.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        title = next((line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), "")
        separator = ";" if ";" in title else ","
        reader = csv.reader(io.StringIO(text), delimiter=separator)
        lines = [(reader.line_num, row) for row in reader if row and not row[0].lstrip().startswith("#")]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(f"The track {path} cannot be read ({reason}); name a CSV file with x, y, width.") from error
    header = [cell.strip().lower().removesuffix("_m") for cell in lines[0][1]] if lines else []
    if missing := [name for name in COLUMNS if name not in header]:
        raise ConfigError(f"The track {path} lacks the column {missing[0]}; its first line must be x,y,width [m].")
    rows = []
    for line_number, row in lines[1:]:
        try:
            cells = [row[header.index(name)] for name in COLUMNS]
            rows.append([float(cell.replace(",", ".") if separator == ";" else cell) for cell in cells])
        except (ValueError, IndexError) as error:
            raise ConfigError(f"Row {line_number} of the track {path} must have numbers for x, y and width.") from error
    return _checked(rows, f"The track {path}")


def _checked(rows: list[list[float]], where: str) -> Track:
    """The track of rows (x, y, width). Raises ConfigError if it cannot be driven."""
    values = np.array(rows, dtype=np.float64).reshape(-1, len(COLUMNS))
    if not np.isfinite(values).all():
        raise ConfigError(f"{where} has a number that is not finite; remove that point.")
    if len(values) > 1 and np.hypot(*(values[-1, :2] - values[0, :2])) < 1e-6:
        values = values[:-1]
    if not 3 <= len(values) <= MAX_POINTS:
        raise ConfigError(f"{where} has {len(values)} points; give 3 to {MAX_POINTS}.")
    steps = np.hypot(*(np.roll(values[:, :2], -1, axis=0) - values[:, :2]).T)
    if steps.min() < 1e-6:
        raise ConfigError(f"{where} has two equal points in a row; remove one.")
    before, after = np.roll(values[:, :2], 1, axis=0), np.roll(values[:, :2], -1, axis=0)
    turns_back = np.hypot(*(after - before).T) < 1e-6
    if turns_back.any():
        x, y = values[turns_back.argmax(), :2]
        raise ConfigError(f"{where} turns back on itself at ({x:g}, {y:g}) m; give the centre line of a closed track.")
    if values[:, 2].min() < MIN_WIDTH_M or values[:, 2].max() > steps.sum() or steps.sum() > MAX_LENGTH_M:
        raise ConfigError(
            f"{where} is {steps.sum():.4g} m long and {values[:, 2].min():.3g} to {values[:, 2].max():.3g} m wide, "
            f"which no car drives; give x, y and width in metres (width at least {MIN_WIDTH_M:g})."
        )
    if steps[-1] > MAX_CLOSING_RATIO * steps[:-1].max():
        raise ConfigError(
            f"{where} is open: its last point is {steps[-1]:.3g} m from the first, other points at most "
            f"{steps[:-1].max():.3g} m apart; add the points between, because a track is closed."
        )
    return Track(tuple((float(x), float(y)) for x, y in values[:, :2]), tuple(float(w) for w in values[:, 2]))
