"""Prerecorded drives: packets that are coded once and replayed, or payload of a given size.

A prerecorded drive holds each picture twice: ``chain``, as a vehicle sends them, each predicted
from the one before, and ``alone``, predicted from the render only, for the picture after one that
was dropped. On disk they are two coded drives (``rfcore.wire.drive_file``), in a folder named by
the digest of field, drive and settings.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random

from cav_agent.frames import Capture, EncodeJob
from cav_agent.pipeline import Pipeline
from rfcore.camera import Intrinsics, Pose
from rfcore.codec.h264.config import DEFAULT_EFFORT, CodecConfig
from rfcore.codec.packet import DeltaPacket
from rfcore.codec.sender.encoder import DeltaEncoder
from rfcore.dataset import read_dataset
from rfcore.field import RadianceField
from rfcore.views import PosedPicture
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.drive_file import CodedDrive, read_drive, write_drive
from rfcore.wire.messages import CameraDescription, Frame, FrameAddress, Hello, RendererContract

__all__ = ["CAMERA", "PrerecordedDrive", "payload_drive", "prerecorded_drive"]

CAMERA = "front"
VEHICLE = "prerecorded"


@dataclass(frozen=True)
class PrerecordedDrive:
    """Pictures of one camera; ``alone[i]`` and ``chain[i]`` are the same picture."""

    hello: Hello
    chain: tuple[Frame, ...]
    alone: tuple[Frame, ...]

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera's."""
        return self.hello.cameras[0].intrinsics

    @property
    def mean_payload_bytes(self) -> float:
        """Of the frames as a vehicle sends them."""
        return sum(len(frame.packet.payload) for frame in self.chain) / len(self.chain)

    def write(self, folder: Path) -> None:
        """Keep the drive in ``folder``."""
        folder.mkdir(parents=True, exist_ok=True)
        write_drive(folder / "chain.rfv", CodedDrive(self.hello, self.chain))
        write_drive(folder / "alone.rfv", CodedDrive(self.hello, self.alone))

    @staticmethod
    def read(folder: Path) -> PrerecordedDrive:
        """Read what ``write`` wrote; raise ``InvalidData`` if it is damaged."""
        chain, alone = read_drive(folder / "chain.rfv"), read_drive(folder / "alone.rfv")
        return PrerecordedDrive(chain.hello, chain.frames, alone.frames)


def prerecorded_drive(
    drive: Path,
    field: RadianceField,
    cache: Path,
    effort: str = DEFAULT_EFFORT,
    crf: float = 23.0,
) -> Path:
    """Return the folder in ``cache`` of ``drive`` coded against ``field``; code it if it is new."""
    text = f"{RENDERER_CONTRACT} {field.field_id} {drive.resolve()} {effort} {crf}"
    folder = cache / hashlib.sha256(text.encode()).hexdigest()[:16]
    if not (folder / "alone.rfv").exists():
        pictures = read_dataset(drive, tile_origin=field.metadata.tile_origin).pictures
        _coded(pictures, field, effort, crf).write(folder)
    return folder


def _coded(
    pictures: Sequence[PosedPicture], field: RadianceField, effort: str, crf: float
) -> PrerecordedDrive:
    intrinsics = pictures[0].camera.intrinsics
    config = CodecConfig(intrinsics.width_px, intrinsics.height_px, effort, crf)
    pipeline = Pipeline(field, config, time.perf_counter_ns)
    captures = [_capture(index, picture) for index, picture in enumerate(pictures)]
    chain = [_frame(pipeline, capture, 0, capture.index - 1) for capture in captures]
    alone = [_frame(pipeline, capture, capture.index + 1) for capture in captures]
    camera = CameraDescription(CAMERA, intrinsics, pipeline.header)
    return PrerecordedDrive(_hello(camera, field.field_id), tuple(chain), tuple(alone))


def _capture(index: int, picture: PosedPicture) -> Capture:
    return Capture(index, replace(picture, camera=picture.camera.rounded()), 0.0, 0)


def _frame(pipeline: Pipeline, capture: Capture, epoch: int, after: int = -1) -> Frame:
    base = FrameAddress(CAMERA, epoch, after) if after >= 0 else None
    packet = pipeline.encode(EncodeJob(capture, epoch, 1, base)).packet
    return Frame(CAMERA, 0, capture.picture.camera.world_from_cam, b"", packet)


def payload_drive(field_id: str, size_bytes: int) -> PrerecordedDrive:
    """Return a drive of one frame with ``size_bytes`` of random payload, for transport mode."""
    intrinsics = Intrinsics(640, 360, 320.0, 320.0, 320.0, 180.0)
    config = CodecConfig(intrinsics.width_px, intrinsics.height_px)
    header = DeltaEncoder(config, time.perf_counter_ns).header
    digest = bytes(16)
    payload = Random(size_bytes).randbytes(size_bytes)
    packet = DeltaPacket(0, 0, digest, b"", digest, payload, 0).sealed()
    frame = Frame(CAMERA, 0, Pose.identity(), b"", packet)
    camera = CameraDescription(CAMERA, intrinsics, header)
    return PrerecordedDrive(_hello(camera, field_id), (frame,), (frame,))


def _hello(camera: CameraDescription, field_id: str) -> Hello:
    contract = RendererContract(RENDERER_CONTRACT, exact=True)
    return Hello(VEHICLE, (camera,), (field_id,), contract)
