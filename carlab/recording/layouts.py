"""Known layouts of CSV files, recognised by their header."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence

from carlab.core.errors import DataError
from carlab.recording.column_mapping import CHANNELS, ColumnMapping, ColumnSource, missing_columns

CANONICAL = ColumnMapping({name: ColumnSource(name) for name in CHANNELS}, layout="canonical")
"""carlab's own CSV: SI units, velocities in the body frame, steering positive to the left."""

# lasgroup/simulation_transfer, recordings_rc_car_v0. Declared, each checked on both files:
# - vx_world, vy_world are in the world frame: median difference to the differentiated pose 0.004 m/s there, against
#   0.5 to 1 m/s if read as body velocities.
# - all velocities are backward differences of the pose: their difference to its derivative is smallest with a shift of
#   half a period, so they are half of the nominal 1/30 s late.
# - yaw_rate: a negative spike of 85 to 245 rad/s in each of the 14 + 9 rows where yaw passes 0 counter-clockwise, none
#   clockwise: a difference of an angle in [0, 2 pi) whose wrap was handled on one side only. The pose there is clean.
# - steering is positive to the left and throttle positive forward already: nothing to flip.
ETH = ColumnMapping(
    {
        **CANONICAL.columns,
        "vx": ColumnSource("vx_world"),
        "vy": ColumnSource("vy_world"),
    },
    layout="eth",
    velocity_frame="world",
    velocity_lag_s=0.5 / 30.0,
    repair_yaw_rate=True,
)

# Lorenzo-Lyons/DART. Declared:
# - the pose is Vicon's, stamped by "vicon time" when it arrived: read on an even 100 Hz instead, what a local cubic
#   leaves of x and y falls by a tenth to two fifths in each of the files. Sensors and commands come at 10 Hz and are
#   repeated in these rows.
# - commands are sent at 10 Hz and held (racecar_pkg/src/system_id_gamepad_universal.py), and the logger copies the
#   newest at 10 Hz of its own (publish_sensors_and_inputs_universal.py): a row is 0 to 0.1 s behind what was sent, by
#   a phase that stays for a recording; 0.05 s on average. Uncorrected, the acceleration comes before the throttle.
# - the car multiplies the throttle by the dead-man's safety value (their ROS_packages/racecar_pkg/src/
#   racecar_universal.py: car.throttle = throttle * safety_value); the steering acts regardless. In 70_racetrack_lap
#   the logged throttle is 0.25 for 676 rows in which the car stands still and safety_value is 0.
# - "vel encoder" and "W (IMU)" are filtered measurements of vx and yaw rate: used for comparison only.
_DART_COMMANDS = {"steering": ColumnSource("steering"), "throttle": ColumnSource("throttle")}
DART = ColumnMapping(
    {
        "t": ColumnSource("vicon time", unit="s"),
        "x": ColumnSource("vicon x", unit="m"),
        "y": ColumnSource("vicon y", unit="m"),
        "yaw": ColumnSource("vicon yaw", unit="rad"),
        **_DART_COMMANDS,
    },
    layout="dart",
    throttle_gate="safety_value",
    references={"vel encoder": "vx", "W (IMU)": "yaw_rate"},
    clock="even",
    command_lag_s=0.05,
)
DART_ONBOARD = ColumnMapping(
    {
        "t": ColumnSource("elapsed time sensors", unit="s"),
        "vx": ColumnSource("vel encoder", unit="m/s"),
        "yaw_rate": ColumnSource("W (IMU)", unit="rad/s"),
        **_DART_COMMANDS,
    },
    layout="dart on-board",
    throttle_gate="safety_value",
    dead_reckoning=True,
)
_QUATERNION = re.compile(r"(orientation|rotation|quat)\w*[._ ]?w$|^q[._]?w$", re.IGNORECASE)
"""Name of a column with the scalar part of an orientation, as motion capture and ROS export it."""
_ORDER = (ETH, CANONICAL, DART, DART_ONBOARD)  # an export of DART data has the canonical layout and further columns


def _n_present(mapping: ColumnMapping, header: Sequence[str]) -> int:
    """Number of columns of ``mapping`` in ``header``."""
    return sum(source.name in header for source in mapping.columns.values())


def recognise_layout(header: Sequence[str], where: str, rate_hz: float | None = None) -> ColumnMapping:
    """The preset whose columns ``header`` holds; with a row rate [Hz], the time column may be missing.

    Raises DataError that names what is missing and the remedy.
    """
    presets = [preset.with_options(rate_hz=rate_hz) for preset in _ORDER]
    for preset, mapping in zip(_ORDER, presets, strict=True):
        particular = [preset.columns[c].name for c in ("vx", "vy") if preset is ETH]
        if not missing_columns(mapping, header) and all(name in header for name in particular):
            return preset if rate_hz is None else mapping
    nearest = min(presets, key=lambda mapping: (len(missing_columns(mapping, header)), -_n_present(mapping, header)))
    lacking = missing_columns(nearest, header)
    names = [source.name for source in nearest.columns.values()]
    spare = [name for name in header if name not in names]
    has_quaternion = "yaw" in lacking and any(_QUATERNION.search(name) for name in header)
    wanted = [name for name in lacking if name != "yaw" or not has_quaternion]
    near = difflib.get_close_matches(wanted[0].split(" (")[0], spare, n=1, cutoff=0.4) if wanted else []
    hint = f" (is it '{near[0]}'?)" if near else ""
    lacks_time_only = rate_hz is None and len(lacking) == 1 and nearest.columns["t"].name not in header
    steps = "give the rate of the rows with --rate, " if lacks_time_only else ""
    if has_quaternion:
        steps += "compute yaw from the quaternion as atan2(2 (w z + x y), 1 - 2 (y^2 + z^2)), "
    raise DataError(
        f"{where} has no column {', '.join(lacking)}{hint}; it holds {', '.join(header)}; "
        f"{steps}say which column is which with carlab import --mapping FILE.toml, or add the column."
    )
