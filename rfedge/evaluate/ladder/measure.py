"""One rung of the ladder on one clip: what it takes, stage by stage on both ends, and gives.

Times are of one thread. ``cpu`` is the process's processor time, which another program's load
hardly changes; ``wall`` is what a clock on the wall saw meanwhile, and equals it on an idle
machine. Each is the lower quartile over the frames but the first, which has nothing to be predicted
from: what a frame takes when nothing else disturbs the caches.
The field is rendered once per quality and its time taken then; what both ends render alike is not
rendered again for every rung.

Tracking is measured apart: a drive is tracked as a vehicle does it, from the dataset's pose of its
first picture. Its time is what a frame takes beyond the one render that coding needs in any case:
of everything but rendering the lower quartile, and the mean number of further renders times one
render's time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from time import perf_counter_ns, process_time_ns
from typing import Any, NamedTuple

import numpy as np

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.references import RENDER_ONLY, references_name
from rfcore.codec.sender.encoder import DeltaEncoder, FrameChoice
from rfcore.codec.sender.ladder import Rung, TrackingEffort
from rfcore.errors import CodecError
from rfcore.field import Quality, RadianceField, render_field_view
from rfcore.image import I420
from rfcore.localise.matching import Pyramid
from rfcore.localise.track import Track, TrackingBudget, begin_track, follow_track
from rfcore.metrics import psnr_of_mse, ssim
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import FieldView
from rfedge.evaluate.clips import Drive, luma_mse
from rfedge.evaluate.field_coder import MessageWriter
from rfedge.offline import CodedFrame, FrameInput, decode_promised, encode_frames

SENDER_STAGES = ("references", "encode", "closed_loop")
RECEIVER_STAGES = ("references", "splice", "decode")
Row = dict[str, Any]


class StageClock:
    """A clock for codec objects that keeps processor and wall time of every reading."""

    def __init__(self) -> None:
        self._readings: list[tuple[int, int]] = []

    def __call__(self) -> int:
        self._readings.append((process_time_ns(), perf_counter_ns()))
        return self._readings[-1][0]

    def spent_ms(self) -> list[tuple[float, float]]:
        """Return (cpu, wall) between the readings since the last call, and forget them."""
        readings, self._readings = self._readings, []
        return [((b[0] - a[0]) / 1e6, (b[1] - a[1]) / 1e6) for a, b in pairwise(readings)]


@dataclass(frozen=True)
class TimedRenders:
    """A clip's views at one quality, with what a frame took to render and to convert: (cpu, wall)
    in milliseconds, lower quartiles; ``frames_ms``: (render, convert) of each frame, cpu."""

    views: tuple[FieldView, ...]
    render_ms: tuple[float, float]
    convert_ms: tuple[float, float]
    frames_ms: tuple[tuple[float, float], ...]


def time_renders(field: RadianceField, drive: Drive, quality: Quality) -> TimedRenders:
    """Render every pose of ``drive``, after one that makes what is made lazily."""
    pictures = [picture.read() for picture in drive.pictures]
    cameras = drive.cameras
    field.prepare(quality)
    render_field_view(field, cameras[0], quality)
    clock = StageClock()
    views, render_ms, convert_ms = [], [], []
    for camera, picture in zip(cameras, pictures, strict=True):
        clock()
        views.append(render_field_view(field, camera, quality))
        clock()
        i420_from_rgb(picture)
        clock()
        rendering, converting = clock.spent_ms()
        render_ms.append(rendering)
        convert_ms.append(converting)
    frames_ms = tuple((r[0], c[0]) for r, c in zip(render_ms, convert_ms, strict=True))
    return TimedRenders(tuple(views), _quartile(render_ms), _quartile(convert_ms), frames_ms)


def measure_rung(drive: Drive, rendered: TimedRenders, rung: Rung, crf: float) -> Row:
    """Code and decode ``drive`` on ``rung``; return times, bits of whole messages, and quality.

    Raises ``CodecError`` if the receiver does not see what the sender promised.
    """
    return measure_frames(drive, rendered, rung, crf)[0]


class FrameTimes(NamedTuple):
    """Processor time of a frame, milliseconds: of both ends, of the sender until the pose is sent
    ahead, and of the receiver's work that needs nothing but that pose."""

    sender_ms: float
    receiver_ms: float
    located_ms: float
    ahead_ms: float


