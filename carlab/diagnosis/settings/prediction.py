"""Settings of the split into windows and of the fit of a simulator."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class WindowSettings:
    """How recordings are split and cut into prediction windows."""

    fit_window_s: float = 0.8
    """Length [s] of a window to fit: long enough for lags to show, short enough for errors to stay linear."""
    fit_stride_s: float = 0.3
    """Time [s] between the starts of windows to fit."""
    held_out_window_s: float = 1.0
    """Horizon [s] of held-out errors and of the score, as report.json states it."""
    held_out_stride_s: float = 0.25
    """Time [s] between the starts of held-out windows."""
    max_fit_windows: int = 600
    """Maximum number of windows to fit, thinned evenly; bounds the time of a diagnosis."""
    max_held_out_windows: int = 1200
    """Maximum number of held-out windows, thinned evenly."""
    min_fit_s: float = 8.0
    """Minimum driving time [s] to fit; shorter recordings are inconclusive."""
    default_held_out_share: float = 0.3
    """Last share of each recording that is held out if no recordings are given as held out."""
    max_held_out_share: float = 0.5
    """Maximum held-out share."""
    split_guard_s: float = 0.5
    """Gap [s], in addition to one horizon, between the part to fit and the held-out part (history of commands)."""
    unusable_share: float = 0.5
    """The verdict is "data" if faults leave less than this share of the driving usable."""
    min_speed_mps: float = 0.2
    """The 90 % quantile of the speed [m/s] must reach this for a verdict."""
    min_command_std: float = 0.01
    """A command with a lower standard deviation counts as constant."""


@dataclass(frozen=True, slots=True)
class IdentificationSettings:
    """Fit of a simulator to windows, noise of the recordings, and the window of their velocities."""

    huber_delta: float = 4.0
    """Whitened error [standard deviations] from which Huber's loss is linear (Huber 1964)."""
    loss_steps: int = 6
    """Steps of a window whose errors enter the loss."""
    compared_tolerance: float = 0.02
    """A fit that is only compared with another model ends when an iteration lowers its cost by less than this share of
    the difference of their costs, which is then known to a few per cent (docs/decisions/0045)."""
    max_fold_step: float = 4.0
    """Maximum step of a coordinate when a fold is removed from a fit."""
    fold_step_shares: tuple[float, ...] = (1.0, 0.5, 0.2)
    """Shares of that step that are evaluated; the share with the smallest loss on the other folds is used."""
    prior_std_share: float = 0.3
    """Prior standard deviation of a base parameter without a range, as a share of the car file's value."""
    prior_change_share: float = 0.05
    """Standard deviation of a base parameter between two recordings of a car, as a share of its value. It widens a
    prior from an earlier diagnosis: battery, tyres and floor change by a few per cent from day to day."""
    latency_std_s: float = 0.01
    """Prior standard deviation [s] of a latency of motion capture that the car file does not state. Camera systems over
    a network have 3 to 30 ms."""
    max_latency_s: float = 0.15
    """Maximum latency [s] of motion capture."""
    delay_std_s: float = 0.03
    """Prior standard deviation [s] of the command delay after a repair of a clock offset, which is accurate to about a
    row."""
    max_added_delay_s: float = 0.2
    """Maximum command delay [s] after such a repair in addition to that of the car file."""
    min_noise_std: tuple[float, ...] = (1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4)
    """Minimum noise of x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s]: keeps weights of noise-free data finite."""
    min_power_share: float = 0.5
    """Share of noise power that the residual of the local cubic must keep for its spectrum to be used."""
    noise_max_z: float = 3.0
    """Residuals are clipped here [robust standard deviations]; larger ones are motion faster than the cubic."""
    noise_segment_rows: int = 64
    """Minimum rows of a segment of Welch's spectrum (Welch 1967)."""
    noise_segment_s: float = 1.0
    """Minimum length [s] of a segment: its resolution of 1 Hz is finer than the edge of the cubic's filter (5 Hz)."""
    slowest_share: float = 0.3
    """Share of the slowest rows, which give the noise of a car whose wheels vibrate."""
    max_error_quantile: float = 0.99
    """Quantile at which errors of initial states are clipped: a window at the edge of a spin contains no noise."""
    velocity_max_period_s: float = 0.06
    """Maximum period [s] at which velocities can be estimated from differences of poses."""
    velocity_max_width_s: float = 0.25
    """Maximum width [s] of a velocity window, as a box."""
    velocity_z_min: float = 3.0
    """Minimum variance of the velocity window [standard errors]."""
    filter_ratio_min: float = 1.2
    """Minimum ratio of the unexplained variances of the velocities without and with a filter, both with a dead time.
    Without a filter it is at most 1.09 in recordings of the ETH and the DART car (docs/decisions/0052)."""
    filter_channel_ratio_min: float = 1.05
    """The same for each channel, because a filter of the velocities acts on all of them."""
    filter_unexplained_max: float = 0.1
    """Maximum share of the variance of a velocity that the filter leaves; above it, the velocity is not that of the
    poses."""
    filter_change_min_s: float = 0.005
    """[s] Minimum difference of a measured time constant from that of the car file, or from 0."""
    filter_smoothing_s: float = 0.08
    """[s] Standard deviation of the Gaussian that smooths velocities before the comparison: motion below 2 Hz."""
    filter_min_rows: int = 200
    """Minimum number of rows for this comparison; the car moves, and the segment has a history before them."""
    curve_std: float = 10.0
    """Prior standard deviation of a measured curve's deviations, in typical sizes: keeps knots without data at 0."""
    curve_roughness_std: float = 1.0
    """The same for its changes of slope; held-out errors hardly depend on it between 0.1 and 1."""
    max_batch_sets: int = 24
    """Maximum number of parameter sets that are simulated in one batch; bounds the memory of a Jacobian."""
    velocity_min_samples: int = 50
    """Minimum number of samples of the regression of the velocity window."""
    joint_max_noise_ratio: float = 1.2
    """Maximum variance of the errors with the best initial states, over that of the measurement noise, for a joint fit
    of parameters and initial states. It is below 1 with the true effects, and mostly above 1.3 if a large effect
    is missing (docs/decisions/0023)."""


