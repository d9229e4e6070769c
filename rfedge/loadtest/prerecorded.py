"""Prerecorded drives: packets that are coded once and replayed, or payload of a given size.

A prerecorded drive holds each picture twice: ``chain``, as a vehicle sends them, each predicted
from the one before, and ``alone``, predicted from the render only, for the picture after one that
was dropped. On disk they are two coded drives (``rfcore.wire.drive_file``), in a folder named by
the digest of field, drive and settings.

``Replay`` is one camera of a vehicle that replays a drive. It does no I/O; times are seconds on one
monotonic clock. Pictures are due at ``start_s + i / hz``, even if those before are late. As in the
agent, the newest picture waits for credit and replaces the one that waited. After a picture that
was dropped or refused, the next ones are sent alone, in a new epoch, until the drive begins again.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from random import Random

from cav_agent.pipeline import Pipeline
from rfcore.camera import Intrinsics, Pose
from rfcore.codec.h264.config import DEFAULT_EFFORT, CodecConfig
from rfcore.codec.packet import RECONSTRUCTION_DIGEST_BYTES, RENDER_DIGEST_BYTES, DeltaPacket
from rfcore.codec.sender.encoder import DeltaEncoder
from rfcore.field import RadianceField
from rfcore.views import PosedPicture
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.drive_file import CodedDrive, read_drive, write_drive
from rfcore.wire.head import FrameWriter
from rfcore.wire.messages import (
    OUR_CONTRACT,
    Ack,
    CameraDescription,
    Credit,
    Frame,
    FrameAddress,
    Hello,
    Nack,
    ServerMessage,
)
from rfedge.arguments import open_drive


class End(StrEnum):
    """The fate of a picture; ``open``: it was not answered when the test was over."""

    ACKED = "acked"
    NACKED = "nacked"
    DROPPED = "dropped"
    OPEN = "open"


@dataclass
class Shot:
    """One picture and its fate."""

    due_s: float
    sent_s: float | None = None
    """The time at which it was handed to the socket."""
    ended_s: float | None = None
    """The time at which it was answered or dropped."""
    end: End = End.OPEN
    is_exact: bool = False
    """Whether the server's picture is the vehicle's, byte for byte."""

    @property
    def latency_s(self) -> float | None:
        """Time from due to Ack, or None without one."""
        if self.end is not End.ACKED or self.ended_s is None:
            return None
        return self.ended_s - self.due_s


@dataclass(frozen=True)
class Schedule:
    """Pictures at ``start_s + i / hz`` until ``end_s``, ready to send ``ready_s`` later.

    After the first ``together_s`` every picture is due ``later_s`` later.
    """

    start_s: float
    end_s: float
    hz: float
    ready_s: float = 0.0
    together_s: float = 0.0
    later_s: float = 0.0

    def due_s(self, index: int) -> float:
        """Return when picture ``index`` is due."""
        since_s = index / self.hz
        return self.start_s + since_s + (self.later_s if since_s >= self.together_s else 0.0)


NEVER = Schedule(float("inf"), float("inf"), 1.0)


class Replay:
    """Replays ``drive`` as camera ``camera_id`` of the vehicle of ``writer``.

    ``wall_ns`` is the Unix time of a moment.
    """

    def __init__(
        self,
        camera_id: str,
        drive: PrerecordedDrive,
        wall_ns: Callable[[float], int],
        writer: FrameWriter,
    ) -> None:
        self.shots: list[Shot] = []
        self._camera_id = camera_id
        self._drive = drive
        self._schedule = NEVER
        self._wall_ns = wall_ns
        self._writer = writer
        self._granted = 0
        self._used = 0
        self._waiting: int | None = None
        self._pending: dict[FrameAddress, tuple[Shot, bytes]] = {}
        """Pictures that are not answered yet, with the digest of the vehicle's reconstruction."""
        self._epoch = -1
        self._sequence = 0
        self._chained = False

    @property
    def is_idle(self) -> bool:
        """Whether every picture was sent or dropped, and answered."""
        return self._waiting is None and not self._pending and self.get_timer() is None

    @property
    def is_ready(self) -> bool:
        """Whether a picture waits and has credit."""
        return self._waiting is not None and self._used < self._granted

    def begin(self, schedule: Schedule) -> None:
        """Follow ``schedule`` from now on; before this nothing is due."""
        self._schedule = schedule

    def get_timer(self) -> float | None:
        """Return when the next picture is ready, or None when there is no other."""
        due_s = self._schedule.due_s(len(self.shots))
        return None if due_s >= self._schedule.end_s else due_s + self._schedule.ready_s

    def frame_to_send(self, now: float) -> bytes | None:
        """Return the message to send now, or None if none is due or has credit."""
        while (timer := self.get_timer()) is not None and timer <= now:
            if self._waiting is not None:
                self._drop(self._waiting, now)
            self._waiting = len(self.shots)
            self.shots.append(Shot(self._schedule.due_s(self._waiting)))
        if self._waiting is None or self._used >= self._granted:
            return None
        index, self._waiting = self._waiting, None
        self._used += 1
        return self._sent(index, now)

    def receive(self, message: ServerMessage, now: float) -> None:
        """Take an answer; answers for other cameras are ignored."""
        match message:
            case Credit(camera_id, frames) if camera_id == self._camera_id:
                self._granted = max(self._granted, frames)
            case Ack(address, _, digest) if address in self._pending:
                shot, wanted = self._pending.pop(address)
                shot.ended_s, shot.end, shot.is_exact = now, End.ACKED, digest == wanted
            case Nack(address) if address in self._pending:
                shot, _ = self._pending.pop(address)
                shot.ended_s, shot.end = now, End.NACKED
                self._chained = False

    def give_up(self) -> None:
        """Drop the pictures that were still to come, since the stream is lost."""
        while self._schedule.due_s(len(self.shots)) < self._schedule.end_s:
            self.shots.append(Shot(self._schedule.due_s(len(self.shots)), end=End.DROPPED))

    def _drop(self, index: int, now: float) -> None:
        shot = self.shots[index]
        shot.ended_s, shot.end = now, End.DROPPED
        self._chained = False

    def _sent(self, index: int, now: float) -> bytes:
        shot = self.shots[index]
        shot.sent_s = now
        position = index % len(self._drive.chain)
        if position == 0 or not self._chained:
            self._epoch += 1
            self._sequence = 0
            self._chained = position == 0
        coded = (self._drive.chain if self._chained else self._drive.alone)[position]
        after = None
        if self._sequence:
            after = FrameAddress(self._camera_id, self._epoch, self._sequence - 1)
        frame = Frame(
            self._camera_id,
            self._wall_ns(shot.due_s),
            coded.pose,
            coded.field_id,
            _numbered(coded.packet, self._epoch, self._sequence),
            coded.quality,
        )
        self._sequence += 1
        self._pending[frame.address] = shot, coded.packet.reconstruction_digest
        return self._writer.message(frame, after)


