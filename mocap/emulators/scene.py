"""Bodies of the emulated server: pose samples to NatNet frames and model definitions. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from mocap.axes import rotate, y_up_quaternion, y_up_vector, yaw_quaternion
from mocap.natnet.models import (
    Description,
    Frame,
    LabelledMarker,
    MarkerSet,
    MarkerSetDescription,
    Quaternion,
    RigidBody,
    RigidBodyDescription,
    Vector3,
)

_ORIGIN: Vector3 = (0.0, 0.0, 0.0)
_IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class EmulatedBody:
    """A rigid body of the emulated server. ``markers_m`` are in the body's frame: x forward, y left, z up."""

    name: str = "car"
    id: int = 1
    markers_m: tuple[Vector3, ...] = ((0.12, 0.0, 0.03), (-0.10, 0.05, 0.02), (-0.10, -0.05, 0.05), (0.02, 0.06, 0.04))


@dataclass(frozen=True, slots=True)
class RigidBodySample:
    """Pose of a rigid body in ``map`` (Z up) at a time of exposure on the host's monotonic clock.

    ``t_capture_s`` may lie before the deadline of the frame; the difference is the processing time of the cameras.
    """

    t_capture_s: float
    position_m: Vector3
    quaternion: Quaternion = _IDENTITY

    @classmethod
    def planar(cls, t_capture_s: float, x_m: float, y_m: float, yaw_rad: float, z_m: float = 0.0) -> RigidBodySample:
        """Create a sample of an upright body."""
        return cls(t_capture_s, (x_m, y_m, z_m), yaw_quaternion(yaw_rad))


@dataclass(slots=True)
class EmulatedScene:
    """Bodies and their last poses; an occluded body is sent with its last pose and untracked."""

    bodies: Sequence[EmulatedBody]
    up_axis: Literal["y", "z"] = "y"
    _last: dict[int, RigidBodySample] = field(default_factory=dict)

    def descriptions(self) -> tuple[Description, ...]:
        """Rigid bodies, a marker set for each, and the marker set "all", in Motive's order."""
        bodies = []
        sets = []
        everything: list[str] = []
        for body in self.bodies:
            positions = tuple(self._vector(m) for m in body.markers_m)
            names = tuple(f"Marker{i + 1}" for i in range(len(positions)))
            labels = (0,) * len(positions)
            bodies.append(RigidBodyDescription(body.name, body.id, -1, _ORIGIN, positions, labels, names))
            sets.append(MarkerSetDescription(body.name, names))
            everything += [f"{body.name}_{i + 1}" for i in range(len(positions))]
        return (*bodies, *sets, MarkerSetDescription("all", tuple(everything)))

    def frame(self, number: int, samples: Sequence[RigidBodySample | None]) -> Frame:
        """Create a frame without stamps and parameters; a sample None means an occluded body."""
        rigid_bodies, sets, labelled = [], [], []
        for body, sample in zip(self.bodies, samples, strict=True):
            if sample is not None:
                self._last[body.id] = sample
            pose = sample or self._last.get(body.id)
            position, quaternion = (pose.position_m, pose.quaternion) if pose else (_ORIGIN, _IDENTITY)
            tracked = sample is not None
            turned = self._quaternion(quaternion)
            error_m = 2e-4 if tracked else 0.0
            rigid_bodies.append(RigidBody(body.id, *self._vector(position), *turned, error_m, int(tracked)))
            markers = []
            for index, marker in enumerate(body.markers_m):
                shift = rotate(quaternion, marker)
                place = self._vector((position[0] + shift[0], position[1] + shift[1], position[2] + shift[2]))
                markers.append(place)
                params = 0x0A if tracked else 0x0B
                labelled.append(LabelledMarker(body.id << 16 | index + 1, *place, 0.02, params, 3e-4))
            sets.append(MarkerSet(body.name, tuple(markers)))
        sets.append(MarkerSet("all", tuple(p for s in sets for p in s.positions_m)))
        return Frame(number, tuple(sets), rigid_bodies=tuple(rigid_bodies), labelled_markers=tuple(labelled))

    def _vector(self, v: Vector3) -> Vector3:
        return y_up_vector(v) if self.up_axis == "y" else v

    def _quaternion(self, q: Quaternion) -> Quaternion:
        return y_up_quaternion(q) if self.up_axis == "y" else q
