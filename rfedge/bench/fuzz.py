"""Damage packets at random and hand them to the receiver: python -m rfedge.bench.fuzz --packets N

``--adapting`` takes a stream under another light than the field's, whose renders are relit.

What must hold for every damaged packet: the decoder refuses it with a reason, or shows exactly the
picture whose digest the packet carries; no other exception, no crash, and at most 50 ms of
processor time. Half of the packets get a fresh CRC, so that the later checks have to do the work;
now and then a whole packet must decode as if nothing had happened.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.h264.header import StreamHeader
from rfcore.codec.packet import BASE_DIGEST_BYTES, DeltaPacket
from rfcore.codec.photometric import sent_light
from rfcore.codec.references import INTRA, RENDER_ONLY, Reference, is_temporal
from rfcore.codec.sender.encoder import LEFT_TO_THE_ENCODER, DeltaEncoder, FrameChoice
from rfcore.codec.state import DecoderState
from rfcore.errors import CodecError, PacketRejected
from rfcore.image import I420
from rfcore.native.yuv import i420_from_colour
from rfcore.views import FieldView

__all__ = [
    "MUTATIONS",
    "FuzzStream",
    "fuzz",
    "make_adapting_stream",
    "make_stream",
    "mutations_of",
]

MAX_CPU_MS = 50.0
WHOLE_EVERY = 50
SIZE_PX = (64, 48)
WALL_M = 10.0
SHIFT_PX = 3.0
"""By which the picture moves between frames; the camera moves along a wall."""

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

Rng = np.random.Generator
Mutation = Callable[[DeltaPacket, Rng], DeltaPacket]


@dataclass(frozen=True)
class SentFrame:
    """A packet with what its receiver holds: the field at its pose, and the state before it."""

    packet: DeltaPacket
    view: FieldView
    before: DecoderState


@dataclass(frozen=True)
class FuzzStream:
    """A short stream with a frame of every kind."""

    header: StreamHeader
    frames: tuple[SentFrame, ...]


def make_stream(size_px: tuple[int, int] = SIZE_PX) -> FuzzStream:
    """Code one frame of every kind."""
    moments = [_moment(index, size_px) for index in range(len(CHOICES))]
    return _coded(size_px, CHOICES, moments)


def make_adapting_stream(size_px: tuple[int, int] = SIZE_PX) -> FuzzStream:
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
) -> FuzzStream:
    encoder = DeltaEncoder(CodecConfig(*size_px))
    decoder = DeltaDecoder(encoder.header)
    sending, receiving = encoder.start(1), decoder.start(1)
    frames = []
    for choice, (frame, view) in zip(choices, moments, strict=True):
        sent = encoder.encode(sending, frame, view, choice)
        frames.append(SentFrame(sent.packet, view, receiving))
        sending = sent.state
        receiving = decoder.decode(receiving, sent.packet, view).state
    return FuzzStream(encoder.header, tuple(frames))


def fuzz(stream: FuzzStream, packets: int, seed: int = 0) -> Counter[str]:
    """Decode ``packets`` damaged packets; return how often each outcome came.

    Raises ``CodecError`` for a wrong picture, a packet that took too long, or a whole packet that
    was refused; other exceptions of the decoder come through.
    """
    rng = np.random.default_rng(seed)
    decoder = DeltaDecoder(stream.header)
    mutations = list(mutations_of(stream).values())
    outcomes: Counter[str] = Counter()
    for number in range(packets):
        frame = stream.frames[rng.integers(len(stream.frames))]
        damaged = mutations[rng.integers(len(mutations))](frame.packet, rng)
        repaired = damaged.sealed() if number % 2 else damaged
        outcomes[_try(decoder, frame, repaired)] += 1
        if number % WHOLE_EVERY == 0 and _try(decoder, frame, frame.packet) != "shown":
            raise CodecError(f"a whole packet was refused after damaged packet {number}")
    return outcomes


def _try(decoder: DeltaDecoder, frame: SentFrame, packet: DeltaPacket) -> str:
    started_s = time.thread_time()  # decoding has no threads; other ones are none of its
    try:
        shown = decoder.decode(frame.before, packet, frame.view).frame
    except PacketRejected as rejection:
        outcome = str(rejection.reason)
    else:
        outcome = "shown"
        if shown.digest() != frame.packet.reconstruction_digest:
            raise CodecError(f"a damaged packet was shown as another picture: {packet}")
    spent_ms = (time.thread_time() - started_s) * 1e3
    if spent_ms > MAX_CPU_MS:
        raise CodecError(f"a damaged packet took {spent_ms:.0f} ms: {packet}")
    return outcome


# --- damage


def flip_bits(data: bytes, rng: Rng) -> bytes:
    """Flip one to four bits."""
    damaged = bytearray(data)
    for _ in range(int(rng.integers(1, 5)) if damaged else 0):
        damaged[rng.integers(len(damaged))] ^= 1 << int(rng.integers(8))
    return bytes(damaged)


def flip_payload(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    """Flip bits anywhere in the payload."""
    return replace(packet, payload=flip_bits(packet.payload, rng))


def flip_slice_header(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    """Flip bits in the first bytes of the payload."""
    start = flip_bits(packet.payload[:8], rng)
    return replace(packet, payload=start + packet.payload[8:])


def truncate(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    """Cut the payload short."""
    return replace(packet, payload=packet.payload[: rng.integers(len(packet.payload) + 1)])


def extend(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    """Add noise to the payload."""
    return replace(packet, payload=packet.payload + rng.bytes(int(rng.integers(1, 40))))


def overwrite(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    """Replace the end of the payload by noise."""
    start = int(rng.integers(len(packet.payload) + 1))
    return replace(packet, payload=packet.payload[:start] + rng.bytes(int(rng.integers(1, 200))))


def insert_nal(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    """Put a NAL unit of any type before, or after a start code behind, the payload."""
    unit = bytes([0x60 | int(rng.integers(32))]) + rng.bytes(int(rng.integers(1, 40)))
    joined = unit if rng.integers(2) else packet.payload + b"\x00\x00\x01" + unit
    return replace(packet, payload=joined)


def flip_digests(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    """Flip bits in one of the digests."""
    names = ["render_digest", "render_block_means", "reconstruction_digest", "base_digest"]
    name = names[rng.integers(len(names))]
    changed: dict[str, Any] = {name: flip_bits(getattr(packet, name), rng)}
    return replace(packet, **changed)


def renumber(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    """Change epoch or sequence by one bit."""
    name = ("epoch", "sequence")[rng.integers(2)]
    changed: dict[str, Any] = {name: getattr(packet, name) ^ (1 << int(rng.integers(63)))}
    return replace(packet, **changed)


def exchange_references(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    """Name other references, in another order."""
    count = int(rng.integers(4))
    order = [Reference(int(n)) for n in rng.permutation(4)[:count] + 1]
    needs = packet.learns_light or any(reference is not Reference.RENDER for reference in order)
    return replace(packet, references=tuple(order), base_digest=_base(packet, rng, needs))


def _base(packet: DeltaPacket, rng: Rng, needed: bool) -> bytes:
    """Return the packet's base, or one that is made up; nothing where none is needed."""
    return (packet.base_digest or rng.bytes(BASE_DIGEST_BYTES)) if needed else b""


