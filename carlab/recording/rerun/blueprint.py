"""Entity paths of carlab's rerun recordings, their styles, and the layout of the viewer.

A path that has an MCAP topic is the topic without its first slash. The plan view is a three-dimensional view from
above, since rerun's two-dimensional views have y downwards, which would mirror every turn.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from carlab.core.documents import EpisodeStarted
from carlab.core.quantities import FloatArray

CAR_TIME = "car_time"
STEP = "step"
EPISODE = "episode"

MAP = "map"
ARENA = "map/arena"
GOAL = "map/goal"
PATH = "map/path"
TRAIL = "map/trail"
CAR = "map/base_link"
POSES = "mocap/pose"
SAFETY_STATE = "safety/state"
SAFETY_EVENT = "safety/event"
END = "episode/end"
LOG = "log"
HEALTH = "car/health"
OVERLAY = "overlay"
REWARD = "episode/transition/reward"

CAR_SIZE_M = (0.42, 0.19, 0.12)
"""Length, width and height of the drawn car [m]: a race car of scale 1:10."""

# Okabe and Ito's palette, which suits colour-blind readers (https://jfly.uni-koeln.de/color/).
ORANGE, SKY, GREEN, YELLOW = (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66)
BLUE, VERMILION, PURPLE, GREY = (0, 114, 178), (213, 94, 0), (204, 121, 167), (150, 150, 150)
OVERLAY_COLORS = (ORANGE, PURPLE, YELLOW, GREEN)

STATES = {"disarmed": GREY, "armed": GREEN, "paused": ORANGE, "fault": VERMILION}
"""Colours of the states of the safety gate, by their names in ``carlab.core.safety.SafetyState``."""

SERIES: dict[str, tuple[str, tuple[int, int, int]]] = {
    "car/action_requested/steering": ("requested", ORANGE),
    "car/action_requested/throttle": ("requested", ORANGE),
    "car/action_sent/steering": ("sent", SKY),
    "car/action_sent/throttle": ("sent", SKY),
    "car/state/speed_mps": ("speed", GREY),
    "car/state/vx_mps": ("vx", SKY),
    "car/state/vy_mps": ("vy", PURPLE),
    "car/state/yaw_rate_radps": ("yaw rate", SKY),
    "car/state/age_ms": ("age of the pose", SKY),
    "episode/tick/late_ms": ("lateness of the tick", ORANGE),
    "episode/tick/policy_ms": ("time of the policy", PURPLE),
    REWARD: ("reward", GREEN),
}
"""Every time series: path -> (name in the legend, colour)."""


def overlay_series(name: str) -> dict[str, str]:
    """Paths of the series of one overlay, by the path of the corresponding recorded series."""
    channels = ("vx_mps", "vy_mps", "yaw_rate_radps")
    return {f"car/state/{channel}": f"{OVERLAY}/{name}/{channel}" for channel in channels}


def overlay_trail(name: str) -> str:
    """Path of the trail of one overlay in the plan view."""
    return f"{MAP}/{OVERLAY}/{name}/trail"


def overlay_car(name: str) -> str:
    """Path of the car of one overlay in the plan view."""
    return f"{MAP}/{OVERLAY}/{name}/base_link"


Logged = Collection[str] | None
"""Paths of the entities with data; None while the data are unknown."""


def drive_blueprint(points_m: FloatArray, overlays: Sequence[str] = (), logged: Logged = None) -> rrb.Blueprint:
    """Layout: plan view, safety and log on the left; commands, velocities, latencies and reward on the right.

    Args:
        points_m: Points that the plan view must show, shape (n, 2) [m]; n may be 0.
        overlays: Names of further cars drawn in addition to the recorded one.
        logged: Panels whose entities are not among these are left out.
    """
    return tabs([drive_tab(points_m, overlays, logged), link_tab(logged)])


def tabs(parts: Sequence[rrb.Container | None]) -> rrb.Blueprint:
    """Layout of tabs, without those that are None, over a time panel of ``car_time``."""
    return rrb.Blueprint(
        rrb.Tabs(*(part for part in parts if part is not None), active_tab=0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=CAR_TIME, play_state="following"),
        auto_views=False,
    )


def send_blueprint(stream: rr.RecordingStream, layout: rrb.Blueprint) -> None:
    """Make a layout the one of the recording."""
    stream.send_blueprint(layout, make_active=True, make_default=True)


def drive_tab(
    points_m: FloatArray, overlays: Sequence[str] = (), logged: Logged = None, name: str = "Drive"
) -> rrb.Container | None:
    """Tab of plan view, safety gate, texts and series of a drive; arguments as for ``drive_blueprint``."""
    safety = rrb.StateTimelineView(origin="/safety", contents=[f"/{SAFETY_STATE}"], name="Safety gate")
    left = stack(
        rrb.Vertical,
        [
            (_plan(points_m, overlays), 6),
            (safety if has(logged, SAFETY_STATE) else None, 1.2),
            (_texts("Events and log", logged), 1.8),
        ],
    )
    velocities = ["car/state/speed_mps", "car/state/vx_mps", "car/state/vy_mps"]
    right = stack(
        rrb.Vertical,
        [
            (series("Steering [-1, 1], left positive", _commands("steering"), logged), 1),
            (series("Throttle [-1, 1]", _commands("throttle"), logged), 1),
            (series("Velocity of the body [m/s]", velocities, logged, overlays), 1),
            (series("Yaw rate [rad/s]", ["car/state/yaw_rate_radps"], logged, overlays), 1),
            (stack(rrb.Horizontal, [(_latency(logged), 1), (series("Reward", [REWARD], logged), 1)]), 1),
        ],
    )
    return stack(rrb.Horizontal, [(left, 5), (right, 6)], name)


def link_tab(logged: Logged = None) -> rrb.Container | None:
    """Tab of latencies, health and log; None without data."""
    health = rrb.TimeSeriesView(origin=f"/{HEALTH}", name="Health") if has(logged, HEALTH) else None
    figures = stack(rrb.Vertical, [(_latency(logged), 1), (health, 1)])
    return (
        None
        if figures is None
        else stack(rrb.Horizontal, [(figures, 1), (_texts("Log", logged), 1)], "Latency and health")
    )


def has(logged: Logged, *paths: str) -> bool:
    """Whether any of some entities, or an entity below them, may have data."""
    return logged is None or any(entity == path or entity.startswith(f"{path}/") for path in paths for entity in logged)


def stack(
    container: type[rrb.Horizontal | rrb.Vertical], parts: Sequence[tuple[Any, float]], name: str | None = None
) -> rrb.Container | None:
    """Container of views with their shares, without those that are None; None without any view."""
    kept = [(part, share) for part, share in parts if part is not None]
    if not kept:
        return None
    shares = [share for _, share in kept]
    views = [part for part, _ in kept]
    if container is rrb.Vertical:
        return rrb.Vertical(*views, row_shares=shares, name=name)
    return rrb.Horizontal(*views, column_shares=shares, name=name)


def series(
    name: str, paths: Sequence[str], logged: Logged = None, overlays: Sequence[str] = (), **options: Any
) -> rrb.TimeSeriesView | None:
    """View of some series and the same series of overlays, with options of the view; None without data."""
    beside = [twin for overlay in overlays for path, twin in overlay_series(overlay).items() if path in paths]
    if not has(logged, *paths, *beside):
        return None
    return rrb.TimeSeriesView(origin="/", contents=[f"/{path}" for path in (*paths, *beside)], name=name, **options)


def extent_m(started: EpisodeStarted) -> FloatArray:
    """Points of arena, path and goal of an episode (n, 2) [m]."""
    outline = [*started.arena_m, *started.path_m, *([started.goal[:2]] if started.goal else [])]
    return np.array(outline, dtype=np.float64).reshape(-1, 2)


def plan_view(origin: str, points_m: FloatArray, **options: Any) -> rrb.Spatial3DView:
    """View from above on the entities below ``origin`` that shows points (n, 2) [m]; n may be 0."""
    low, high = (points_m.min(axis=0), points_m.max(axis=0)) if len(points_m) else ((-2.0, -2.0), (2.0, 2.0))
    x_m, y_m = (0.5 * float(low[k] + high[k]) for k in (0, 1))
    # The width of the view is about the height of the eye.
    height_m = 1.15 * max(float(high[0] - low[0]), float(high[1] - low[1]), 1.0)
    return rrb.Spatial3DView(
        origin=origin,
        name="Plan view [m]",
        line_grid=rrb.LineGrid3D(visible=True, spacing=0.5, stroke_width=1.0, color=[128, 128, 128, 50]),
        # The eye is slightly south of the centre, since its direction is undefined exactly above.
        eye_controls=rrb.EyeControls3D(
            kind="orbital",
            position=[x_m, y_m - 1e-4 * height_m, height_m],
            look_target=[x_m, y_m, 0.0],
            eye_up=[0.0, 1.0, 0.0],
        ),
        **options,
    )


def so_far(*timelines: str) -> rrb.VisibleTimeRanges:
    """All rows up to the cursor of a timeline."""
    start, end = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    return rrb.VisibleTimeRanges([rrb.VisibleTimeRange(timeline, start=start, end=end) for timeline in timelines])


def _plan(points_m: FloatArray, overlays: Sequence[str]) -> rrb.Spatial3DView:
    trails = (TRAIL, *(overlay_trail(name) for name in overlays))
    overrides = dict.fromkeys(trails, so_far(CAR_TIME, STEP, EPISODE))
    return plan_view(f"/{MAP}", points_m, contents=["$origin/**", f"/{POSES}"], overrides=overrides)


def _commands(channel: str) -> list[str]:
    return [f"car/action_requested/{channel}", f"car/action_sent/{channel}"]


def _latency(logged: Logged) -> rrb.TimeSeriesView | None:
    return series("Latency [ms]", ["car/state/age_ms", "episode/tick/late_ms", "episode/tick/policy_ms"], logged)


def _texts(name: str, logged: Logged) -> rrb.TextLogView | None:
    paths = (SAFETY_EVENT, END, LOG)
    return (
        rrb.TextLogView(origin="/", contents=[f"/{path}" for path in paths], name=name) if has(logged, *paths) else None
    )


def log_styles(
    stream: rr.RecordingStream, overlays: Sequence[str] = (), trail_color: tuple[int, int, int] | None = SKY
) -> None:
    """Log the static data: axes, names and colours of the series, the car's body and the style of the trails.

    With ``trail_color=None`` each row of the trail has its own colour, since static data hide those of rows.
    """
    stream.log(MAP, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for path, (name, color) in SERIES.items():
        stream.log(path, rr.SeriesLines(names=name, colors=color, widths=1.5), static=True)
    stream.log(SAFETY_STATE, rr.StateConfiguration(values=list(STATES), colors=list(STATES.values())), static=True)
    _log_body(stream, CAR, TRAIL, SKY, trail_color)
    stream.log(POSES, rr.Points3D.from_fields(radii=rr.Radius.ui_points(1.5), colors=GREY), static=True)
    for k, overlay in enumerate(overlays):
        color = OVERLAY_COLORS[k % len(OVERLAY_COLORS)]
        _log_body(stream, overlay_car(overlay), overlay_trail(overlay), color, color)
        for path, twin in overlay_series(overlay).items():
            stream.log(
                twin, rr.SeriesLines(names=f"{SERIES[path][0]} {overlay}", colors=color, widths=1.5), static=True
            )


def _log_body(
    stream: rr.RecordingStream,
    car: str,
    trail: str,
    color: tuple[int, int, int],
    trail_color: tuple[int, int, int] | None,
) -> None:
    length_m, width_m, height_m = CAR_SIZE_M
    half = [0.5 * length_m, 0.5 * width_m, 0.5 * height_m]
    body = rr.Boxes3D(half_sizes=[half], centers=[[0, 0, half[2]]], colors=color, fill_mode="solid")
    stream.log(f"{car}/body", body, static=True)
    arrow = rr.Arrows3D(
        vectors=[[0.75 * length_m, 0, 0]],
        origins=[[0, 0, 1.2 * height_m]],
        radii=0.06 * width_m,
        colors=(255, 255, 255),
    )
    stream.log(f"{car}/heading", arrow, static=True)
    stream.log(trail, rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points(1.5), colors=trail_color), static=True)
