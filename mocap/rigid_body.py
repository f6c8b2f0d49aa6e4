"""One rigid body of a NatNet server as a PoseSource: ``base_link`` in ``map``, on the host's monotonic clock."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import takewhile
from statistics import median

from carlab.core.errors import NotReadyError
from carlab.core.quantities import PoseSample
from carlab.core.resource import Resource
from mocap.axes import base_link_pose, tilt_rad, z_up_quaternion, z_up_vector
from mocap.config import MocapConfig
from mocap.natnet.models import Description, Frame, Quaternion, RigidBody, RigidBodyDescription
from mocap.natnet_client import NatNetClient

MAX_SAMPLES = 1024
NORM_TOLERANCE = 0.01
TILT_LIMIT_RAD = math.radians(40.0)
HEIGHT_LIMIT_M = 0.3
MAX_MARKER_OFFSET_M = 3.0
"""Largest coordinate of a marker in the body's frame [m]: a larger body is no model car."""
MAX_POSITION_M = 500.0
"""Largest coordinate of a body [m]: no capture volume is larger."""
MAX_LATENCY_MS = 100.0
"""Largest median time from exposure to arrival [ms]: at 5 m/s a car drives half a metre in it."""
RECENT_FRAMES = 60
"""Number of newest frames in which tilted, invalid and late poses are counted: half a second at 120 Hz, so that a car
that was carried can be armed soon after it stands level again, and not while the network is congested."""
RECENT_SHARE = 0.2
"""Share of the recent frames that may be tilted, or invalid, by single errors of tracking [1]."""
EXTREME_FRAMES = 5
"""Number of newest poses whose median counts for the extremes of the position: up to two outliers in a row do not."""
BODY_REMOVED = "the server no longer has the body; define it again in Motive under the same name."


