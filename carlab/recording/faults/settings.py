"""Thresholds of the fault detection, one per concept, with unit and reason."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FaultSettings:
    """Thresholds that the audit of a file and the diagnosis share. Channels are in the order vx, vy, yaw rate."""

    gap_periods: float = 3.0
    """A gap is longer than this many median periods and than ``gap_s``."""
    gap_s: float = 0.1
    """[s] In that time, a car at its limit (10 m/s^2) moves 5 cm away from any interpolation."""
    clock_spread: float = 0.02
    """Interquartile range of distance / (speed * period). Above it, the velocities are not differences of the pose."""
    clock_step: float = 0.1
    """Relative error of a stamped period that counts as wrong; more than 1 % of such rows make a nominal clock."""

    moving_mps: float = 0.3
    """[m/s] Below it, velocities are compared with noise."""
    turning_radps: float = 0.3
    """[rad/s] Below it, a yaw rate is compared with noise."""
    stale_mps: float = 0.15
    """[m/s] A row that repeats the pose is stale if the car moves faster: 5 mm a row at 30 Hz, 1.5 mm at 100 Hz."""

    outlier_neighbours: int = 3
    """Rows on either side that predict a row."""
    outlier_sigmas: float = 14.0
    outlier_m: float = 0.02
    """[m] An outlier is at least this far from its prediction: more than a mount shakes between two frames."""
    outlier_rad: float = 0.10
    outlier_share: float = 0.05
    """A larger share of outliers is a property of the measurement."""

    heading_mps: float = 0.2
    """[m/s] Below it, the course over ground is noise."""
    model_car_mps: float = 40.0
    """[m/s] No model car drives faster; one at 0.04 m/s does where millimetres pass for metres."""
    heading_concentration: float = 0.6
    """Concentration of course - yaw under the right reading. Chance stays below 0.3, recordings are above 0.7."""
    heading_gain: float = 0.2
    """Gain of concentration at which another reading of yaw is accepted."""
    heading_offset_rad: float = math.radians(10.0)
    """[rad] A misplaced rigid body is off by less, another convention (yaw from north) by 90 degrees."""
    slip_rad: float = math.radians(30.0)
    """[rad] A larger angle between yaw and the mean course is not due to slip or tight turns; a smaller one in reverse
    gear is no yaw that points to the rear."""

    scale_share: float = 0.06
    """A factor this far from 1 is a fault. A filter of another kind than first order leaves 2 to 3 %."""
    unit_share: float = 0.1
    """A factor this near to that of a unit is that unit. The known units are a factor 2.8 or more apart."""
    common_scale_share: float = 0.05
    """Largest relative difference of the factors of the velocities that count as one. A wrong frame rate leaves 0.2 %,
    and noise some per cent in vy."""
    scale_unexplained: tuple[float, float] = (0.02, 0.1)
    """Unexplained variance up to which a factor is accepted: between 3/4 and 4/3, and beyond. A larger remainder next
    to a factor near 1 is a filter, vibration between the rows, or noise."""
    sign_unexplained: float = 0.25
    """Unexplained variance up to which the sign of a column is accepted (correlation 0.87)."""
    unrelated_unexplained: float = 0.9
    """Unexplained variance from which a column does not measure the motion of the pose."""
    constant_scale: float = 1e-3
    """Scale below which a velocity column does not change with the motion of the pose, as vy of wheel odometry."""
    constant_mps: float = 0.05
    """[m/s, rad/s] Such a column is a fault if the motion of the pose is larger. Noise of 2 mm leaves 0.02 m/s."""
    frame_unexplained: float = 0.05
    """Unexplained variance up to which the declared frame is accepted; lag and noise leave less."""
    frame_ratio: float = 0.3
    """Another frame is accepted if it leaves less than this share of what the declared frame leaves."""

    rotated_rad: float = math.radians(5.0)
    """[rad] Minimum rotation between velocities and pose that is a fault. A marker off the centre causes 3 degrees."""
    reversed_rad: float = math.radians(135.0)
    """[rad] Velocities that are rotated by more have wrong signs."""
    rotated_ratio: float = 0.3
    """A rotation is accepted if it leaves less than this share of the difference of velocities and pose."""

    spike_sigmas: float = 12.0
    """A spike is this far from the fit and at least ``spike_step / period``. At 8 sigma, impacts count too."""
    spike_step: tuple[float, float, float] = (0.1, 0.1, 0.25 * 2.0 * math.pi)
    """[m, m, rad] Error of a single difference. A wrapped angle makes 2 pi; a filter behind it leaves a quarter."""
    spike_tail_sigmas: float = 8.0
    """Rows within two rows of a spike belong to it if they are this far off and at least ``spike_tail``."""
    spike_tail: tuple[float, float, float] = (0.3, 0.3, 3.0)
    """[m/s, m/s, rad/s]"""
    interpolated_sigmas: float = 4.0
    """Next to interpolated poses, velocities that far off came from the faulty poses."""
    wrap_concentration: float = 0.8
    """Concentration of the yaw at the spikes of a wrapped angle."""

    command_explained: tuple[float, float] = (0.3, 0.15)
    """Share of the motion that steering and throttle explain where their sign and lag are known."""
    clear_response: float = 0.8
    """Share of the motion that a command explains where its lag is accurate to about a row."""
    early_response_s: float = 0.03
    """[s] A response this much before its command exceeds the error of the method (0.02 s); its sign means nothing."""
    constant_command: float = 0.02
    """Standard deviation of a command (full command = 1) below which it shows no effect."""

    min_limit: float = 0.1
    max_limit: float = 0.98
    """Range of the size of a limit of the commands (full command = 1). A smaller one is rest, a larger one is the full
    command."""
    limit_tolerance: float = 1e-3
    """Largest difference from the limit (full command = 1) of a command that is at it. Radios have 1000 steps."""
    limited_share: float = 0.03
    """Minimum share of rows at a limit. A largest command that is no limit has a smaller one."""
    min_limited_rows: int = 30
    """Minimum number of rows of the grid (20 ms or a period) at the limit that are compared."""
    limited_explained: float = 0.7
    """Minimum share of the motion that the command explains far from its limit, so that a fit can be compared."""
    limited_excess: float = 0.15
    limited_excess_sigmas: float = 3.0
    """Minimum excess of the motion at the limit: share of what the command causes, and standard deviations of the fit.
    A log that ends at 0.6 causes 0.29 to 0.44 and 6 to 12 for steering. Drivers who keep to 0.6 cause at most 0.09 and
    2.2."""

    offset_range_s: float = 10.0
    """[s] Largest searched offset between the clocks of commands and poses. Larger ones are errors of a date."""
    offset_range_share: float = 1.0 / 3.0
    """Largest searched offset as a share of the recording, so that two thirds of the rows can be compared."""
    offset_unexplained_ratio: float = 1.5
    """Unexplained variance at each other lag over that at the clock offset. Multiples of a period reach 1.30."""
    offset_log_likelihood: float = 12.0
    """[nat] Log-likelihood that the offset gains over each other lag. Commands of another recording reach 10.8."""
    offset_peak_s: float = 2.0
    """[s] Largest width at half height of the peak at an offset. Servo and motor make 1.5 s; commands that change every
    few seconds make more, and their peak lies anywhere in it."""
    command_delay_s: float = 0.1
    """[s] Delay with servo or motor that a proposed correction leaves; the recording does not separate it from the
    offset."""


LIMITS = FaultSettings()
