"""Settings of the adaptation of a simulator to the recent past."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class AdaptationSettings:
    """Filter of the disturbances, its noise, and the weights of its candidates.

    Chosen by cross-validation on four drives of one real car (DART, 16 September): a simulator was fitted to three of
    them and adapted along the fourth. The noise is chosen by likelihood on the fitted recordings of each car.
    """

    window_s: float = 0.3
    """Length [s] of the windows that measure the disturbances, one after the other. 0.6 s is 2 % worse."""
    drift_std: tuple[float, ...] = (0.3, 0.05, 0.3, 0.3)
    """Stationary standard deviations of the share of the drive force [1], the steering trim [rad], the share of the
    grip [1] and the force forward per mass [m/s2]: a battery, a repaired steering linkage, another floor."""
    time_constants_s: tuple[float, ...] = (10.0, 100.0, 1000.0)
    """Time constants [s] of the candidates: from a car that warms up to one that differs from the first row on."""
    white_std: tuple[float, ...] = (0.3, 0.05, 0.3, 0.3, 0.3, 1.5)
    """Unit of the white noise on the same disturbances, on the force to the left per mass [m/s2] and on the moment per
    yaw inertia [rad/s2]: errors of the simulator that are independent between windows, larger in harder driving."""
    white_shares: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
    """Sizes of that noise; the one with the highest likelihood is used."""
    error_shares: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)
    """Sizes of the error after a window in addition to that noise, in units of the error in calm windows."""
    calm_quantile: float = 0.25
    """Quantile of the absolute errors that gives the error in calm windows."""
    dof: float = 4.0
    """Degrees of freedom of the Student t distribution of errors; from 2 to 10 the results differ by 1 %."""
    linearisations: int = 3
    """Number of passes of the filter, each linearised at the estimates of the pass before."""
    weight_memory_s: float = 10.0
    """Time constant [s] with which past errors of the candidates lose weight: two blocks of 5 s."""
    weight_horizon_s: float = 1.0
    """Horizon [s] of these errors, that of held-out errors. Errors after ``window_s`` would favour a candidate whose
    error grows faster."""
    weight_dependence_s: float = 3.0
    """Time [s] within which errors count as one, because they are dependent. 1 s is 2 % worse, 10 s 1 %."""
    weight_stride_s: float = 0.25
    """Time [s] between the starts of the windows that weigh the candidates."""
    local_neighbours: int = 30
    """Number of past windows that give the expected error of a prediction; bounds the time."""
    local_length: float = 2.0
    """Length scale of the kernel over the state, in standard deviations of the states of the fitted recordings."""
    local_noise: float = 0.5
    """Variance of an error about its expectation, over that of the expectation. From 0.3 to 1 the results differ by
    1 %."""
    limits: tuple[float, ...] = (0.9, 0.4, 0.9, 10.0, 10.0, 100.0)
    """Maximum size of each disturbance in a simulation [1, rad, 1, m/s2, m/s2, rad/s2]."""
    steps: tuple[float, ...] = (0.05, 0.01, 0.05, 0.1, 0.1, 0.5)
    """Finite differences of the Jacobian [same units]."""
    max_error: float = 100.0
    """Bound of an error [m, rad, m/s, rad/s]; it also replaces errors of a diverged simulator."""


ADAPTATION = AdaptationSettings()
