"""Benchmark of NatNet decoding: frames per second on one core."""

from __future__ import annotations

import time

from mocap.natnet.frames import decode_frame, encode_frame
from mocap.natnet.messages import encode_message, split_message
from mocap.natnet.models import BitstreamVersion, Frame, LabelledMarker, MarkerSet, MessageId, RigidBody


def example_frame(bodies: int, other_markers: int, labelled_markers: int, marker_sets: int = 0) -> Frame:
    """Create a frame with given numbers of bodies and markers and typical values."""
    return Frame(
        162734,
        tuple(MarkerSet(f"set {i}", ((0.1, 1.5, -0.9), (0.2, 1.5, -0.7))) for i in range(marker_sets)),
        tuple((0.1 * i, 1.5, -0.9) for i in range(other_markers)),
        tuple(RigidBody(i + 1, 0.2 * i, 1.4, -0.7, 0.0, 0.6, 0.0, 0.8, 5e-4, 1) for i in range(bodies)),
        labelled_markers=tuple(
            LabelledMarker(1 << 16 | i + 1, 0.1 * i, 1.5, -0.9, 0.02, 10, 4e-4) for i in range(labelled_markers)
        ),
        timestamp_s=1356.1166666666666,
        mid_exposure_ticks=1416497730518,
        received_ticks=1416497745808,
        transmit_ticks=1416497748722,
    )


def natnet_decode_speed(seconds: float = 0.5) -> dict[str, float]:
    """Measure decoding from datagram to ``Frame`` for about ``seconds`` per case.

    Returns:
        Frames per second: ``captured_3_0_hz`` and ``captured_4_1_hz`` for the contents of a frame captured from Motive
        (1 body, 5 other markers, 6 labelled markers), ``ten_bodies_4_1_hz`` for 10 bodies with 11 marker sets and 40
        labelled markers.
    """
    captured, ten = example_frame(1, 5, 6), example_frame(10, 5, 40, marker_sets=11)
    cases = {
        "captured_3_0_hz": (captured, BitstreamVersion(3, 0)),
        "captured_4_1_hz": (captured, BitstreamVersion(4, 1)),
        "ten_bodies_4_1_hz": (ten, BitstreamVersion(4, 1)),
    }
    return {name: _frames_per_second(frame, version, seconds) for name, (frame, version) in cases.items()}


def _frames_per_second(frame: Frame, version: BitstreamVersion, seconds: float) -> float:
    datagram = encode_message(MessageId.FRAMEOFDATA, encode_frame(frame, version))
    decoded = 0
    start_s = now_s = time.perf_counter()
    while now_s - start_s < seconds:
        for _ in range(200):
            decode_frame(split_message(datagram)[1], version)
        decoded += 200
        now_s = time.perf_counter()
    return decoded / (now_s - start_s)
