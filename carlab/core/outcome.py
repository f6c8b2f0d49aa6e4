"""How an episode ended: each value is the sentence shown to the user, with the remedy in it."""

from __future__ import annotations

import enum


class EndReason(enum.Enum):
    """Why an episode ended. The name is what recordings store; the value is what people read."""

    COMPLETED = "All ticks of the episode were driven."
    GOAL_REACHED = "The goal was reached."
    POLICY_FINISHED = "The script came to its end."
    STOP_REQUESTED = "Stopped on request; the recording up to here is complete."
    DEADMAN_RELEASED = "The dead-man control was released; hold it while driving."
    EMERGENCY_STOP = "Emergency stop; look at the car, then start again (it must be armed anew)."
    GEOFENCE = "The car could not have stopped inside the arena; move it back inside, or enlarge [hardware.arena]."
    OVERSPEED = "The car was faster than its speed limit; lower the throttle or raise max_speed."
    POSE_STALE = "Motion capture went silent; check the camera software, the network and that the body is visible."
    POSE_JUMP = "The pose jumped further than the car can drive; check that no other body is taken for it in Motive."
    POSE_FROZEN = "The pose did not change while the motor turned; check that the motion-capture software is live."
    TRACKING_LOST = "Motion capture lost sight of the body; check the markers and the capture volume."
    NOT_READY = "The car could not be armed; nothing was driven."
    ACTUATOR_FAULT = "The actuator link or its firmware failed; check power, cable and the log, then start again."
    LATE_LOOP = "Too many ticks came too late; close other programs or lengthen control_period."
    BAD_COMMAND = "The policy gave a command that is not a number; retrain it or go back to an earlier one."
    POLICY_ERROR = "The policy raised an error; the log has it."
    RECORDER_ERROR = "The recording could not be written; free some disk space and check the folder's permissions."
    LOOP_HUNG = "The control loop hung and was stopped from outside; the log says where it stood."
    CRASHED = "The program ended in the middle of the episode; what was recorded until then is kept."

    @property
    def is_safety_stop(self) -> bool:
        """True where the car was stopped for safety rather than because the episode was over."""
        return self not in (
            EndReason.COMPLETED,
            EndReason.GOAL_REACHED,
            EndReason.POLICY_FINISHED,
            EndReason.STOP_REQUESTED,
        )
