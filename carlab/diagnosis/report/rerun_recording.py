"""The report as a rerun recording: the recorded car, the predictions, the residuals, and their worst stretches.

Each held-out recording, and each fitted one with events, has its entities under ``/NAME`` and one tab. The timeline
``car_time`` is the time since its first row [s].

    NAME/map/{recorded,nominal,refit,with_effects}/{base_link,trail}     plan view
    NAME/map/worst, NAME/map/place, NAME/map/events                      largest errors, places of effects, events
    NAME/state/{vx,vy,yaw_rate}/{recorded,nominal,refit,with_effects}    series
    NAME/residual/{position,yaw,vx,vy,yaw_rate}/{nominal,...}            predicted minus recorded
    NAME/marks                                                           text of the stretches and effects
    verdict                                                              the verdict and each effect
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from carlab.core.quantities import FloatArray
from carlab.diagnosis.findings import Diagnosis, FigureData, Trace
from carlab.diagnosis.report.events import event_label
from carlab.diagnosis.report.figures import LABELS, MODELS, residual, restarts
from carlab.diagnosis.report.numbers import number
from carlab.recording.atomic_files import rerun_file
from carlab.recording.rerun import blueprint
from carlab.recording.rerun.columns import Columns, entity_part, yaw_quaternion

VERDICT = "verdict"
COLORS = {
    "recorded": blueprint.GREY,
    "nominal": blueprint.ORANGE,
    "refit": blueprint.VERMILION,
    "with_effects": blueprint.SKY,
}
CHANNELS = {"vx": 3, "vy": 4, "yaw_rate": 5}
UNITS = {"position": "m", "yaw": "rad", "vx": "m/s", "vy": "m/s", "yaw_rate": "rad/s"}


def write_rrd(diagnosis: Diagnosis, figure_data: FigureData, path: Path) -> None:
    """Write the recording; an existing file is replaced when the new one is complete.

    Raises:
        DataError: the file cannot be written.
    """
    parts = entity_names(figure_data)
    with rerun_file(path, blueprint=_blueprint(parts, figure_data)) as stream:
        stream.send_recording_name("Diagnosis")
        stream.log(VERDICT, rr.TextDocument(_verdict(diagnosis), media_type=rr.MediaType.MARKDOWN), static=True)
        for part, trace in zip(parts, figure_data.traces, strict=True):
            _send_trace(stream, part, trace, diagnosis)


def entity_names(figure_data: FigureData) -> list[str]:
    """First part of the entity paths of each trace: its name, with a number if names are equal."""
    names: list[str] = []
    for trace in figure_data.traces:
        name = base = entity_part(trace.name)
        count = 2
        while name in (*names, VERDICT):
            name, count = f"{base}_{count}", count + 1
        names.append(name)
    return names


def _verdict(diagnosis: Diagnosis) -> str:
    lines = [f"# {diagnosis.verdict}", diagnosis.sentence]
    lines += [f"- {effect.sentence}" for effect in diagnosis.effects]
    if diagnosis.advice:
        lines += ["**Next:** " + diagnosis.advice]
    return "\n\n".join(lines)


def _send_trace(stream: rr.RecordingStream, part: str, trace: Trace, diagnosis: Diagnosis) -> None:
    columns = Columns(stream, 0.0)
    stream.log(f"{part}/map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    models = [m for m in MODELS if m in trace.predicted]
    indexes = columns.indexes(trace.times_s, range(len(trace.times_s)))
    for name in ("recorded", *models):
        states = trace.recorded if name == "recorded" else trace.predicted[name]
        begins = [] if name == "recorded" else restarts(trace.recorded, states)
        _send_car(stream, part, name, columns, trace.times_s, states, begins)
        for channel, column in CHANNELS.items():
            _send_series(stream, f"{part}/state/{channel}/{name}", name, indexes, states[:, column])
    for name in models:
        error = residual(trace, name)
        values = {"position": np.hypot(error[:, 0], error[:, 1]), "yaw": error[:, 2]}
        values |= {channel: error[:, column] for channel, column in CHANNELS.items()}
        for channel, series in values.items():
            _send_series(stream, f"{part}/residual/{channel}/{name}", name, indexes, series)
    _send_marks(stream, part, trace, diagnosis)
    if trace.events:
        labels = [f"{event.from_s:.2f} s: {event_label(event)}" for event in trace.events]
        places = [(event.x_m, event.y_m, 0.0) for event in trace.events]
        dots = rr.Points3D(places, labels=labels, radii=rr.Radius.ui_points(8.0), colors=blueprint.VERMILION)
        stream.log(f"{part}/map/events", dots, static=True)


def _send_car(
    stream: rr.RecordingStream,
    part: str,
    name: str,
    columns: Columns,
    times_s: FloatArray,
    states: FloatArray,
    begins: list[int],
) -> None:
    """Log a car and its trail; the trail is interrupted where a prediction restarts."""
    car, trail = f"{part}/map/{name}/base_link", f"{part}/map/{name}/trail"
    color = COLORS[name]
    half = [0.5 * size for size in blueprint.CAR_SIZE_M]
    mode = rr.components.FillMode.Solid if name == "recorded" else rr.components.FillMode.MajorWireframe
    stream.log(f"{car}/body", rr.Boxes3D(half_sizes=[half], colors=color, fill_mode=mode), static=True)
    width = rr.Radius.ui_points(3.0 if name == "recorded" else 1.5)
    stream.log(trail, rr.LineStrips3D.from_fields(radii=width, colors=color), static=True)
    rows = np.flatnonzero(np.isfinite(states[:, :3]).all(axis=1))
    if not len(rows):
        return
    indexes = columns.indexes(times_s[rows], rows.tolist())
    places = np.column_stack([states[rows, :2], np.zeros(len(rows))])
    turns = rr.Transform3D.columns(translation=places, quaternion=yaw_quaternion(states[rows, 2]))
    stream.send_columns(car, indexes, turns)
    starts = np.vstack([places[:1], places[:-1]])
    restarted = np.isin(rows, begins)
    starts[restarted] = places[restarted]
    strips = list(np.stack([starts, places], axis=1))
    stream.send_columns(trail, indexes, rr.LineStrips3D.columns(strips=strips))


def _send_series(
    stream: rr.RecordingStream, path: str, name: str, indexes: list[rr.TimeColumn], values: FloatArray
) -> None:
    style = rr.SeriesLines(names=LABELS[name], colors=COLORS[name], widths=2.5 if name == "recorded" else 1.5)
    stream.log(path, style, static=True)
    if np.isfinite(values).any():
        stream.send_columns(path, indexes, rr.Scalars.columns(scalars=np.asarray(values, dtype=np.float64)))


def _send_marks(stream: rr.RecordingStream, part: str, trace: Trace, diagnosis: Diagnosis) -> None:
    strips, marks = [], []
    for start_s, end_s in trace.marked:
        inside = (trace.times_s >= start_s) & (trace.times_s <= end_s)
        places = trace.recorded[inside, :2]
        places = places[np.isfinite(places).all(axis=1)]
        if len(places) > 1:
            strips.append(np.column_stack([places, np.full(len(places), -0.002)]))
        marks.append((start_s, f"Largest error of the refit from {number(start_s)} s to {number(end_s)} s", "WARN"))
    if strips:
        width = rr.Radius.ui_points(7.0)
        stream.log(f"{part}/map/worst", rr.LineStrips3D(strips, radii=width, colors=blueprint.YELLOW), static=True)
    circles = []
    first_s = float(trace.times_s[0]) if len(trace.times_s) else 0.0
    for effect in diagnosis.effects:
        if effect.where.place is not None:
            x, y, radius = effect.where.place
            around = [2.0 * math.pi * k / 48 for k in range(49)]
            circles.append([(x + radius * math.cos(a), y + radius * math.sin(a), 0.0) for a in around])
        at_s = first_s if effect.where.time is None else max(effect.where.time[0], first_s)
        marks.append((at_s, f"{effect.id}: {effect.sentence}", "INFO"))
    marks += [(event.from_s, f"Event: {event_label(event)}", "ERROR") for event in trace.events]
    if circles:
        width = rr.Radius.ui_points(2.0)
        stream.log(f"{part}/map/place", rr.LineStrips3D(circles, radii=width, colors=blueprint.PURPLE), static=True)
    for at_s, text, level in sorted(marks):
        step = int(np.searchsorted(trace.times_s, at_s))
        stream.set_time(blueprint.CAR_TIME, duration=at_s)
        stream.set_time(blueprint.STEP, sequence=step)
        stream.log(f"{part}/marks", rr.TextLog(text, level=level))


def _blueprint(parts: list[str], figure_data: FigureData) -> rrb.Blueprint:
    tabs = [_tab(part, trace) for part, trace in zip(parts, figure_data.traces, strict=True)]
    verdict = rrb.TextDocumentView(origin=f"/{VERDICT}", name="Verdict")
    return rrb.Blueprint(
        rrb.Tabs(*tabs, verdict, active_tab=0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=blueprint.CAR_TIME),
        auto_views=False,
    )


def _tab(part: str, trace: Trace) -> rrb.Horizontal:
    """Plan, marks and verdict on the left; series and residuals on the right."""
    residuals = (
        []
        if not trace.predicted
        else [
            rrb.TimeSeriesView(
                origin=f"/{part}/residual/{channel}", name=f"Error of {channel.replace('_', ' ')} [{unit}]"
            )
            for channel, unit in UNITS.items()
            if channel in ("position", "yaw_rate")
        ]
    )
    series = [
        rrb.TimeSeriesView(origin=f"/{part}/state/{channel}", name=f"{channel.replace('_', ' ')} [{UNITS[channel]}]")
        for channel in CHANNELS
    ]
    return rrb.Horizontal(
        rrb.Vertical(
            _plan(part, trace),
            rrb.Horizontal(
                rrb.TextLogView(origin=f"/{part}/marks", name="Marks"),
                rrb.TextDocumentView(origin=f"/{VERDICT}", name="Verdict"),
            ),
            row_shares=[3, 1],
        ),
        rrb.Vertical(*series, *residuals),
        column_shares=[5, 6],
        name=trace.name,
    )


def _plan(part: str, trace: Trace) -> rrb.Spatial3DView:
    places = trace.recorded[np.isfinite(trace.recorded[:, :2]).all(axis=1), :2]
    trails = [f"{part}/map/{name}/trail" for name in ("recorded", *MODELS)]
    return blueprint.plan_view(
        f"/{part}/map", places, overrides=dict.fromkeys(trails, blueprint.so_far(blueprint.CAR_TIME))
    )
