"""Noise of recordings as a diagnosis estimated it; ``model.toml`` keeps it in the table ``[recording_noise]``."""

from __future__ import annotations

import itertools
import math
from dataclasses import asdict, dataclass
from typing import Any

from carlab.core.errors import ConfigError
from carlab.core.quantities import STATE_NAMES

StateStd = tuple[float, float, float, float, float, float]
FeatureStd = tuple[float, float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class AdaptationNoise:
    """Noise with which a simulator adapts to the recent past of a drive, chosen on the fitted recordings.

    Attributes:
        error_std: error after a short prediction in calm driving: x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s].
        white_share: size of the white noise on the disturbances of the simulator, in units of the settings.
        loss_std: robust spread of the errors after the horizon of held-out errors, in the units of ``error_std``.
        feature_std: standard deviations of vx, vy [m/s], yaw rate [rad/s], steering, throttle, mean steering and mean
            throttle of a window.

    Raises:
        ConfigError: a number is not above 0.
    """

    error_std: StateStd
    white_share: float
    loss_std: StateStd
    feature_std: FeatureStd

    def __post_init__(self) -> None:
        for value in (*self.error_std, self.white_share, *self.loss_std, *self.feature_std):
            if not 0.0 < value < math.inf:
                raise ConfigError(f"A number in [recording_noise.adaptation] is {value:g}; it must be > 0.")


@dataclass(frozen=True, slots=True)
class RecordingNoise:
    """Noise and velocity window of the recordings that a model was fitted to.

    Attributes:
        measured_std: standard deviations of measured x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s].
        initial_state_std: the same of estimated initial states.
        velocity_window_s2: variance of the time window of the velocity columns [s2]; 0 without a window.
        floor_std: noise floor: error of a perfect simulator after ``floor_horizon_s``, in the units of
            ``measured_std``; None if unknown.
        floor_horizon_s: horizon of the noise floor [s].
        adaptation: noise of the adaptation; None if the diagnosis did not adapt.

    Raises:
        ConfigError: a standard deviation is not above 0, or the variance of the time window is out of range.
    """

    measured_std: StateStd
    initial_state_std: StateStd
    velocity_window_s2: float
    floor_std: StateStd | None = None
    floor_horizon_s: float = 0.0
    adaptation: AdaptationNoise | None = None

    def __post_init__(self) -> None:
        every = (*self.measured_std, *self.initial_state_std, *(self.floor_std or ()))
        for name, std in zip(itertools.cycle(STATE_NAMES), every, strict=False):
            if not 0.0 < std < math.inf:
                raise ConfigError(f"The standard deviation of {name} in [recording_noise] is {std:g}; it must be > 0.")
        if not 0.0 <= self.velocity_window_s2 < 1.0:
            raise ConfigError(
                f"velocity_window_s2 in [recording_noise] is {self.velocity_window_s2:g}; it must be from 0 to 1 s2."
            )

    def floor_after(self, horizon_s: float) -> StateStd | None:
        """The noise floor after a horizon; None if it is that of another horizon."""
        return self.floor_std if math.isclose(self.floor_horizon_s, horizon_s, rel_tol=1e-3) else None

    def to_table(self) -> dict[str, Any]:
        """The content of the table, without unknown entries."""
        return {name: value for name, value in asdict(self).items() if value is not None}