class RigidBodyPoseSource(Resource):
    """Poses of one rigid body, received in a separate thread.

    A frame in which the body is untracked, is missing, or has an invalid pose, and a frame of a recorded take, gives a
    sample with ``tracked=False`` and the last valid pose; before the first valid pose it gives the untracked pose, or
    no sample if there is none.
    ``t_capture_s`` is the time of exposure on the host's clock (see ``mocap.time_alignment``); for a server without
    clock stamps it is the time of arrival.
    """

    def __init__(self, config: MocapConfig, max_samples: int = MAX_SAMPLES) -> None:
        self.config = config
        self._client = NatNetClient(config, on_frame=self._on_frame, on_models=self._on_models)
        self._new_sample = threading.Condition()
        self._samples: deque[PoseSample] = deque(maxlen=max_samples)
        self._body: RigidBodyDescription | None = None
        self._reason_for_no_body = BODY_REMOVED
        self._selection = config
        self._is_open = False
        self._clear_counts()

    def _clear_counts(self) -> None:
        self._tracked = self._untracked = self._missing = self._unusable = 0
        self._recent_tilted: deque[bool] = deque(maxlen=RECENT_FRAMES)
        self._recent_unusable: deque[bool] = deque(maxlen=RECENT_FRAMES)
        self._recent_latency_ms: deque[float] = deque(maxlen=RECENT_FRAMES)
        self._recent_positions_m: deque[tuple[float, float, float]] = deque(maxlen=EXTREME_FRAMES)
        self._low_m = [math.inf] * 3
        self._high_m = [-math.inf] * 3

    def open(self) -> None:
        """Connect, find the body and wait for its first frame. Idempotent.

        Raises NotReadyError if the server is missing, streams no frames or does not have the body; then the message
        lists the available bodies.
        """
        if self._is_open:
            return
        self._samples.clear()
        self._body = None
        self._clear_counts()
        try:
            self._client.open()
            self._body = select_body(self._client.models or (), self.config)
            # A body that is added later must not make the only body ambiguous.
            self._selection = replace(self.config, body="" if self.config.body_id is not None else self._body.name)
            if self.wait_for(-(2**62), self.config.timeout_s) is None:
                raise NotReadyError("No motion capture", [self._why_silent()])
        except BaseException:
            self._client.close()
            raise
        self._is_open = True

    def _why_silent(self) -> str:
        numbers = self.statistics()
        if numbers["untracked"]:
            return f"the cameras do not see the body '{self._body_name}'; check its markers and the capture volume."
        if numbers["unusable"]:
            return (
                f"every pose of the body '{self._body_name}' is invalid (NaN or no unit quaternion); restart streaming "
                "in Motive."
            )
        if numbers["frames"]:
            return f"frames arrive without the body '{self._body_name}'; enable it in Motive's Assets pane."
        if self._client.failure is not None or numbers["malformed"]:
            return f"no frame can be read: {self._client.last_error}"
        if numbers["foreign"]:
            return (
                f"datagrams come from {self._client.foreign_address} and none from the server's own address: set "
                "server_address in [hardware.mocap] (listen: --server) to the Local Interface in Motive's Data "
                "Streaming pane."
            )
        return (
            f"the server answers, but no frame came within {self.config.timeout_s:g} s: is Motive live (or playing a "
            "take) and does the firewall of this computer let UDP in?"
        )

    def latest(self) -> PoseSample | None:
        """The newest sample, tracked or not; None before the first."""
        with self._new_sample:
            return self._samples[-1] if self._samples else None

    def since(self, sequence: int) -> tuple[PoseSample, ...]:
        """Samples after ``sequence``, oldest first; at most the last ``max_samples``."""
        with self._new_sample:
            newest_first = list(takewhile(lambda sample: sample.sequence > sequence, reversed(self._samples)))
        return tuple(reversed(newest_first))

    def wait_for(self, sequence: int, timeout_s: float) -> PoseSample | None:
        """Wait for a sample after ``sequence`` and return the newest; None after ``timeout_s``."""

        def newer() -> bool:
            return bool(self._samples) and self._samples[-1].sequence > sequence

        with self._new_sample:
            return self._samples[-1] if self._new_sample.wait_for(newer, timeout_s) else None

    def statistics(self) -> Mapping[str, float]:
        """The client's statistics, and counts of frames with the body tracked, untracked, missing or unusable."""
        numbers = dict(self._client.statistics())
        with self._new_sample:
            numbers["tracked"] = float(self._tracked)
            numbers["untracked"] = float(self._untracked)
            numbers["missing"] = float(self._missing)
            numbers["unusable"] = float(self._unusable)
        return numbers

    def problems(self) -> tuple[str, ...]:
        """Suspected problems while poses arrive, as sentences with remedies; empty if there are none.

        The sentences of a lasting problem do not change from frame to frame.
        """
        found = []
        if self._client.failure is not None:
            found.append(f"motion capture stopped, {self._client.last_error}; close it and open it again.")
        with self._new_sample:
            found += self._unit_problems()
            found += self._axis_problems()
            if self._body is None and self._is_open:
                found.append(self._reason_for_no_body)
            if _share(self._recent_unusable) > RECENT_SHARE:
                found.append(
                    f"more than {RECENT_SHARE:.0%} of the newest frames have an invalid pose of the body (NaN or no "
                    "unit quaternion); restart streaming in Motive."
                )
            if self._recent_latency_ms and median(self._recent_latency_ms) > MAX_LATENCY_MS:
                found.append(
                    f"the poses arrive more than {MAX_LATENCY_MS:g} ms after their exposure, too late to control a "
                    "car; check the network and the load of Motive's computer."
                )
        if self._client.is_unreadable:
            found.append(f"no frame can be read: {self._client.last_error}")
        if not self._client.is_live:
            found.append("Motive is in Edit mode and streams a recorded take; switch it to Live mode.")
        info = self._client.server_info
        has_clock = info is not None and info.clock_hz > 0
        if self._is_open and has_clock and not self._client.alignment.is_aligned:
            found.append("the server answers no clock echo, so capture times are times of arrival; check the firewall.")
        return tuple(found)

    def _unit_problems(self) -> list[str]:
        """Signs of a server that streams millimetres: a body larger than a model car, or one that is far away."""
        markers = () if self._body is None else self._body.marker_positions_m
        size_m = max((abs(value) for marker in markers for value in marker), default=0.0)
        newest = self._samples[-1] if self._samples else None
        distance_m = 0.0 if newest is None else max(abs(newest.x_m), abs(newest.y_m))
        if size_m <= MAX_MARKER_OFFSET_M and distance_m <= MAX_POSITION_M:
            return []
        return [
            f"the body '{self._body_name}' is larger than {MAX_MARKER_OFFSET_M:g} m, or its position is beyond "
            f"{MAX_POSITION_M:g} m: the server does not seem to stream metres; set its unit of length to metres."
        ]

    def _axis_problems(self) -> list[str]:
        """Signs of a wrong vertical axis: a tilted body, or one that moves in a vertical plane.

        With the wrong axis the real height of the body, which is constant, is the y coordinate in ``map``.
        """
        other = "z" if self.config.up_axis == "y" else "y"
        remedy = f'up_axis = "{other}" may be right in [hardware.mocap] (listen: --up-axis)'
        if _share(self._recent_tilted) > RECENT_SHARE:
            return [
                f"the body '{self._body_name}' is tilted by more than {math.degrees(TILT_LIMIT_RAD):.0f} degrees: "
                f"{remedy}, the body was not level when it was created in Motive, or the car has rolled over."
            ]
        _, y_span_m, z_span_m = (high - low for low, high in zip(self._low_m, self._high_m, strict=True))
        if self._tracked and z_span_m > HEIGHT_LIMIT_M and y_span_m < 0.1 * z_span_m:
            return [
                f"the body '{self._body_name}' has moved vertically by more than {HEIGHT_LIMIT_M:g} m and hardly in y: "
                f"{remedy}; if the car was lifted, move it by {HEIGHT_LIMIT_M:g} m in y."
            ]
        return []

    def close(self) -> None:
        """Disconnect; samples stay readable. Idempotent, safe after a failed open."""
        self._client.close()
        self._is_open = False

    @property
    def client(self) -> NatNetClient:
        """The client: server info, models, bitstream version, last error."""
        return self._client

    @property
    def _body_name(self) -> str:
        return self._body.name if self._body is not None else self.config.body or str(self.config.body_id)

    def _on_models(self, models: tuple[Description, ...]) -> None:
        if not self._is_open:
            return
        body, reason = None, BODY_REMOVED
        try:
            body = select_body(models, self._selection)
        except NotReadyError as error:
            if _matching_bodies(models, self._selection):  # several bodies match, so a new definition does not help
                reason = error.reasons[0]
        with self._new_sample:
            self._body, self._reason_for_no_body = body, reason

    def _on_frame(self, frame: Frame, sequence: int, capture_s: float, received_s: float) -> None:
        with self._new_sample:
            if self._body is None and not self._is_open:
                return
            body = next((b for b in frame.rigid_bodies if self._body is not None and b.id == self._body.id), None)
            sample = self._sample(body, sequence, capture_s, received_s)
            self._recent_latency_ms.append((received_s - capture_s) * 1e3)
            if sample is not None:
                self._samples.append(sample)
                self._new_sample.notify_all()

    def _sample(self, body: RigidBody | None, sequence: int, capture_s: float, received_s: float) -> PoseSample | None:
        pose = None if body is None else self._pose(body)
        if body is not None and body.is_tracked:
            self._recent_unusable.append(pose is None)
        if body is None:
            self._missing += 1
        elif not body.is_tracked or not self._client.is_live:
            self._untracked += 1
        elif pose is None:
            self._unusable += 1
        else:
            self._tracked += 1
            (x_m, y_m, z_m), yaw_rad = pose
            self._recent_positions_m.append((x_m, y_m, z_m))
            self._widen_extremes()
            return PoseSample(sequence, capture_s, received_s, x_m, y_m, yaw_rad, z_m)
        if self._samples:
            last = self._samples[-1]
            held = (last.x_m, last.y_m, last.yaw_rad, last.z_m)
        elif pose is not None:
            (x_m, y_m, z_m), yaw_rad = pose
            held = (x_m, y_m, yaw_rad, z_m)
        else:
            return None
        return PoseSample(sequence, capture_s, received_s, *held, tracked=False)

    def _widen_extremes(self) -> None:
        """Take the median of the newest positions into the extremes."""
        if len(self._recent_positions_m) < EXTREME_FRAMES:
            return
        for axis, values in enumerate(zip(*self._recent_positions_m, strict=True)):
            self._low_m[axis] = min(self._low_m[axis], median(values))
            self._high_m[axis] = max(self._high_m[axis], median(values))

    def _pose(self, body: RigidBody) -> tuple[tuple[float, float, float], float] | None:
        """Pose of base_link; None for invalid numbers."""
        norm = math.sqrt(body.qx**2 + body.qy**2 + body.qz**2 + body.qw**2)
        position = (body.x_m, body.y_m, body.z_m)
        if not abs(norm - 1.0) < NORM_TOLERANCE or not all(map(math.isfinite, position)):
            return None
        quaternion: Quaternion = (body.qx / norm, body.qy / norm, body.qz / norm, body.qw / norm)
        if self.config.up_axis == "y":
            position, quaternion = z_up_vector(position), z_up_quaternion(quaternion)
        if body.is_tracked:
            self._recent_tilted.append(tilt_rad(quaternion) > TILT_LIMIT_RAD)
        return base_link_pose(position, quaternion, self.config.yaw_offset_rad, self.config.pivot_in_base_link_m)