def _numbered(packet: DeltaPacket, epoch: int, sequence: int) -> DeltaPacket:
    """Return the packet with other numbers.

    The fields are written out because ``dataclasses.replace`` takes twice the time.
    """
    return DeltaPacket(
        epoch,
        sequence,
        packet.render_digest,
        packet.render_block_means,
        packet.reconstruction_digest,
        packet.payload,
        packet.references,
        packet.base_digest,
        packet.photometric,
        packet.relit,
        packet.light,
    )


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
        """The camera's intrinsics."""
        return self.hello.cameras[0].intrinsics

    @property
    def mean_payload_bytes(self) -> float:
        """Mean payload of the frames of the chain."""
        return sum(len(frame.packet.payload) for frame in self.chain) / len(self.chain)

    def write(self, folder: Path) -> None:
        """Write the drive into ``folder``."""
        folder.mkdir(parents=True, exist_ok=True)
        write_drive(folder / "chain.rfv", CodedDrive(self.hello, self.chain))
        write_drive(folder / "alone.rfv", CodedDrive(self.hello, self.alone))

    @staticmethod
    def read(folder: Path) -> PrerecordedDrive:
        """Read a drive from ``folder``; raise ``InvalidData`` if it is damaged."""
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
        pictures = open_drive(drive, field).pictures
        _coded(pictures, field, effort, crf).write(folder)
    return folder


def _coded(
    pictures: Sequence[PosedPicture], field: RadianceField, effort: str, crf: float
) -> PrerecordedDrive:
    intrinsics = pictures[0].camera.intrinsics
    config = CodecConfig(intrinsics.width_px, intrinsics.height_px, effort, crf)
    pipeline = Pipeline(field, config, time.perf_counter_ns)
    rounded = [replace(picture, camera=picture.camera.rounded()) for picture in pictures]
    chain = [_frame(pipeline, picture, 0, index - 1) for index, picture in enumerate(rounded)]
    alone = [_frame(pipeline, picture, index + 1) for index, picture in enumerate(rounded)]
    camera = CameraDescription(CAMERA, intrinsics, pipeline.header)
    return PrerecordedDrive(_hello(camera, field.field_id), tuple(chain), tuple(alone))


def _frame(pipeline: Pipeline, picture: PosedPicture, epoch: int, after: int = -1) -> Frame:
    base = FrameAddress(CAMERA, epoch, after) if after >= 0 else None
    packet = pipeline.encode_picture(picture, epoch, base)
    return Frame(CAMERA, 0, picture.camera.world_from_cam, "", packet)


def payload_drive(field_id: str, size_bytes: int) -> PrerecordedDrive:
    """Return a drive of one frame with ``size_bytes`` of random payload, for transport mode."""
    intrinsics = Intrinsics(640, 360, 320.0, 320.0, 320.0, 180.0)
    config = CodecConfig(intrinsics.width_px, intrinsics.height_px)
    header = DeltaEncoder(config, time.perf_counter_ns).header
    payload = Random(size_bytes).randbytes(size_bytes)
    digests = bytes(RENDER_DIGEST_BYTES), b"", bytes(RECONSTRUCTION_DIGEST_BYTES)
    frame = Frame(CAMERA, 0, Pose.identity(), "", DeltaPacket(0, 0, *digests, payload))
    camera = CameraDescription(CAMERA, intrinsics, header)
    return PrerecordedDrive(_hello(camera, field_id), (frame,), (frame,))


def _hello(camera: CameraDescription, field_id: str) -> Hello:
    return Hello(VEHICLE, (camera,), (field_id,), OUR_CONTRACT)
