"""A frame on the wire: a packed head that costs what it says, then the payload.

A vehicle knows where a picture was taken before it has coded it. It may send that, the first part
of the head, as a message of its own: the *pose ahead* of the frame, which then leaves it out. A
pose ahead is never answered; what is wrong with it is told of its frame, which names it and is
refused without it.

Usual values are implied by an earlier frame of the camera, the frame's *anchor*: one that the
sender takes the receiver to have, as it does the frame that the packet is predicted from
(``rfcore.wire.head_prediction``). Frames name their anchor by its address. A frame without an
anchor stands alone: the first of a stream, or of a drive file. One that is lost costs those that
name it, until the sender goes back to another.

Layout, most significant bit first. A *number* is 6 bits, the width w, and w bits; a *triple* is a
width and three values of that width. Signed values are 2 v, or -2 v - 1 below 0.

| bits | what |
|---|---|
| 5 | camera: its place in Hello |
| 2 | anchor: 0 none; 1 the frame before, of the same epoch; 2 named; 3 all up to the pose was \
sent ahead |
| without anchor | epoch and sequence: two numbers |
| after the frame before | lowest bits of epoch (4) and sequence (8) |
| after a named one | these bits of the anchor's; difference of epochs, sequence: two numbers |
| after a pose ahead | lowest bits of its epoch (4) and sequence (8); 3: the last three flags |
| else 8 | flags: 128 field, 64 quality, 32 instant, 16 sensing, 8 lost, 4 block means; light: 0 \
plain, 1 matrix, 2 that of the base, 3 sent |
| else number | capture time: microseconds after the predicted one (signed) |
| with field | 6: its place in Hello; else the anchor's, or the first |
| with quality | 2 detail, 1 scale, 3 degree of harmonics + 1, 13 samples of a ray; else the \
anchor's, or full |
| with instant | number; else one more than the anchor's, 0 after 0 |
| with sensing | 2 clock, 2 localisation; else the anchor's, or not stated |
| unless lost | 2: the quaternion's largest part; triple: metres; triple: its other parts: steps \
from the predicted pose (signed); a pose ahead ends here, zeros up to a byte and 16 bits of check \
follow |
| 8 | references: a place in ``REFERENCE_CODES`` |
| with a matrix | 12 numbers of 16 bits (two's complement) |
| with a sent light | 11: its bytes |
| 0 to 7 | zeros up to a byte |
| 32 | check |
| 16, 48 | digests of render and reconstruction: the first bytes of ``I420.digest`` |
| with block means | 64 bytes |
| with a sent light | the light |
| the rest | payload |

Bytes of each part, by ``lab/results/head.md`` where usual; at worst of a frame that stands alone:

| part | usual | worst |
|---|---|---|
| protobuf and gRPC's message: tag, length | 3 | 4 |
| camera, anchor, address, flags | 3.4 | 15 |
| capture time | 0.8 to 3 | 7 |
| field, quality, instant, sensing | 0 | 12 |
| pose | 5 to 9 | 20 |
| references | 1 | 1 |
| light | 0 | 24 (matrix), 1026 (sent) |
| check | 4 | 4 |
| digests | 8 | 8 |
| block means, between inexact renderers alone | 0 | 64 |
| with the pose ahead: its message, and what is left of the head | 14 and 19 | 59 and 19 |

*What the checks must catch.* The check is CRC-32 (zlib) of Hello's message, then of every value,
stated, implied or sent ahead, big-endian: camera (1 byte), epoch (4), sequence, microseconds (8
each), field, detail, scale, degree (1 each), samples (2), instant (8), sensing, the flags from lost
on (1 each), bytes of a sent light (2), pose (7 numbers of 8), references (1), the matrix's numbers
(2 each), the digests, the digest of the base if it needs one, and everything behind. A pose ahead
has the lowest 16 bits of the check of these values up to references, with 0 for what coding adds:
of 10**6 damaged ones they let 15 through. Each costs a render and its frame, since the frame's own
check covers the same values. No frame is rendered before its check was right. It finds every burst
of 32 bits or less, and of 10**6 damaged messages it lets through 2.3e-4. A frame that was let
through, or whose check was recomputed, must still end in the promised picture: 48 bits let through
3.6e-9 of 10**6. Were all of 10**9 frames decoded wrongly, say by a machine that renders otherwise,
3.6e-6 would pass. The 16 bits of the render prove nothing: they say whether the render or the slice
is to blame, and are wrong about that once in 65,536 such frames.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import permutations

from rfcore.camera import PoseSteps
from rfcore.codec.h264.config import REFERENCE_FRAMES
from rfcore.codec.packet import (
    BLOCK_MEANS_BYTES,
    RECONSTRUCTION_DIGEST_BYTES,
    RENDER_DIGEST_BYTES,
    DeltaPacket,
)
from rfcore.codec.photometric import COEFFICIENTS, MOST_LIGHT_BYTES
from rfcore.codec.references import Reference, References, is_temporal
from rfcore.errors import InvalidInput, PacketRejected, RejectReason
from rfcore.field.quality import DETAILS, SCALES
from rfcore.wire.bits import BitReader, BitWriter, ByteReader
from rfcore.wire.convert import hello_to_bytes
from rfcore.wire.head_prediction import KeptHeads, head_of
from rfcore.wire.head_start import (
    LOST,
    MEANS,
    FrameRefused,
    HeadStart,
    put_start,
    put_start_sent_ahead,
    read_start,
    refusing,
)
from rfcore.wire.messages import Frame, FrameAddress, Hello, PackedFrame, PoseAhead
from rfcore.wire.v1 import edge_pb2 as pb
from rfcore.wire.values import MAX_PAYLOAD_BYTES, check_range, shown

__all__ = ["FrameReader", "FrameRefused", "FrameWriter", "stream_check"]

REFERENCE_CODES: tuple[References, ...] = tuple(
    order for count in range(REFERENCE_FRAMES + 1) for order in permutations(Reference, count)
)
"""Every choice of references in its order, fewest first; a frame names one by its place here."""

_CODE_OF = {references: code for code, references in enumerate(REFERENCE_CODES)}
_CHECK_BYTES, _AHEAD_CHECK_BYTES = 4, 2
_PLAIN, _MATRIX, _LEARNT, _SENT = range(4)
_CHECKED = struct.Struct(">BIQQBBBBHQBBH7qB")
_NO_POSE = (0,) * 7
_LONGEST_HEAD_BYTES = 128
"""Longer than any head up to its check, whatever its widths."""


class FrameWriter:
    """Makes the messages of the frames of one stream, in the order in which they are sent."""

    def __init__(self, hello: Hello) -> None:
        self._hello = hello
        self._stream = stream_check(hello)
        self._cameras = {camera.camera_id: n for n, camera in enumerate(hello.cameras)}
        self._fields = {field_id: n for n, field_id in enumerate(hello.field_ids)} | {"": 0}
        self._heads = [KeptHeads() for _ in hello.cameras]
        self._sent_ahead: list[HeadStart | None] = [None] * len(hello.cameras)

    def ahead(self, ahead: PoseAhead, after: FrameAddress | None) -> bytes:
        """Return the message of a pose ahead of its frame; ``after``: the frame's anchor.

        Raises ``InvalidInput`` as ``data``.
        """
        start = self._start(ahead, after)
        self._sent_ahead[start.camera] = start
        bits = BitWriter()
        put_start(bits, start)
        check = _start_check(self._stream, start) & 0xFFFF
        data = bits.to_bytes() + check.to_bytes(_AHEAD_CHECK_BYTES, "big")
        return pb.StreamRequest(pose_ahead=data).SerializeToString()

    def data(self, frame: Frame, after: FrameAddress | None) -> bytes:
        """Return the frame as bytes; ``after`` is its anchor, if that is still kept here.

        It leaves out what a pose ahead said, if that was the same. Raises ``InvalidInput`` for a
        camera or field that Hello does not name, a pose that is not on the lattice, and a packet
        that needs another base than its anchor.
        """
        packet = frame.packet
        start = self._start(frame.ahead, after)
        anchor = start.anchor
        if packet.needs_base and (anchor is None or anchor.digest != packet.base_digest):
            raise InvalidInput("frame.base_digest", "is not of the frame that it is sent after")
        is_ahead = self._sent_ahead[start.camera] == start
        self._sent_ahead[start.camera] = None
        means = MEANS if packet.render_block_means else 0
        start = replace(start, flags=_light_kind(packet) | means)
        self._heads[start.camera].add(replace(start.head, digest=packet.reconstruction_digest))
        return _data(self._stream, start, packet, is_ahead=is_ahead)

    def _start(self, ahead: PoseAhead, after: FrameAddress | None) -> HeadStart:
        camera = _place("frame.camera_id", ahead.camera_id, self._cameras)
        anchor = None if after is None else self._heads[camera].at(after.epoch, after.sequence)
        field = _place("frame.field_id", ahead.field_id, self._fields)
        return HeadStart(
            self._hello, camera, head_of(ahead, self._steps(ahead), field, anchor), anchor
        )

    def _steps(self, ahead: PoseAhead) -> PoseSteps | None:
        if ahead.pose is None:
            return None
        steps = self._hello.lattice.steps(ahead.pose)
        if self._hello.lattice.pose(steps) != ahead.pose:
            raise InvalidInput("frame.pose", f"{ahead.pose} is not on the lattice; round it first")
        return steps

    def message(self, frame: Frame, after: FrameAddress | None) -> bytes:
        """Return the whole message of the frame, as ``data`` has it; its length counts."""
        return pb.StreamRequest(frame=self.data(frame, after)).SerializeToString()

    def in_order(self, frames: Iterable[Frame]) -> Iterator[bytes]:
        """Yield frames that all arrive as messages, each after the one of its camera before
        it."""
        last: dict[str, FrameAddress] = {}
        for frame in frames:
            yield self.message(frame, last.get(frame.camera_id))
            last[frame.camera_id] = frame.address


class FrameReader:
    """Reads the frames of one stream, in the order in which they arrive."""

    def __init__(self, hello: Hello) -> None:
        self._hello = hello
        self._stream = stream_check(hello)
        self._heads = [KeptHeads() for _ in hello.cameras]
        self._sent_ahead: list[HeadStart | None] = [None] * len(hello.cameras)

    def read(self, packed: PackedFrame) -> Frame | PoseAhead:
        """Return the frame or the pose ahead of one; raises as those do."""
        return self.ahead(packed.data) if packed.is_ahead else self.frame(packed.data)

    def ahead(self, data: bytes) -> PoseAhead:
        """Return the pose ahead that ``FrameWriter.ahead`` made; a frame may leave it out now.

        Raises ``FrameRefused`` as ``frame``, and STALE_SEQUENCE if one of this frame or a later one
        came before.
        """
        nothing: list[HeadStart | None] = [None] * len(self._heads)
        bits = BitReader(data[:_LONGEST_HEAD_BYTES])
        start = read_start(bits, self._hello, self._heads, nothing)
        place = start.head.epoch, start.head.sequence
        with refusing(start.address):
            if start.flags:
                raise InvalidInput("pose_ahead.flags", f"{start.flags} are of a coded frame")
            bits.skip_to_byte()
            behind = ByteReader(data, bits.bits_taken // 8)
            check = int.from_bytes(behind.take(_AHEAD_CHECK_BYTES), "big")
            check_range("pose_ahead.bytes too many", len(behind.rest()), 0, 0)
            _require_check(check, _start_check(self._stream, start) & 0xFFFF)
            before = self._sent_ahead[start.camera]
            if self._heads[start.camera].at(*place) is not None or (
                before is not None and (before.head.epoch, before.head.sequence) >= place
            ):
                raise PacketRejected(
                    RejectReason.STALE_SEQUENCE, "its frame, or another pose ahead, came before"
                )
        self._sent_ahead[start.camera] = start
        return start.ahead

    def frame(self, data: bytes) -> Frame:
        """Return the frame that ``FrameWriter.data`` made; it may be the anchor of later ones.

        Raises ``FrameRefused``: INVALID_ARGUMENT for values out of range, UNKNOWN_STATE for an
        anchor or a pose ahead that did not arrive, CRC_MISMATCH for a frame that is not the one
        that was sent.
        """
        bits = BitReader(data[:_LONGEST_HEAD_BYTES])
        start = read_start(bits, self._hello, self._heads, self._sent_ahead)
        with refusing(start.address):
            check, packet = _read_packet(bits, data, start)
            _require_check(check, _check(self._stream, start, packet))
        self._heads[start.camera].add(replace(start.head, digest=packet.reconstruction_digest))
        self._sent_ahead[start.camera] = None
        return start.ahead.frame(packet)


def _read_packet(bits: BitReader, data: bytes, start: HeadStart) -> tuple[int, DeltaPacket]:
    """Return the check and the packet behind a start."""
    anchor, light_kind = start.anchor, start.flags & ~MEANS
    code = bits.take(8)
    if code >= len(REFERENCE_CODES):
        raise InvalidInput(
            "frame.references", f"{code} is above {len(REFERENCE_CODES) - 1}; update this end"
        )
    matrix = (
        tuple((bits.take(16) ^ 1 << 15) - (1 << 15) for _ in range(COEFFICIENTS))
        if light_kind == _MATRIX
        else ()
    )
    light_bytes = bits.take(11) if light_kind == _SENT else 0
    check_range("frame.light", light_bytes, 2 if light_kind == _SENT else 0, MOST_LIGHT_BYTES)
    bits.skip_to_byte()
    behind = ByteReader(data, bits.bits_taken // 8)
    check = int.from_bytes(behind.take(_CHECK_BYTES), "big")
    render_digest = behind.take(RENDER_DIGEST_BYTES)
    digest = behind.take(RECONSTRUCTION_DIGEST_BYTES)
    means = behind.take(BLOCK_MEANS_BYTES if start.flags & MEANS else 0)
    light, payload = behind.take(light_bytes), behind.rest()
    check_range("frame.payload bytes", len(payload), 0, MAX_PAYLOAD_BYTES)
    references, relit = REFERENCE_CODES[code], light_kind in (_LEARNT, _SENT)
    needs_base = light_kind == _LEARNT or is_temporal(references)
    if needs_base and anchor is None:
        raise InvalidInput("frame.references", "need an earlier frame, and none is named")
    return check, DeltaPacket(
        epoch=start.head.epoch,
        sequence=start.head.sequence,
        render_digest=render_digest,
        render_block_means=means,
        reconstruction_digest=digest,
        payload=payload,
        references=references,
        base_digest=anchor.digest if needs_base and anchor is not None else b"",
        photometric=matrix,
        relit=relit,
        light=light,
    )


def stream_check(hello: Hello) -> int:
    """Return the check of a stream's Hello, which the checks of its frames go on from."""
    return zlib.crc32(hello_to_bytes(hello))


