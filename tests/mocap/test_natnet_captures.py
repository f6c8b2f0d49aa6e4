"""Packets captured from Motive 2.1 (github.com/mje-nz/python_natnet, BSD-3-Clause), and their known contents."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from natnet.data_descriptions import DataDescriptions
from natnet.data_frame import DataFrame
from natnet.packet_buffer import PacketBuffer
from natnet.version import Version
from natnet_datagrams import decode_datagram
from scipy.spatial.transform import Rotation

from mocap.natnet.descriptions import encode_model_def
from mocap.natnet.frames import decode_frame, encode_frame, layouts_that_fit
from mocap.natnet.messages import Connect, ServerInfo, encode_connect, encode_message, encode_server_info, split_message
from mocap.natnet.models import BitstreamVersion, Frame, MarkerSetDescription, RigidBodyDescription

V3 = BitstreamVersion(3, 0)
CLOCK_HZ = 3312787  # from the captured server info


@pytest.fixture(scope="module")
def captures(shared: Path) -> dict[str, bytes]:
    folder = shared / "reference" / "natnet-captures"
    if not folder.is_dir():
        pytest.skip(f"{folder} with the captured packets does not exist")
    return {path.name.removesuffix("_packet_v3.bin"): path.read_bytes() for path in folder.glob("*_packet_v3.bin")} | {
        "occluded": (folder / "mocapframe_packet_occluded_v3.bin").read_bytes()
    }


def frame_of(captures: dict[str, bytes], name: str) -> Frame:
    _, frame = decode_datagram(captures[name], V3)
    assert isinstance(frame, Frame)
    return frame


def test_every_capture_is_decoded(captures: dict[str, bytes]) -> None:
    ids = {name: decode_datagram(data, V3)[0] for name, data in captures.items()}
    assert ids["discovery"] == 14
    assert ids["connect"] == 0
    assert ids["serverinfo"] == 1
    assert ids["requestmodeldef"] == 4
    assert ids["modeldef"] == 5
    assert ids["echorequest"] == 12
    assert ids["echoresponse"] == 13
    assert ids["mocapframe"] == ids["occluded"] == 7


def test_server_info_is_decoded_and_encoded(captures: dict[str, bytes]) -> None:
    _, info = decode_datagram(captures["serverinfo"], V3)
    # In the capture garbage follows the name; it must not become part of the name.
    assert info == ServerInfo("Motive", (2, 1, 0, 0), (3, 0, 0, 0), CLOCK_HZ, 1511, True, "239.255.42.99")
    assert isinstance(info, ServerInfo)
    written = encode_message(1, encode_server_info(info))
    assert len(written) == len(captures["serverinfo"])
    assert written[:11] == captures["serverinfo"][:11]
    assert written[260:] == captures["serverinfo"][260:]


def test_connect_and_discovery_are_decoded_and_encoded(captures: dict[str, bytes]) -> None:
    for name, message_id in (("connect", 0), ("discovery", 14)):
        _, connect = decode_datagram(captures[name], V3)
        assert connect == Connect("NatNetLib", (3, 0, 0, 0), (3, 0, 0, 0), None, False)
        payload = encode_connect(
            "NatNetLib", app_version=(3, 0, 0, 0), natnet_version=(3, 0, 0, 0), bitstream=None, options=False
        )
        assert encode_message(message_id, payload) == captures[name]


def test_echo_request_and_response_are_decoded(captures: dict[str, bytes]) -> None:
    _, stamp = decode_datagram(captures["echorequest"], V3)
    _, echo = decode_datagram(captures["echoresponse"], V3)
    assert stamp == 278554190
    assert echo == (stamp, 0x149CDE48504)


def test_frame_has_the_known_values(captures: dict[str, bytes]) -> None:
    frame = frame_of(captures, "mocapframe")
    assert frame.frame_number == 162734
    assert frame.timestamp_s == pytest.approx(162734 / 120.0, abs=1e-9)  # the recording ran at 120 Hz
    assert (len(frame.marker_sets), len(frame.other_markers_m), len(frame.labelled_markers)) == (0, 5, 6)
    (body,) = frame.rigid_bodies
    assert body.id == 2
    assert body.is_tracked
    assert np.linalg.norm([body.qx, body.qy, body.qz, body.qw]) == pytest.approx(1.0, abs=1e-6)
    # The vendor's SampleClient printed latencies of 5.1 to 5.9 ms and 0.47 to 1.11 ms for this recording.
    assert 5.1e-3 < (frame.transmit_ticks - frame.mid_exposure_ticks) / CLOCK_HZ < 5.9e-3
    assert 0.47e-3 < (frame.transmit_ticks - frame.received_ticks) / CLOCK_HZ < 1.11e-3
    assert [m.id for m in frame.labelled_markers] == [0x20001, 0x20002, 0x20003, 0x20004, 0x20005, 50007]
    assert [m.params for m in frame.labelled_markers] == [10, 10, 10, 10, 10, 18]
    assert frame.params == 0


def test_body_pose_and_definition_agree_with_the_labelled_markers(captures: dict[str, bytes]) -> None:
    """Position, quaternion order and marker positions agree only if all three are decoded correctly.

    This Motive sends the marker positions of its definition with x mirrored: their mutual distances equal the measured
    ones, but no rotation maps one set to the other. With -x all five agree within a millimetre.
    """
    frame = frame_of(captures, "mocapframe")
    _, models = decode_datagram(captures["modeldef"], V3)
    assert isinstance(models, tuple)
    description = next(m for m in models if isinstance(m, RigidBodyDescription))
    (body,) = frame.rigid_bodies
    rotation = Rotation.from_quat([body.qx, body.qy, body.qz, body.qw])
    markers_in_body_m = np.array(description.marker_positions_m) * [-1.0, 1.0, 1.0]
    expected = rotation.apply(markers_in_body_m) + np.array([body.x_m, body.y_m, body.z_m])
    measured = np.array([(m.x_m, m.y_m, m.z_m) for m in frame.labelled_markers[:5]])
    assert np.abs(expected - measured).max() < 2e-3


def test_model_definitions_are_decoded(captures: dict[str, bytes]) -> None:
    _, models = decode_datagram(captures["modeldef"], V3)
    assert isinstance(models, tuple)
    body, marker_set, all_markers = models
    assert isinstance(body, RigidBodyDescription)
    assert (body.name, body.id, body.parent_id, len(body.marker_positions_m)) == ("RaceQuad", 2, -1, 5)
    assert marker_set == MarkerSetDescription("RaceQuad", tuple(f"Marker{i}" for i in range(1, 6)))
    assert all_markers == MarkerSetDescription("all", tuple(f"RaceQuad_{i}" for i in range(1, 6)))


def test_occluded_marker_is_decoded(captures: dict[str, bytes]) -> None:
    frame = frame_of(captures, "occluded")
    assert frame.frame_number == 269007
    assert [s.name for s in frame.marker_sets] == ["FakeTree", "all"]
    assert [m.params & 1 for m in frame.labelled_markers] == [1, 0, 0, 0]


def test_encoding_reproduces_the_captured_bytes(captures: dict[str, bytes]) -> None:
    for name in ("mocapframe", "occluded"):
        assert encode_message(7, encode_frame(frame_of(captures, name), V3)) == captures[name]
    _, models = decode_datagram(captures["modeldef"], V3)
    assert isinstance(models, tuple)
    assert encode_message(5, encode_model_def(models, V3)) == captures["modeldef"]


def test_captured_frame_fits_only_its_layout(captures: dict[str, bytes]) -> None:
    for name in ("mocapframe", "occluded"):
        assert layouts_that_fit(split_message(captures[name])[1]) == "3.0, 3.1 or 4.0"


def test_independent_decoder_agrees_on_the_captures(captures: dict[str, bytes]) -> None:
    for name in ("mocapframe", "occluded"):
        payload = split_message(captures[name])[1]
        decoded, reference = decode_frame(payload, V3), DataFrame.read_from_buffer(PacketBuffer(payload), Version(3, 0))
        assert decoded.frame_number == reference.prefix.frame_number
        assert [b[1:4] for b in decoded.rigid_bodies] == [b.pos for b in reference.rigid_bodies]
        assert [b[4:8] for b in decoded.rigid_bodies] == [b.rot for b in reference.rigid_bodies]
        assert [(m.id, m[1:4], m.residual_m) for m in decoded.labelled_markers] == [
            (m.id_num, m.pos, m.residual) for m in reference.labeled_markers
        ]
        assert decoded.mid_exposure_ticks == reference.suffix.stamp_camera_mid_exposure
    payload = split_message(captures["modeldef"])[1]
    reference_models = DataDescriptions.read_from_buffer(PacketBuffer(payload), Version(3, 0))
    _, models = decode_datagram(captures["modeldef"], V3)
    assert isinstance(models, tuple)
    assert isinstance(models[0], RigidBodyDescription)
    assert list(models[0].marker_positions_m) == [m.pos for m in reference_models.rigid_bodies[0].markers]