def _share(flags: Collection[bool]) -> float:
    """Share of true flags [1]; 0 without flags."""
    return sum(flags) / len(flags) if flags else 0.0


def _bodies(models: Sequence[Description]) -> list[RigidBodyDescription]:
    return [model for model in models if isinstance(model, RigidBodyDescription)]


def _matching_bodies(models: Sequence[Description], config: MocapConfig) -> list[RigidBodyDescription]:
    """Rigid bodies with the id or the name of ``config``; without both the only body."""
    bodies = _bodies(models)
    if config.body_id is not None:
        return [b for b in bodies if b.id == config.body_id]
    if config.body:
        return [b for b in bodies if b.name == config.body]
    return bodies if len(bodies) == 1 else []


def select_body(models: Sequence[Description], config: MocapConfig) -> RigidBodyDescription:
    """Select the rigid body of ``config``. Raises NotReadyError with a list of the available bodies."""
    bodies = _bodies(models)
    chosen = _matching_bodies(models, config)
    wanted = f"'{config.body}'" if config.body_id is None else f"with id {config.body_id}"
    if chosen and len(sharing := [b.name for b in bodies if b.id == chosen[0].id]) > 1:
        raise NotReadyError(
            "No motion capture",
            [
                f"the rigid bodies {' and '.join(map(repr, sharing))} have the same streaming id {chosen[0].id}, "
                "by which frames identify a body; give each its own in Motive's Properties pane."
            ],
        )
    if len(chosen) == 1:
        return chosen[0]
    available = ", ".join(f"'{b.name}' (id {b.id})" for b in bodies)
    if len(chosen) > 1:
        raise NotReadyError(
            "No motion capture",
            [
                f"several rigid bodies have the name {wanted}; set body_id in [hardware.mocap] (listen: --body-id) to "
                f"one of {available}."
            ],
        )
    remedy = f"set body in [hardware.mocap] (listen: --body) to one of {available}."
    if not bodies:
        reason = (
            "the server streams no rigid body; create one in Motive and switch Rigid Bodies on in the Data Streaming "
            "pane."
        )
    elif config.body_id is None and not config.body:
        reason = f"the server has several rigid bodies; {remedy}"
    else:
        reason = f"the server has no rigid body {wanted}; {remedy}"
    raise NotReadyError("No motion capture", [reason])
