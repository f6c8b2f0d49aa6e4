"""Reasons for the end of an episode; each value is the sentence for the user, with the remedy."""

from __future__ import annotations

import enum


class EndReason(enum.Enum):
    """Reason for the end of an episode. Recordings store the name; users read the value."""

    COMPLETED = "All ticks of the episode were driven."
    GOAL_REACHED = "The goal was reached."
    TASK_ENDED = "The task ended the episode, for example because the car left the track."
    POLICY_FINISHED = "The script has ended."
    STOP_REQUESTED = "Stopped on request; the recording up to here is complete."
    DEADMAN_RELEASED = "The dead-man control was released; hold it while driving."
    EMERGENCY_STOP = "Emergency stop; check the car, then start and arm it again."
    GEOFENCE = (
        "The car could not have stopped inside the arena; move it back inside, drive slower (--max-throttle), or "
        "enlarge the arena (that of the car file, else that of the task)."
    )
    OVERSPEED = "The car was faster than its speed limit; lower the throttle or raise max_speed_mps."
    POSE_STALE = (
        "Motion capture sends no fresh poses; check the camera software, the network and that the body is visible."
    )
    POSE_JUMP = "The pose jumped further than the car can drive; check that Motive confuses no other body with the car."
    POSE_FROZEN = "The pose did not change while the motor turned; check that motion capture streams live poses."
    TRACKING_LOST = "Motion capture lost the body; check the markers and the capture volume."
    NOT_READY = "The car could not be armed and was not driven; see the reasons and start again."
    ACTUATOR_FAULT = "The actuator link or its firmware failed; check power, cable and the log, then start again."
    LATE_LOOP = (
        "Too many ticks were late; close other programs, make a slow policy or task faster, or lengthen control_period."
    )
    BAD_COMMAND = "The policy returned a command that is not a number; retrain it or use an earlier policy."
    POLICY_ERROR = "The policy raised an error; see the log."
    TASK_ERROR = "The task raised an error or gave a reward that is not a number; correct its file."
    RECORDER_ERROR = "The recording could not be written; free some disk space and check the folder's permissions."
    LOOP_HUNG = "The control loop hung and the watchdog thread stopped the car; see the log."
    CRASHED = "The program ended during the episode; the recording is complete up to that point."

    @property
    def is_safety_stop(self) -> bool:
        """Whether the car was stopped for safety, and not by a regular end of the episode."""
        return self not in (
            EndReason.COMPLETED,
            EndReason.GOAL_REACHED,
            EndReason.TASK_ENDED,
            EndReason.POLICY_FINISHED,
            EndReason.STOP_REQUESTED,
        )

    def sentences(self, detail: str = "") -> str:
        """The sentence for the user, with the detail as a sentence of its own."""
        return f"{self.value} {detail[:1].upper()}{detail[1:]}".rstrip()

    def texts(self, detail: str = "") -> dict[str, str]:
        """Name, sentence and detail of this end, for the metadata of an episode."""
        return {"end_reason": self.name, "end_sentence": self.value, "end_detail": detail}