def measure_frames(
    drive: Drive, rendered: TimedRenders, rung: Rung, crf: float
) -> tuple[Row, list[FrameTimes]]:
    """Return what ``measure_rung`` does, and the times of each frame; raises as it does."""
    sender, receiver = _Stages(SENDER_STAGES), _Stages(RECEIVER_STAGES)
    config = CodecConfig(*drive.frames[0].size_px, rung.effort, crf)
    encoder = DeltaEncoder(config, sender.clock)
    decoder = DeltaDecoder(encoder.header, clock_ns=receiver.clock)
    choice = _choice(rung)
    inputs = (
        FrameInput(*given, choice) for given in zip(drive.frames, rendered.views, strict=True)
    )
    coded: list[CodedFrame] = []
    shown: list[I420] = []
    # Nothing is collected in between, so that a frame is decoded before the next one is coded.
    for frame, picture in decode_promised(decoder, encode_frames(encoder, inputs)):
        sender.frame_ended()
        receiver.frame_ended()
        coded.append(frame)
        shown.append(picture)
    writer = MessageWriter(encoder.header, drive.name.rate_hz, rung.quality)
    sizes = [len(writer.message(frame.arrival)) for frame in coded]
    pairs = list(zip(shown, drive.frames, strict=True))[1:]
    mse = float(np.mean([luma_mse(*pair) for pair in pairs]))
    sender_ms = {"convert": rendered.convert_ms, "render": rendered.render_ms, **sender.quartiles()}
    receiver_ms = {"render": rendered.render_ms, **receiver.quartiles()}
    row = {
        "sender_ms": sum(cpu for cpu, _ in sender_ms.values()),
        "receiver_ms": sum(cpu for cpu, _ in receiver_ms.values()),
        "sender_wall_ms": sum(wall for _, wall in sender_ms.values()),
        "receiver_wall_ms": sum(wall for _, wall in receiver_ms.values()),
        "sender_stage_ms": _cpu(sender_ms),
        "receiver_stage_ms": _cpu(receiver_ms),
        "bits_per_frame": 8 * float(np.mean(sizes[1:])),
        "psnr_db": psnr_of_mse(mse),
        "ssim": float(np.mean([ssim(ours.y, theirs.y) for ours, theirs in pairs])),
        "references_used": _counts(coded[1:]),
    }
    ends_ms = zip(
        rendered.frames_ms,
        sender.frames_ms(),
        receiver.frames_ms(),
        receiver.frames_ms("references"),
        strict=True,
    )
    return row, [
        FrameTimes(render + convert + coding, render + decoding, convert, render + references)
        for (render, convert), coding, decoding, references in ends_ms
    ]


class _Stages:
    """(cpu, wall) of each stage of each frame; the codec reads the clock between them."""

    def __init__(self, names: Sequence[str]) -> None:
        self.clock = StageClock()
        self._names = names
        self._frames: list[list[tuple[float, float]]] = []

    def frame_ended(self) -> None:
        spent = self.clock.spent_ms()
        if len(spent) != len(self._names):
            raise CodecError(f"{len(spent)} stages where {', '.join(self._names)} are expected")
        self._frames.append(spent)

    def frames_ms(self, *names: str) -> list[float]:
        """Return the processor time of these stages of each frame; of all without names."""
        places = [self._names.index(name) for name in names or self._names]
        return [sum(spent[place][0] for place in places) for spent in self._frames]

    def quartiles(self) -> dict[str, tuple[float, float]]:
        steady = list(zip(*self._frames[1:], strict=True))
        return {name: _quartile(spent) for name, spent in zip(self._names, steady, strict=True)}