def relight(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    """Send another matrix, as large as it may be, or the other way of relighting."""
    matrix = tuple(int(n) for n in rng.integers(-(1 << 15), 1 << 15, 12))
    relit = not rng.integers(3)
    photometric = matrix if not relit and rng.integers(4) else ()
    needed = _base(packet, rng, relit or is_temporal(packet.references))
    return replace(packet, photometric=photometric, base_digest=needed, relit=relit, light=b"")


def switch_relit(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    """Relight the render or leave it; the base stays, or is made up where one is needed now."""
    relit = not packet.relit
    needed = _base(packet, rng, relit or is_temporal(packet.references))
    return replace(packet, photometric=(), base_digest=needed, relit=relit, light=b"")


def damage_light(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    """Relight the render by a light that is damaged or, where none was sent, made up."""
    light = flip_bits(packet.light, rng) if packet.light else b"\x04" + rng.bytes(60)
    needed = _base(packet, rng, is_temporal(packet.references))
    return replace(packet, photometric=(), base_digest=needed, relit=True, light=light)


def exchange_base(packet: DeltaPacket, rng: Rng, digests: Sequence[bytes]) -> DeltaPacket:
    """Learn the light, and predict, from another of the frames with ``digests``."""
    base = digests[int(rng.integers(len(digests)))][:BASE_DIGEST_BYTES]
    if packet.needs_base:
        return replace(packet, base_digest=base)
    return replace(packet, photometric=(), base_digest=base, relit=True, light=b"")


MUTATIONS: dict[str, Mutation] = {
    mutation.__name__: mutation
    for mutation in (
        flip_payload,
        flip_slice_header,
        truncate,
        extend,
        overwrite,
        insert_nal,
        flip_digests,
        renumber,
        exchange_references,
        relight,
        switch_relit,
        damage_light,
    )
}
"""Damage that needs nothing but the packet."""


def mutations_of(stream: FuzzStream) -> Mapping[str, Mutation]:
    """Return every kind of damage, by its name."""
    digests = tuple(frame.packet.reconstruction_digest for frame in stream.frames)
    return {**MUTATIONS, "exchange_base": partial(exchange_base, digests=digests)}


# --- the stream


def _moment(index: int, size_px: tuple[int, int]) -> tuple[I420, FieldView]:
    """Return frame and field view of a camera that moves along a painted wall."""
    width, height = size_px
    k = Intrinsics(width, height, width, width, width / 2, height / 2)
    step_m = SHIFT_PX * WALL_M / width
    pose = Pose((index * step_m, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
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


def _report(outcomes: Counter[str], seconds: float) -> Iterator[str]:
    total = sum(outcomes.values())
    yield f"{total} packets in {seconds:.0f} s"
    for outcome, count in outcomes.most_common():
        yield f"  {outcome:24} {count:8}  {100 * count / total:5.1f} %"


def main() -> None:
    """Fuzz and print the outcomes."""
    parser = argparse.ArgumentParser(description=__doc__, prog="python -m rfedge.bench.fuzz")
    parser.add_argument("--packets", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--adapting", action="store_true")
    given = parser.parse_args()
    stream = make_adapting_stream() if given.adapting else make_stream()
    started_s = time.monotonic()
    outcomes = fuzz(stream, given.packets, given.seed)
    print("\n".join(_report(outcomes, time.monotonic() - started_s)))


if __name__ == "__main__":
    main()
