"""The codec without a network: a drive into a ``.rfv`` file, and back into pictures.

The file holds the very messages a vehicle would send, so its size is the packets' size.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from rfcore.camera import Camera
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.sender.encoder import DeltaEncoder, Encoded, FrameChoice
from rfcore.codec.sender.frame_costs import FrameCosts
from rfcore.codec.sender.pose_search import PoseSearch, Refined
from rfcore.codec.sender.steering import NO_STEERING, Steering
from rfcore.dataset import Dataset
from rfcore.errors import CodecError, DatasetError, InvalidData
from rfcore.field import RadianceField, render_field_view
from rfcore.image import I420
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import FieldView
from rfcore.wire.checks import MAX_PAYLOAD_BYTES
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.drive_file import CodedDrive
from rfcore.wire.messages import CameraDescription, Frame, Hello, RendererContract

__all__ = ["CodingSettings", "DecodedFrame", "decode_drive", "encode_drive"]

OFFLINE_VEHICLE = "offline"
CAMERA_ID = "front"
RENDERER = RendererContract(RENDERER_CONTRACT, exact=True)
FITTING = FrameChoice(limit_bytes=MAX_PAYLOAD_BYTES)


@dataclass(frozen=True)
class CodingSettings:
    """How the P pictures are coded: an x264 preset, a constant rate factor (1..51), and where and
    from which pose."""

    preset: str = "medium"
    crf: float = 23.0
    steering: Steering = NO_STEERING


@dataclass(frozen=True)
class DecodedFrame:
    """A reconstruction and the sequence number it came with."""

    sequence: int
    frame: I420


def encode_drive(dataset: Dataset, field: RadianceField, settings: CodingSettings) -> CodedDrive:
    """Code every picture of a drive against the field's render at its pose.

    Raises ``DatasetError`` if the pictures are not all of one camera, ``CodecError`` for a picture
    whose slice is too long for a message at every CRF.
    """
    intrinsics = dataset.pictures[0].camera.intrinsics
    config = CodecConfig(intrinsics.width_px, intrinsics.height_px, settings.preset, settings.crf)
    encoder = DeltaEncoder(config)
    state = encoder.start(1)
    choice = replace(FITTING, qp_map=settings.steering.qp_map)
    place = _placer(field, settings)
    frames = []
    for picture in dataset.pictures:
        if picture.camera.intrinsics != intrinsics:
            raise DatasetError(f"{picture.name}: its camera differs from the first picture's")
        frame = i420_from_rgb(picture.read())
        placed = place(frame, picture.camera.rounded())
        encoded = encoder.encode(state, frame, placed.view, choice, placed.costs)
        _require_fit(picture.name, encoded)
        state = encoded.state
        frames.append(
            Frame(
                CAMERA_ID,
                picture.time_ns,
                placed.view.camera.world_from_cam,
                b"",
                encoded.packet,
            )
        )
    camera = CameraDescription(CAMERA_ID, intrinsics, encoder.header)
    return CodedDrive(Hello(OFFLINE_VEHICLE, (camera,), (field.field_id,), RENDERER), tuple(frames))


def _placer(field: RadianceField, settings: CodingSettings) -> Callable[[I420, Camera], Refined]:
    """Return a function that finds the pose to code a frame at, and renders the field there."""

    def render_at(camera: Camera) -> FieldView:
        return render_field_view(field, camera)

    refine_ms = settings.steering.refine_pose_ms
    if refine_ms is None:
        return lambda frame, camera: Refined(render_at(camera), FrameCosts(frame))
    search = PoseSearch(refine_ms, time.perf_counter_ns)
    crf = settings.crf
    return lambda frame, camera: search.refine(frame, render_at(camera), render_at, crf)


def _require_fit(name: str, encoded: Encoded) -> None:
    size_bytes = len(encoded.packet.payload)
    if size_bytes > MAX_PAYLOAD_BYTES:
        raise CodecError(
            f"{name}: {size_bytes} bytes of P slice at the highest CRF, the limit is "
            f"{MAX_PAYLOAD_BYTES}; scale the pictures down"
        )


def decode_drive(drive: CodedDrive, field: RadianceField) -> Iterator[DecodedFrame]:
    """Reconstruct every frame, in order.

    Raises ``InvalidData`` if the drive was coded against another field, ``PacketRejected`` at the
    first packet that fails a check.
    """
    if field.field_id not in drive.hello.field_ids:
        raise InvalidData(
            f"coded against field {', '.join(drive.hello.field_ids)}, given {field.field_id}"
        )
    camera = drive.hello.cameras[0]
    decoder = DeltaDecoder(camera.codec)
    state = decoder.start(drive.frames[0].packet.epoch) if drive.frames else decoder.start(1)
    for frame in drive.frames:
        view = render_field_view(field, frame.camera(camera.intrinsics), frame.quality)
        decoded = decoder.decode(state, frame.packet, view)
        state = decoded.state
        yield DecodedFrame(frame.packet.sequence, decoded.frame)
