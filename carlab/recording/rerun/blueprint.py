"""Entity paths of carlab's rerun recordings, their styles, and the layout of the viewer.

A path that has an MCAP topic is the topic without its first slash. The plan view is a three-dimensional view from
above, since rerun's two-dimensional views have y downwards, which would mirror every turn.
"""

from __future__ import annotations

from collections.abc import Sequence

import rerun as rr
import rerun.blueprint as rrb

from carlab.core.quantities import FloatArray

CAR_TIME = "car_time"
STEP = "step"

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
    "episode/transition/reward": ("reward", GREEN),
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


def drive_blueprint(points_m: FloatArray, overlays: Sequence[str] = ()) -> rrb.Blueprint:
    """Layout: plan view, safety and log on the left; commands, velocities, latencies and reward on the right.

    Args:
        points_m: Points that the plan view must show, shape (n, 2) [m]; n may be 0.
        overlays: Names of further cars drawn in addition to the recorded one.
    """
    drive = rrb.Horizontal(
        rrb.Vertical(
            _plan(points_m, overlays),
            rrb.StateTimelineView(origin="/safety", contents=[f"/{SAFETY_STATE}"], name="Safety gate"),
            _texts("Events and log"),
            row_shares=[6, 1.2, 1.8],
        ),
        rrb.Vertical(
            _series("Steering [-1, 1], left positive", ["car/action_requested/steering", "car/action_sent/steering"]),
            _series("Throttle [-1, 1]", ["car/action_requested/throttle", "car/action_sent/throttle"]),
            _series(
                "Velocity of the body [m/s]", ["car/state/speed_mps", "car/state/vx_mps", "car/state/vy_mps"], overlays
            ),
            _series("Yaw rate [rad/s]", ["car/state/yaw_rate_radps"], overlays),
            rrb.Horizontal(_latency(), _series("Reward", ["episode/transition/reward"])),
        ),
        column_shares=[5, 6],
        name="Drive",
    )
    link = rrb.Horizontal(
        rrb.Vertical(_latency(), rrb.TimeSeriesView(origin=f"/{HEALTH}", name="Health")),
        _texts("Log"),
        name="Link",
    )
    return rrb.Blueprint(
        rrb.Tabs(drive, link, active_tab=0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=CAR_TIME, play_state="following"),
        auto_views=False,
    )


def _plan(points_m: FloatArray, overlays: Sequence[str]) -> rrb.Spatial3DView:
    low, high = (points_m.min(axis=0), points_m.max(axis=0)) if len(points_m) else ((-2.0, -2.0), (2.0, 2.0))
    x_m, y_m = 0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1])
    # The width of the view is about the height of the eye.
    height_m = 1.15 * max(float(high[0] - low[0]), float(high[1] - low[1]), 1.0)
    so_far = rrb.VisibleTimeRanges(
        [
            rrb.VisibleTimeRange(
                timeline,
                start=rrb.TimeRangeBoundary.infinite(),
                end=rrb.TimeRangeBoundary.cursor_relative(),
            )
            for timeline in (CAR_TIME, STEP)
        ]
    )
    return rrb.Spatial3DView(
        origin=f"/{MAP}",
        contents=["$origin/**", f"/{POSES}"],
        name="Plan view [m]",
        line_grid=rrb.LineGrid3D(visible=True, spacing=0.5, stroke_width=1.0, color=[128, 128, 128, 50]),
        # The eye is slightly south of the centre, since its direction is undefined exactly above.
        eye_controls=rrb.EyeControls3D(
            kind="orbital",
            position=[x_m, y_m - 1e-4 * height_m, height_m],
            look_target=[x_m, y_m, 0.0],
            eye_up=[0.0, 1.0, 0.0],
        ),
        overrides=dict.fromkeys((TRAIL, *(overlay_trail(name) for name in overlays)), so_far),
    )


def _series(name: str, paths: Sequence[str], overlays: Sequence[str] = ()) -> rrb.TimeSeriesView:
    beside = [twin for overlay in overlays for path, twin in overlay_series(overlay).items() if path in paths]
    return rrb.TimeSeriesView(origin="/", contents=[f"/{path}" for path in (*paths, *beside)], name=name)


def _latency() -> rrb.TimeSeriesView:
    return _series("Latency [ms]", ["car/state/age_ms", "episode/tick/late_ms", "episode/tick/policy_ms"])


def _texts(name: str) -> rrb.TextLogView:
    return rrb.TextLogView(origin="/", contents=[f"/{SAFETY_EVENT}", f"/{END}", f"/{LOG}"], name=name)


def log_styles(stream: rr.RecordingStream, overlays: Sequence[str] = ()) -> None:
    """Log the static data: axes, names and colours of the series, the car's body and the style of the trails."""
    stream.log(MAP, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for path, (name, color) in SERIES.items():
        stream.log(path, rr.SeriesLines(names=name, colors=color, widths=1.5), static=True)
    stream.log(SAFETY_STATE, rr.StateConfiguration(values=list(STATES), colors=list(STATES.values())), static=True)
    _log_body(stream, CAR, TRAIL, SKY)
    stream.log(POSES, rr.Points3D.from_fields(radii=rr.Radius.ui_points(1.5), colors=GREY), static=True)
    for k, overlay in enumerate(overlays):
        color = OVERLAY_COLORS[k % len(OVERLAY_COLORS)]
        _log_body(stream, overlay_car(overlay), overlay_trail(overlay), color)
        for path, twin in overlay_series(overlay).items():
            stream.log(
                twin, rr.SeriesLines(names=f"{SERIES[path][0]} {overlay}", colors=color, widths=1.5), static=True
            )


def _log_body(stream: rr.RecordingStream, car: str, trail: str, color: tuple[int, int, int]) -> None:
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
    stream.log(trail, rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points(1.5), colors=color), static=True)
