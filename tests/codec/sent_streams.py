"""Short streams with a frame of every kind, and the loop of a sender and its receiver."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.packet import DeltaPacket
from rfcore.codec.photometric import sent_light
from rfcore.codec.references import INTRA, RENDER_ONLY, DecoderState, Reference
from rfcore.codec.sender.encoder import LEFT_TO_THE_ENCODER, DeltaEncoder, Encoded, FrameChoice
from rfcore.image import I420
from rfcore.native.yuv import i420_from_colour
from rfcore.views import FieldView
from rfcore.wire.head import FrameWriter
from rfcore.wire.messages import CameraDescription, Frame, Hello, RendererContract
from rfcore.wire.v1.edge_pb2 import StreamRequest

SIZE_PX = (64, 48)
WALL_M = 10.0
SHIFT_PX = 3.0
"""Motion of the picture between frames; the camera moves along a wall."""

LIGHT = (4096, 0, 0, 32, 0, 4096, 0, 0, 0, 0, 4096, 0)
"""Two levels brighter."""

PLAIN = (
    FrameChoice(INTRA),
    FrameChoice((Reference.RENDER,)),
    FrameChoice((Reference.PREVIOUS,)),
    FrameChoice((Reference.WARP, Reference.PREVIOUS, Reference.RENDER)),
    FrameChoice((Reference.PREVIOUS, Reference.RENDER, Reference.CORRECTION)),
    FrameChoice((Reference.RENDER, Reference.WARP), photometric=LIGHT),
    FrameChoice((Reference.CORRECTION,), pose_only=True),
)
CHOICES = (
    *(replace(choice, relight=False) for choice in PLAIN),
    FrameChoice((Reference.PREVIOUS, Reference.RENDER), relight=True),
    FrameChoice((Reference.RENDER,), relight=True),
)
RELIT = (
    (Reference.PREVIOUS, Reference.RENDER),
    (Reference.RENDER,),
    (Reference.PREVIOUS, Reference.CORRECTION),
    (Reference.WARP, Reference.PREVIOUS, Reference.RENDER),
    (Reference.CORRECTION, Reference.PREVIOUS, Reference.RENDER),
)
"""References of the frames of an adapting stream that are relit."""


@dataclass(frozen=True)
class SentFrame:
    """A packet with what its receiver holds: the field at its pose, and the state before it."""

    packet: DeltaPacket
    view: FieldView
    before: DecoderState


@dataclass(frozen=True)
class SentStream:
    """A short stream with a frame of every kind."""

    header: StreamHeader
    frames: tuple[SentFrame, ...]


def sent_frames(stream: SentStream) -> tuple[Hello, list[tuple[bytes, Frame]]]:
    """Return the Hello of a vehicle that sends the stream, and its frames as they are sent."""
    intrinsics = stream.frames[0].view.camera.intrinsics
    camera = CameraDescription("front", intrinsics, stream.header, 10.0)
    hello = Hello("golden", (camera,), ("ab" * 32,), RendererContract("golden", exact=True))
    writer, frames, last = FrameWriter(hello), [], None
    for index, sent in enumerate(stream.frames):
        pose = sent.view.camera.world_from_cam
        frame = Frame("front", index * 100_000_000, pose, "", sent.packet)
        frames.append((writer.data(frame, last), frame))
        last = frame.address
    return hello, frames


def sent_after_poses(stream: SentStream) -> tuple[Hello, list[tuple[bytes, bytes, Frame]]]:
    """Return the same of a vehicle that sends poses ahead: pose, frame as sent, and frame."""
    hello, frames = sent_frames(stream)
    writer, sent, last = FrameWriter(hello), [], None
    for _, frame in frames:
        ahead = StreamRequest.FromString(writer.ahead(frame.ahead, last)).pose_ahead
        sent.append((ahead, writer.data(frame, last), frame))
        last = frame.address
    return hello, sent


def exchange(
    encoder: DeltaEncoder,
    pictures: Iterable[tuple[I420, FieldView]],
    choices: Iterable[FrameChoice] | None = None,
) -> list[Encoded]:
    """Code and decode pictures in order; assert that each decodes to what the encoder promised."""
    decoder = DeltaDecoder(encoder.header)
    sending, receiving, made = encoder.start(1), decoder.start(1), []
    for (frame, view), choice in zip(pictures, choices or repeat(FrameChoice()), strict=False):
        encoded = encoder.encode(sending, frame, view, choice)
        decoded = decoder.decode(receiving, encoded.packet, view)
        assert decoded.frame.digest() == encoded.reconstruction.digest()
        assert decoded.frame.size_px == frame.size_px
        assert (encoded.packet.sequence, decoded.lost) == (len(made), 0)
        sending, receiving = encoded.state, decoded.state
        made.append(encoded)
    return made


def make_stream(size_px: tuple[int, int] = SIZE_PX) -> SentStream:
    """Code one frame of every kind."""
    moments = [_moment(index, size_px) for index in range(len(CHOICES))]
    return _coded(size_px, CHOICES, moments)


def make_adapting_stream(size_px: tuple[int, int] = SIZE_PX) -> SentStream:
    """Code frames of a street that grows dark: the first is not relit, all others are, the second
    by a light that is sent."""
    moments = [_moment(index, size_px) for index in range(2 + len(RELIT))]
    darker = [
        (_lamplit(frame, 0.9 - 0.05 * index), view) for index, (frame, view) in enumerate(moments)
    ]
    second, view = darker[1]
    light = sent_light(second, view.render)
    choices = [LEFT_TO_THE_ENCODER, FrameChoice(RENDER_ONLY, relight=True, light=light)]
    choices += [FrameChoice(names, relight=True) for names in RELIT]
    return _coded(size_px, choices, darker)


def _coded(
    size_px: tuple[int, int],
    choices: Sequence[FrameChoice],
    moments: Sequence[tuple[I420, FieldView]],
) -> SentStream:
    encoder = DeltaEncoder(CodecConfig(*size_px))
    decoder = DeltaDecoder(encoder.header)
    sending, receiving = encoder.start(1), decoder.start(1)
    frames = []
    for choice, (frame, view) in zip(choices, moments, strict=True):
        sent = encoder.encode(sending, frame, view, choice)
        frames.append(SentFrame(sent.packet, view, receiving))
        sending = sent.state
        receiving = decoder.decode(receiving, sent.packet, view).state
    return SentStream(encoder.header, tuple(frames))


def _moment(index: int, size_px: tuple[int, int]) -> tuple[I420, FieldView]:
    """Return frame and field view of a camera that moves along a painted wall."""
    width, height = size_px
    k = Intrinsics(width, height, width, width, width / 2, height / 2)
    step_m = SHIFT_PX * WALL_M / width
    pose = Pose((index * step_m, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)).rounded()
    depth = np.full((height, width), WALL_M, np.float32)
    x, y = np.meshgrid(np.arange(width) + SHIFT_PX * index, np.arange(height))
    luma = 0.5 + 0.2 * np.sin(x / 5) * np.cos(y / 4) + 0.1 * (np.sin(x / 2) > math.sin(1))
    wall = np.stack([luma, luma * 0.9, 1 - luma], axis=-1)
    rng = np.random.default_rng(index)
    noisy = wall + rng.normal(0, 0.02, wall.shape)
    noisy[height // 2 :, :: 1 + index] *= 0.7
    frame, render = (i420_from_colour(c.astype(np.float32)) for c in (noisy, wall))
    return frame, FieldView(Camera(k, pose), render, depth)


def _lamplit(picture: I420, brightness: float) -> I420:
    """Return the picture darkened to ``brightness`` from the left to the right, and bluer."""
    ramp = np.linspace(1.1, brightness, picture.size_px[0], dtype=np.float32)[None, :]
    y = (picture.y - 16.0) * ramp + 16
    u, v = (picture.u - 128.0) * ramp[:, ::2] + 136, (picture.v - 128.0) * ramp[:, ::2] + 128
    return I420(*(np.clip(np.rint(plane), 1, 255).astype(np.uint8) for plane in (y, u, v)))
