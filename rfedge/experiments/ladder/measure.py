"""One rung of the ladder on one clip: what it takes, stage by stage on both ends, and gives.

Times are of one thread. ``cpu`` is the process's processor time, which another program's load
hardly changes; ``wall`` is what a clock on the wall saw meanwhile, and equals it on an idle
machine. Each is the lower quartile over the frames but the first, which has nothing to be predicted
from: what a frame takes when nothing else disturbs the caches.
The field is rendered once per quality and its time taken then; what both ends render alike is not
rendered again for every rung.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from time import perf_counter_ns, process_time_ns
from typing import Any

import numpy as np

from rfcore.camera import Camera
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.references import RENDER_ONLY, references_name
from rfcore.codec.sender.encoder import DeltaEncoder, Encoded, FrameChoice
from rfcore.codec.sender.ladder import Rung
from rfcore.dataset import Dataset
from rfcore.errors import CodecError
from rfcore.field import Quality, RadianceField, render_field_view
from rfcore.image import I420, Rgb
from rfcore.metrics import ssim
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import FieldView
from rfcore.wire.convert import client_message_to_bytes
from rfcore.wire.messages import Frame
from rfedge.experiments.clips import luma_mse

__all__ = ["LadderClip", "Rendered", "measure_rung", "render_clip"]

SENDER_STAGES = ("references", "encode", "closed_loop")
RECEIVER_STAGES = ("references", "splice", "decode")
Row = dict[str, Any]


@dataclass(frozen=True)
class LadderClip:
    """A drive's pictures in memory, with their cameras as a vehicle rounds them."""

    cameras: tuple[Camera, ...]
    pictures: tuple[Rgb, ...]
    frames: tuple[I420, ...]

    @staticmethod
    def of(dataset: Dataset, count: int | None) -> LadderClip:
        """Read the first ``count`` pictures of a drive."""
        posed = dataset.pictures[:count]
        cameras = [picture.camera.rounded() for picture in posed]
        pictures = tuple(picture.read() for picture in posed)
        return LadderClip(tuple(cameras), pictures, tuple(map(i420_from_rgb, pictures)))

    @property
    def digest(self) -> str:
        """SHA-256 over the frames' digests."""
        return hashlib.sha256(b"".join(frame.digest() for frame in self.frames)).hexdigest()


class Marks:
    """A clock for codec objects that notes both times whenever it is looked at."""

    def __init__(self) -> None:
        self._seen: list[tuple[int, int]] = []

    def __call__(self) -> int:
        self._seen.append((process_time_ns(), perf_counter_ns()))
        return self._seen[-1][0]

    def spent_ms(self) -> list[tuple[float, float]]:
        """Return (cpu, wall) between the looks since last asked, and forget them."""
        seen, self._seen = self._seen, []
        return [((b[0] - a[0]) / 1e6, (b[1] - a[1]) / 1e6) for a, b in pairwise(seen)]


@dataclass(frozen=True)
class Rendered:
    """A clip's views at one quality, with what a frame took to render and to convert: (cpu, wall)
    in milliseconds, lower quartiles."""

    views: tuple[FieldView, ...]
    render_ms: tuple[float, float]
    convert_ms: tuple[float, float]


def render_clip(field: RadianceField, clip: LadderClip, quality: Quality) -> Rendered:
    """Render every pose of ``clip``, after one that makes what is made lazily."""
    field.prepare(quality)
    render_field_view(field, clip.cameras[0], quality)
    marks = Marks()
    views, render_ms, convert_ms = [], [], []
    for camera, picture in zip(clip.cameras, clip.pictures, strict=True):
        marks()
        views.append(render_field_view(field, camera, quality))
        marks()
        i420_from_rgb(picture)
        marks()
        rendering, converting = marks.spent_ms()
        render_ms.append(rendering)
        convert_ms.append(converting)
    return Rendered(tuple(views), _quartile(render_ms), _quartile(convert_ms))