def _place(name: str, value: str, places: Mapping[str, int]) -> int:
    try:
        return places[value]
    except KeyError:
        raise InvalidInput(name, f"{shown(value)} is not named in Hello") from None


def _require_check(check: int, expected: int) -> None:
    if check != expected:
        raise PacketRejected(
            RejectReason.CRC_MISMATCH, f"CRC {check:08x} of contents with {expected:08x}"
        )


def _start_check(stream: int, start: HeadStart, light_bytes: int = 0, code: int = 0) -> int:
    """Return the check of a start; of a frame's with what coding adds to its values."""
    head, quality = start.head, start.head.quality
    values = _CHECKED.pack(
        start.camera,
        head.epoch,
        head.sequence,
        head.time_us,
        head.field,
        DETAILS.index(quality.detail),
        SCALES.index(quality.scale),
        0 if quality.sh_degree is None else quality.sh_degree + 1,
        quality.samples_per_ray or 0,
        head.instant,
        head.sensing,
        start.flags | (LOST if head.pose is None else 0),
        light_bytes,
        *(head.pose or _NO_POSE),
        code,
    )
    return zlib.crc32(values, stream)


def _check(stream: int, start: HeadStart, packet: DeltaPacket) -> int:
    code = _CODE_OF[packet.references]
    checked = (
        *(number.to_bytes(2, "big", signed=True) for number in packet.photometric),
        packet.render_digest,
        packet.reconstruction_digest,
        packet.base_digest,
        packet.render_block_means,
        packet.light,
        packet.payload,
    )
    return zlib.crc32(b"".join(checked), _start_check(stream, start, len(packet.light), code))


def _data(stream: int, start: HeadStart, packet: DeltaPacket, *, is_ahead: bool) -> bytes:
    bits = BitWriter()
    (put_start_sent_ahead if is_ahead else put_start)(bits, start)
    bits.put(_CODE_OF[packet.references], 8)
    for number in packet.photometric:
        bits.put(number & 0xFFFF, 16)
    if packet.light:
        bits.put(len(packet.light), 11)
    return b"".join(
        (
            bits.to_bytes(),
            _check(stream, start, packet).to_bytes(_CHECK_BYTES, "big"),
            packet.render_digest,
            packet.reconstruction_digest,
            packet.render_block_means,
            packet.light,
            packet.payload,
        )
    )


def _light_kind(packet: DeltaPacket) -> int:
    if packet.photometric:
        return _MATRIX
    if packet.relit:
        return _SENT if packet.light else _LEARNT
    return _PLAIN
