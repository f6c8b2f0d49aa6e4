"""A car made of an actuator and motion capture: real, or emulated on the wire."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from carlab.core.car import Car
from carlab.core.clock import Clock, MonotonicClock
from carlab.core.errors import NotOpenError, NotReadyError, PoseLostError
from carlab.core.pose_source import PoseSource
from carlab.core.quantities import Action, ActionLimits, CarState, Health, Observation, PoseSample, Reality
from carlab.core.state_estimator import StateEstimator
from drivers.actuator import Actuator
from drivers.config import HardwareConfig

POSES_KEPT = 4096
PLACE_TIMEOUT_S = 1.0
ARM_WAIT_S = 0.5
"""How long arming waits for poses that are fresh, and enough to know a speed from, before it gives up."""
CAPTURE_STAMP_ERROR_S = 0.005
"""How far a capture stamp, carried over from the camera's clock, may be ahead of the host's."""


class HardwareCar(Car):
    """Actuator, pose source and state estimator behind the one contract.

    Args:
        name: Name of the car.
        actuator: Where commands go.
        pose_source: Where poses come from; opened and closed with the car.
        estimator: Makes states of poses.
        config: When the car may be armed.
        reality: REAL, or EMULATED where the wire ends in emulators.
        limits: Largest commands that are accepted.
        clock: The clock of poses and commands; the host's monotonic one unless given.
        place: Puts an emulated car somewhere; returns whether it could.
    """

    def __init__(
        self,
        name: str,
        actuator: Actuator,
        pose_source: PoseSource,
        estimator: StateEstimator,
        *,
        config: HardwareConfig | None = None,
        reality: Reality = Reality.REAL,
        limits: ActionLimits | None = None,
        clock: Clock | None = None,
        place: Callable[[CarState], bool] | None = None,
    ) -> None:
        self.name = name
        self.actuator = actuator
        self.pose_source = pose_source
        self.estimator = estimator
        self.config = HardwareConfig() if config is None else config
        self.reality = reality
        self.limits = ActionLimits() if limits is None else limits
        self.clock: Clock = MonotonicClock() if clock is None else clock
        self._place = place
        self._is_open = False
        self._placed_s = float("-inf")
        self._sequence = -1
        self._newest: PoseSample | None = None
        self._unseen: deque[PoseSample] = deque(maxlen=POSES_KEPT)

    def open(self) -> None:
        """Open motion capture and actuator; raises NotReadyError with the reasons of both."""
        if self._is_open:
            return
        reasons: list[str] = []
        for part in (self.pose_source, self.actuator):
            try:
                part.open()
            except NotReadyError as error:
                reasons.append(str(error))
        if reasons:
            self.close()
            raise NotReadyError(f"{self.name} is not ready", reasons)
        self.estimator.reset()
        self._placed_s = float("-inf")
        self._sequence = -1
        self._newest = None
        self._unseen.clear()
        self._is_open = True

    def observe(self) -> Observation:
        """Newest state and the raw poses since the last call; ``tracked`` is that of the newest sample."""
        self._require_open()
        self._take_poses()
        estimate = self.estimator.estimate()
        newest, seen = self._newest, self.estimator.newest
        if estimate is None or newest is None or seen is None:
            raise PoseLostError(
                "Motion capture has not seen the body yet; check that its markers are visible and its id is right."
            )
        state, delay_s = estimate
        poses = tuple(self._unseen)
        self._unseen.clear()
        return Observation(
            state,
            seen.t_capture_s,
            seen.t_receive_s,
            seen.sequence,
            newest.tracked,
            delay_s,
            poses,
            self.estimator.velocity_valid,
            self._motor_is_turning(),
        )

    def arm(self) -> None:
        """Arm the actuator if it, motion capture and the standstill of the car allow it.

        Poses that are late for a moment, as on a host that is busy, are waited for (half a second at most).
        """
        self._require_open()
        self.actuator.require_no_fault()
        self._await_poses()
        reasons = [*self.actuator.problems(), *self._pose_problems()]
        estimate = self.estimator.estimate()
        if estimate is not None and not self.estimator.velocity_valid:
            reasons.append("too few poses have come to know whether the car stands; try again at once.")
        elif estimate is not None and not (speed_mps := estimate[0].speed_mps) <= self.config.arm_max_speed_mps:
            reasons.append(f"the car moves at {speed_mps:.2f} m/s; wait until it stands still.")
        erpm = abs(self.actuator.status().erpm)
        if math.isnan(erpm):
            reasons.append("the motor controller has not said how fast the motor turns; check its app settings.")
        elif erpm > self.config.arm_max_erpm:
            reasons.append(f"the motor turns at {erpm:.0f} eRPM; wait until it stands still.")
        if reasons:
            raise NotReadyError(f"{self.name} cannot be armed", reasons)
        self.actuator.arm()

    def command(self, action: Action) -> Action:
        """Check and hand over; returns what will be on the wire."""
        self._require_open()
        self.check(action)
        return self.actuator.command(action)

    def stop(self, *, planned: bool) -> None:
        """Neutral at least three times, and disarm."""
        self.actuator.stop(planned=planned)

    def reset_fault(self) -> None:
        """Clear a latched fault; raises ActuatorFaultError where the cause persists."""
        self._require_open()
        self.actuator.reset_fault()

    def health(self) -> Health:
        """Actuator, firmware and motion capture in one."""
        if not self._is_open:
            return Health(False, (f"{self.name} is not open.",))
        actuator = self.actuator.health()
        problems = (*actuator.problems, *self._pose_problems())
        readings = {**actuator.readings, **{f"mocap_{k}": v for k, v in self.pose_source.statistics().items()}}
        return Health(not problems, problems, readings)

    def place(self, state: CarState) -> bool:
        """Ask the emulator, where there is one, and wait for a pose taken after that (a second at most).

        Poses taken before, which are still on their way, no longer count; the estimator starts anew.
        """
        if self._place is None or not self._place(state):
            return False
        self._placed_s = self.clock.now_s() + CAPTURE_STAMP_ERROR_S
        self.estimator.reset()
        sequence, until_s = self._sequence, self.clock.now_s() + PLACE_TIMEOUT_S
        while (left_s := until_s - self.clock.now_s()) > 0.0:
            sample = self.pose_source.wait_for(sequence, left_s)
            if sample is None or sample.t_capture_s > self._placed_s:
                break
            sequence = sample.sequence
        return True

    def close(self) -> None:
        """Neutral, then disconnect both; the second is closed whatever the first one does."""
        self._is_open = False
        try:
            self.actuator.close()
        finally:
            self.pose_source.close()

    def _motor_is_turning(self) -> bool | None:
        """Whether the measured motor speed is above that at which the car may be armed; None if it is not measured."""
        erpm = self.actuator.status().erpm
        return None if math.isnan(erpm) else abs(erpm) > self.config.arm_max_erpm

    def _await_poses(self) -> None:
        """Take poses until they say whether the car stands, or none comes any more."""
        until_s = self.clock.now_s() + ARM_WAIT_S
        self._take_poses()
        while self._pose_problems() or not self.estimator.velocity_valid:
            left_s = until_s - self.clock.now_s()
            if left_s <= 0.0 or self.pose_source.wait_for(self._sequence, left_s) is None:
                break
            self._take_poses()

    def _take_poses(self) -> None:
        """Feed the estimator with what has arrived; a source that counts anew is followed."""
        latest = self.pose_source.latest()
        if latest is not None and latest.sequence < self._sequence:
            self._sequence = latest.sequence - 1
        for sample in self.pose_source.since(self._sequence):
            if sample.t_capture_s > self._placed_s:
                self.estimator.update(sample)
            self._unseen.append(sample)
            self._sequence = sample.sequence
            self._newest = sample

    def _pose_problems(self) -> list[str]:
        newest = self.pose_source.latest()
        if newest is None:
            return ["motion capture has sent no pose yet; check its software, the network and the body's id."]
        age_s = self.clock.now_s() - newest.t_receive_s
        if age_s > self.config.arm_max_pose_age_s:
            return [f"the newest pose is {age_s:.1f} s old; check the motion-capture software and the network."]
        if not newest.tracked:
            return ["motion capture does not see the body; check its markers and the capture volume."]
        return []

    def _require_open(self) -> None:
        if not self._is_open:
            raise NotOpenError(f"{self.name} is not open; call open() first, or use it in a with block.")
