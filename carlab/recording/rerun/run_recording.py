"""All episodes of a run as one rerun recording: drives, predictions, learning curve and quick checks.

The episodes follow each other on the timeline ``car_time``, with a pause of a second between them. The timeline
``episode`` has their numbers. The entities of a drive are those of a recording of one episode; further ones are:

    map/predicted, map/predicted/car   predicted path with its band, and the car at its end
    states/{x,y,yaw,...}/{measured,predicted}   states, and predictions with twice their standard deviation
    learning/{total_reward,distance_m,...}   figures of each episode, at its end
    learning/table                           the same as a table
    check                                    sentences of the quick check
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from carlab.core.angles import align_unwrapped
from carlab.core.documents import EpisodeStarted
from carlab.core.episode_data import EpisodeData
from carlab.core.quantities import STATE_NAMES, STATE_UNITS, FloatArray
from carlab.recording.rerun import blueprint as look
from carlab.recording.rerun.columns import Color, yaw_quaternion
from carlab.recording.rerun.document_stream import DocumentStream
from carlab.recording.sink import Item

PAUSE_S = 1.0
"""Time between two episodes on the timeline ``car_time`` [s]."""
PREDICTED = "map/predicted"
PREDICTED_CAR = "map/predicted/car"
STATES = "states"
LEARNING = "learning"
TABLE = "learning/table"
CHECK = "check"
# Points of the viridis map (van der Walt and Smith, 2015): dark for the first episode, bright for the last.
_VIRIDIS = np.array([(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)], dtype=np.float64)

Value = float | str | bool | None
CURVES: Mapping[str, Mapping[str, tuple[str, Color]]] = {
    "Return": {
        "total_reward": ("on the car", look.SKY),
        "predicted_return": ("predicted in the learned car", look.ORANGE),
    },
    "Distance from the goal at the end [m]": {"distance_m": ("distance", look.SKY)},
    "Yaw error at the end [rad]": {"yaw_error_rad": ("yaw error", look.SKY)},
    "Negative log-likelihood of the previous episode [nat per step]": {"last_episode_nll": ("nll", look.PURPLE)},
    "Calibration error of the previous episode": {"last_episode_calibration_error": ("error", look.PURPLE)},
}
"""Panels of the learning curve: figures with name and colour of their series."""
EXCESS = "Error of the simulator above the noise floor [noise floors]"
TABLE_COLUMNS: Mapping[str, str] = {
    "episode": "episode",
    "total_reward": "return",
    "predicted_return": "predicted return",
    "distance_m": "distance [m]",
    "yaw_error_rad": "yaw error [rad]",
    "success": "success",
    "cost": "constraint cost",
    "violations": "violations",
    "end": "end",
    "verdict": "quick check",
}


class RunRecording:
    """Writes a run into a rerun stream.

    Args:
        stream: receives the entities.
        episodes: planned number of episodes, for the colours of their paths.
    """

    def __init__(self, stream: rr.RecordingStream, episodes: int) -> None:
        self.documents = DocumentStream(stream)
        self._stream = stream
        self._episodes = episodes
        self._points_m: list[FloatArray] = []
        self._rows: dict[int, Mapping[str, Value]] = {}
        self._is_first = True
        look.log_styles(stream, trail_color=None)
        _log_styles(stream)

    def write(self, item: Item) -> None:
        """Write a document of an episode; an EpisodeStarted begins the next one."""
        if isinstance(item, EpisodeStarted):
            start_s = 0.0 if self._is_first else self.documents.now_s + PAUSE_S
            if not self._is_first:
                self._interrupt_lines()
            self._is_first = False
            number = episode_number(item)
            self.documents.begin(item, start_s, number, episode_color(number, self._episodes))
            self._points_m.append(look.extent_m(item))
        self.documents.write(item)

    def add_predicted_path(self, t_s: float, step: int, mean: FloatArray, across_std: FloatArray) -> None:
        """Draw the predicted path ahead of the car.

        Args:
            t_s: time of the prediction on the car's clock [s].
            step: its tick.
            mean: predicted states (K + 1, 6) in SI units.
            across_std: standard deviation of the position across the path (K + 1,) [m].
        """
        self.documents.columns.set_time(t_s - self.documents.columns.origin_s, step)
        left = np.column_stack([-np.sin(mean[:, 2]), np.cos(mean[:, 2])])
        edge = 2.0 * across_std[:, None] * left
        band = np.concatenate([mean[:, :2] + edge, (mean[:, :2] - edge)[::-1]])
        strips = [np.column_stack([path, np.full(len(path), 0.01)]) for path in (mean[:, :2], [*band, band[0]])]
        radii = rr.Radius.ui_points([2.0, 0.8])
        self._stream.log(PREDICTED, rr.LineStrips3D(strips, radii=radii, colors=look.ORANGE))
        car = rr.Boxes3D(
            half_sizes=[[0.5 * size for size in look.CAR_SIZE_M]],
            centers=[[float(mean[-1, 0]), float(mean[-1, 1]), 0.5 * look.CAR_SIZE_M[2]]],
            quaternions=[rr.Quaternion(xyzw=yaw_quaternion(mean[-1, 2]))],
            colors=look.ORANGE,
            fill_mode=rr.components.FillMode.MajorWireframe,
        )
        self._stream.log(PREDICTED_CAR, car)
        self.documents.logged.add(PREDICTED)

    def add_windows(self, episode: EpisodeData, ticks: np.ndarray, mean: FloatArray, std: FloatArray) -> None:
        """Write measured states of the newest episode and the predictions of its windows.

        Args:
            episode: the episode.
            ticks: its ticks in each window (S, N); the first of each is the initial state.
            mean: predicted states there (S, N, 6).
            std: their standard deviation (S, N, 6).
        """
        columns = self.documents.columns
        for k, name in enumerate(STATE_NAMES):
            measured, predicted = episode.states[:, k], mean[..., k]
            if name == "yaw" and len(ticks):
                measured, predicted = align_unwrapped(measured, ticks[:, 0], predicted)
            indexes = columns.indexes(episode.times_s, range(len(episode.times_s)))
            columns.scalars(f"{STATES}/{name}/measured", indexes, measured)
            if len(ticks):
                center, half_width = predicted[:, 1:].ravel(), 2.0 * std[:, 1:, k].ravel()
                steps = ticks[:, 1:].ravel()
                band = np.stack([center, center - half_width, center + half_width], axis=1)
                columns.scalars(
                    f"{STATES}/{name}/predicted", columns.indexes(episode.times_s[steps], steps.tolist()), band
                )

    def add_figures(self, episode: int, figures: Mapping[str, Value], check: str = "") -> None:
        """Write the figures of the newest episode and the sentences of its quick check, or replace them.

        Args:
            episode: its number.
            figures: values by name, such as ``total_reward``; NaN and None are omitted.
            check: sentences; empty without a check.
        """
        self._rows[episode] = figures
        for name, value in figures.items():
            if name != "episode" and isinstance(value, int | float) and math.isfinite(value):
                self.documents.log(f"{LEARNING}/{name}", rr.Scalars(float(value)))
        table = _table([self._rows[number] for number in sorted(self._rows)])
        self.documents.log(TABLE, rr.TextDocument(table, media_type=rr.MediaType.MARKDOWN))
        if check:
            self.documents.text(CHECK, f"Episode {episode}: {check}")

    def blueprint(self, *, is_learning: bool | None = None) -> rrb.Blueprint:
        """Layout of tabs: drive by episode, predicted against driven, learning curve, quick check, latency and health.

        Args:
            is_learning: whether a live view must show learning; None: the tabs and panels with data.
        """
        logged = self.documents.logged if is_learning is None else None
        points_m = np.vstack([np.zeros((0, 2)), *self._points_m])
        drive = look.drive_tab(points_m, (), logged, "Drive by episode")
        results = [] if is_learning is False else [_predicted_tab(logged), _curve_tab(logged), _check_tab(logged)]
        return look.tabs([drive, *results, look.link_tab(logged)])

    def _interrupt_lines(self) -> None:
        """Interrupt all series, so that no line joins two episodes, and remove the predicted path."""
        self.documents.columns.set_time(self.documents.now_s + 0.5 * PAUSE_S, 0)
        self._stream.log(PREDICTED, rr.Clear(recursive=True))
        for path in self.documents.logged:
            if path in look.SERIES or path.startswith(f"{STATES}/"):
                self._stream.log(path, rr.Scalars([math.nan] * (3 if path.endswith("predicted") else 1)))


def episode_number(started: EpisodeStarted) -> int:
    """Number of an episode in its run; an episode of learning has the number of its model."""
    number = started.metadata.get("model", "")
    return int(number) if number.isdecimal() and len(number) < 10 else started.episode


def episode_color(number: int, episodes: int) -> Color:
    """Colour of the path of an episode, numbered from 1."""
    position = (len(_VIRIDIS) - 1) * min((number - 1) / max(episodes - 1, 1), 1.0)
    red, green, blue = (round(float(np.interp(position, range(len(_VIRIDIS)), channel))) for channel in _VIRIDIS.T)
    return red, green, blue


def _log_styles(stream: rr.RecordingStream) -> None:
    for name in STATE_NAMES:
        stream.log(f"{STATES}/{name}/measured", rr.SeriesLines(names="measured", colors=look.SKY), static=True)
        style = rr.SeriesLines(
            names=["predicted", "- 2 standard deviations", "+ 2 standard deviations"],
            colors=[look.ORANGE, look.GREY, look.GREY],
            widths=[1.5, 0.7, 0.7],
        )
        stream.log(f"{STATES}/{name}/predicted", style, static=True)
    curves = {name: style for panel in CURVES.values() for name, style in panel.items()}
    for figure, (name, color) in {**curves, "excess": ("error above the noise floor", look.VERMILION)}.items():
        stream.log(f"{LEARNING}/{figure}", rr.SeriesLines(names=name, colors=color, widths=1.5), static=True)
        markers = rr.SeriesPoints(names=name, colors=color, markers="circle", marker_sizes=4)
        stream.log(f"{LEARNING}/{figure}", markers, static=True)


def _predicted_tab(logged: look.Logged) -> rrb.Container | None:
    views = [
        look.series(
            f"{name.replace('_', ' ')} [{unit}]",
            [f"{STATES}/{name}/measured", f"{STATES}/{name}/predicted"],
            logged,
            plot_legend=rrb.PlotLegend(visible=name == STATE_NAMES[0]),
        )
        for name, unit in zip(STATE_NAMES, STATE_UNITS, strict=True)
    ]
    halves = [look.stack(rrb.Vertical, [(view, 1) for view in half]) for half in (views[:3], views[3:])]
    return look.stack(rrb.Horizontal, [(half, 1) for half in halves], "Predicted against driven")


def _curve_tab(logged: look.Logged) -> rrb.Container | None:
    views = [
        look.series(panel, [f"{LEARNING}/{name}" for name in figures], logged) for panel, figures in CURVES.items()
    ]
    curves = look.stack(rrb.Vertical, [(view, 1) for view in views])
    table = rrb.TextDocumentView(origin=f"/{TABLE}", name="Episodes") if look.has(logged, TABLE) else None
    return look.stack(rrb.Horizontal, [(curves, 1), (table, 1)], "Learning curve")


def _check_tab(logged: look.Logged) -> rrb.Container | None:
    if not look.has(logged, CHECK):
        return None
    sentences = rrb.TextLogView(origin=f"/{CHECK}", name="What the quick check found")
    return look.stack(
        rrb.Vertical, [(look.series(EXCESS, [f"{LEARNING}/excess"], logged), 1), (sentences, 1)], "Quick check"
    )


def _table(rows: Sequence[Mapping[str, Value]]) -> str:
    """Figures of episodes as a table in Markdown, without empty columns."""
    names = [name for name in TABLE_COLUMNS if any(row.get(name) not in (None, "") for row in rows)]
    lines = [[TABLE_COLUMNS[name] for name in names], ["---"] * len(names)]
    lines += [[_cell(row.get(name)) for name in names] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(value: Value) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.2f}" if isinstance(value, float) else str(value).replace("_", " ").lower()