@dataclass(frozen=True, slots=True)
class CurveSettings:
    """Fit of measured curves, and what a recording supports."""

    min_unexplained_share: float = 0.1
    """Share of the refit's squared excess that named effects must leave, so that curves are fitted."""
    max_windows: int = 200
    """Windows of the first fit and of the removal of curves; the last fit uses all."""
    first_iterations: int = 30
    iterations: int = 12
    last_iterations: int = 8
    """Maximum iterations of the first fit, of the last fit, and with the updated error scale or without one curve. With
    10, 4 and 3 a fit without a curve had more iterations than the fit with it, so the comparison favoured removal."""
    tolerance: float = 1e-3  # relative fall of the cost at which a fit ends
    keep_z_min: float = 0.0
    """Minimum rise of the loss on left-out blocks without a curve that is kept [standard errors]. At 0, a curve stays
    unless it worsens the prediction."""
    accept_z_min: float = 3.0
    """Minimum fall of the loss on left-out blocks with all curves [standard errors]."""
    min_support_s: float = 0.5
    """Minimum driving time [s] near a knot; without it the curve ends there in the report."""
    min_fitted_s: float = 0.05
    """The same for a knot whose fitted deviation is used; others have that of the nearest such knot."""
    form_level: float = 0.01
    """A named form lies within the band of a curve if a misfit as large has at least this probability."""
    form_min_spare_knots: int = 2
    """Minimum number of knots with data in addition to a form's parameters."""
    form_chi2_per_parameter: float = 4.0
    """Fall of the misfit for which a form may have one more parameter."""
    form_tie_chi2: float = 4.0
    """Forms within the band whose misfits with that penalty differ by less are indistinguishable."""
    form_points_per_interval: int = 8
    """Points of each interval between knots at which a form is approximated by a piecewise linear curve."""