def _choice(rung: Rung) -> FrameChoice:
    return FrameChoice(
        references=None if rung.references else RENDER_ONLY,
        photometric=None if rung.photometric else (),
        max_references=max(1, rung.references),
    )


def _counts(coded: Sequence[CodedFrame]) -> dict[str, int]:
    names = [references_name(frame.encoded.packet.references) for frame in coded]
    return {name: names.count(name) for name in dict.fromkeys(names)}


def _quartile(spent: Sequence[tuple[float, float]]) -> tuple[float, float]:
    cpu, wall = np.quantile(np.array(spent), 0.25, axis=0)
    return float(cpu), float(wall)


def _cpu(stages: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    return {name: cpu for name, (cpu, _) in stages.items()}


UNSTEADY_FRAMES = 2
"""Frames at the beginning of which the motion is not known."""


@dataclass(frozen=True)
class TrackedDrive:
    """A drive's views at the poses found, and what a frame's pose took, in ms of processor time
    beyond one render; ``renders``: the mean number of them."""

    views: tuple[FieldView, ...]
    track_ms: float
    renders: float


def track_drive(
    field: RadianceField, drive: Drive, quality: Quality, tracking: TrackingEffort
) -> TrackedDrive | None:
    """Track ``drive`` at its rate; ``None`` if a picture is lost on the way."""
    field.prepare(quality)
    draw = _TimedDrawing(field, drive.pictures[0].camera.intrinsics, quality)
    effort = TrackingBudget(tracking.redraws, tracking.finest_level)
    step_ns = round(1e9 / drive.name.rate_hz)
    tracks: list[Track] = []
    took_ms: list[float] = []
    for number, frame in enumerate(drive.frames):
        began_ns, drawn_ns = process_time_ns(), draw.spent_ns
        track = _next(tracks, number * step_ns, drive, Pyramid(frame.y), draw, effort)
        if track is None:
            return None
        tracks.append(track)
        drawing_ns = draw.spent_ns - drawn_ns
        took_ms.append((process_time_ns() - began_ns - drawing_ns) / 1e6)
    return _summary(tracks, took_ms, draw.spent_ns / 1e6 / draw.count)


def _next(
    tracks: Sequence[Track],
    time_ns: int,
    drive: Drive,
    picture: Pyramid,
    draw: _TimedDrawing,
    effort: TrackingBudget,
) -> Track | None:
    """Return the track with one picture more, begun at the dataset's pose."""
    if tracks:
        return follow_track(tracks[-1], time_ns, picture, draw, effort)
    return begin_track(time_ns, drive.cameras[0].world_from_cam, None, picture, draw)


def _summary(tracks: Sequence[Track], took_ms: Sequence[float], render_ms: float) -> TrackedDrive:
    renders = float(np.mean([track.renders for track in tracks[UNSTEADY_FRAMES:]]))
    aligning_ms = float(np.quantile(took_ms[UNSTEADY_FRAMES:], 0.25))
    views = tuple(track.view for track in tracks)
    return TrackedDrive(views, aligning_ms + (renders - 1) * render_ms, renders)


class _TimedDrawing:
    """Renders the field at a pose, as it will be sent, and adds up the processor time."""

    def __init__(self, field: RadianceField, intrinsics: Intrinsics, quality: Quality) -> None:
        self._field, self._intrinsics, self._quality = field, intrinsics, quality
        self.spent_ns, self.count = 0, 0

    def __call__(self, pose: Pose) -> FieldView:
        began_ns = process_time_ns()
        view = render_field_view(
            self._field, Camera(self._intrinsics, pose).rounded(), self._quality
        )
        self.spent_ns += process_time_ns() - began_ns
        self.count += 1
        return view