def measure_rung(clip: LadderClip, seen: Rendered, rung: Rung, crf: float) -> Row:
    """Code and decode ``clip`` on ``rung``; return times, bits of whole messages, and quality.

    Raises ``CodecError`` if the receiver does not see what the sender promised.
    """
    sender, receiver = _Stages(SENDER_STAGES), _Stages(RECEIVER_STAGES)
    encoder = DeltaEncoder(CodecConfig(*clip.frames[0].size_px, rung.preset, crf), sender.marks)
    decoder = DeltaDecoder(encoder.header, clock_ns=receiver.marks)
    sending, receiving = encoder.start(1), decoder.start(1)
    choice = _choice(rung)
    coded: list[Encoded] = []
    shown: list[I420] = []
    for index, frame in enumerate(clip.frames):
        view = seen.views[index]
        made = encoder.encode(sending, frame, view, choice)
        sender.frame_ended()
        got = decoder.decode(receiving, made.packet, view)
        receiver.frame_ended()
        if got.frame.digest() != made.reconstruction.digest():
            raise CodecError(f"frame {index} decodes to another picture than was promised")
        sending, receiving = made.state, got.state
        coded.append(made)
        shown.append(got.frame)
    sizes = [_message_bytes(clip, rung, k, made) for k, made in enumerate(coded)]
    pairs = list(zip(shown, clip.frames, strict=True))[1:]
    mse = float(np.mean([luma_mse(*pair) for pair in pairs]))
    sender_ms = {"convert": seen.convert_ms, "render": seen.render_ms, **sender.quartiles()}
    receiver_ms = {"render": seen.render_ms, **receiver.quartiles()}
    return {
        "sender_ms": sum(cpu for cpu, _ in sender_ms.values()),
        "receiver_ms": sum(cpu for cpu, _ in receiver_ms.values()),
        "sender_wall_ms": sum(wall for _, wall in sender_ms.values()),
        "receiver_wall_ms": sum(wall for _, wall in receiver_ms.values()),
        "sender_stage_ms": _cpu(sender_ms),
        "receiver_stage_ms": _cpu(receiver_ms),
        "bits_per_frame": 8 * float(np.mean(sizes[1:])),
        "psnr_db": float(10 * np.log10(255.0**2 / mse)),
        "ssim": float(np.mean([ssim(ours.y, theirs.y) for ours, theirs in pairs])),
        "references_used": _counts(coded[1:]),
    }


class _Stages:
    """(cpu, wall) of each stage of each frame; the codec looks at the clock between them."""

    def __init__(self, names: Sequence[str]) -> None:
        self.marks = Marks()
        self._names = names
        self._frames: list[list[tuple[float, float]]] = []

    def frame_ended(self) -> None:
        spent = self.marks.spent_ms()
        if len(spent) != len(self._names):
            raise CodecError(f"{len(spent)} stages where {', '.join(self._names)} are expected")
        self._frames.append(spent)

    def quartiles(self) -> dict[str, tuple[float, float]]:
        steady = list(zip(*self._frames[1:], strict=True))
        return {name: _quartile(spent) for name, spent in zip(self._names, steady, strict=True)}


def _choice(rung: Rung) -> FrameChoice:
    return FrameChoice(
        references=None if rung.references else RENDER_ONLY,
        photometric=None if rung.photometric else (),
        max_references=max(1, rung.references),
        fast_unsent=rung.fast_unsent,
    )


def _message_bytes(clip: LadderClip, rung: Rung, index: int, made: Encoded) -> int:
    pose = clip.cameras[index].world_from_cam
    frame = Frame("front", 1_700_000_000_000_000_000, pose, b"", made.packet, rung.quality)
    return len(client_message_to_bytes(frame))


def _counts(coded: Sequence[Encoded]) -> dict[str, int]:
    names = [references_name(made.packet.references) for made in coded]
    return {name: names.count(name) for name in dict.fromkeys(names)}


def _quartile(spent: Sequence[tuple[float, float]]) -> tuple[float, float]:
    cpu, wall = np.quantile(np.array(spent), 0.25, axis=0)
    return float(cpu), float(wall)


def _cpu(stages: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    return {name: cpu for name, (cpu, _) in stages.items()}
