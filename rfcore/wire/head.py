"""A frame on the wire: a packed head that costs what it says, then the payload.

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
| 2 | anchor: 0 none; 1 the frame before, of the same epoch; 2 named |
| without anchor | epoch and sequence: two numbers |
| after the frame before | lowest bits of epoch (4) and sequence (8) |
| after a named one | these bits of the anchor's; difference of epochs, sequence: two numbers |
| 8 | flags: 128 field, 64 quality, 32 instant, 16 sensing, 8 lost, 4 block means; light: 0 plain, \
1 matrix, 2 that of the base, 3 sent |
| number | capture time: microseconds after the predicted one (signed) |
| with field | 6: its place in Hello; else the anchor's, or the first |
| with quality | 2 detail, 1 scale, 3 degree of harmonics + 1, 13 samples of a ray; else the \
anchor's, or full |
| with instant | number; else one more than the anchor's, 0 after 0 |
| with sensing | 2 clock, 2 localisation; else the anchor's, or not stated |
| unless lost | 2: the quaternion's largest part; triple: metres; triple: its other parts: steps \
from the predicted pose (signed) |
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

*What the checks must catch.* The check is CRC-32 (zlib) of Hello's message, then of every value,
stated or implied, big-endian: camera (1 byte), epoch (4), sequence, microseconds (8 each), field,
detail, scale, degree (1 each), samples (2), instant (8), sensing, the flags from lost on (1 each),
bytes of a sent light (2), pose (7 numbers of 8), references (1), the matrix's numbers (2 each), the
digests, the digest of the base if it needs one, and everything behind. Nothing is rendered before
it was right. It finds every burst of 32 bits or less, and of 10**6 damaged messages it lets through
2.3e-4. A frame that was let through, or whose check was recomputed, must still end in the promised
picture: 48 bits let through 3.6e-9 of 10**6. Were all of 10**9 frames decoded wrongly, say by a
machine that renders otherwise, 3.6e-6 would pass. The 16 bits of the render prove nothing: they say
whether the render or the slice is to blame, and are wrong about that once in 65,536 such frames.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
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
from rfcore.field.quality import DETAILS, SCALES, Quality
from rfcore.wire.bits import BitReader, BitWriter, ByteReader
from rfcore.wire.convert import hello_to_bytes
from rfcore.wire.head_prediction import Head, KeptHeads, Prediction, head_of
from rfcore.wire.messages import Frame, FrameAddress, Hello
from rfcore.wire.v1 import edge_pb2 as pb
from rfcore.wire.values import (
    CLOCK_OF,
    MAX_PAYLOAD_BYTES,
    MAX_TRANSLATION_M,
    STATE_OF,
    check_range,
    shown,
)

REFERENCE_CODES: tuple[References, ...] = tuple(
    order for count in range(REFERENCE_FRAMES + 1) for order in permutations(Reference, count)
)
"""Every choice of references in its order, fewest first; a frame names one by its place here."""

_CODE_OF = {references: code for code, references in enumerate(REFERENCE_CODES)}
_CHECK_BYTES = 4
_FIELD, _QUALITY, _INSTANT, _SENSING, _LOST, _MEANS = 128, 64, 32, 16, 8, 4
_PLAIN, _MATRIX, _LEARNT, _SENT = range(4)
_ALONE, _AFTER_LAST, _AFTER_NAMED = range(3)
_CHECKED = struct.Struct(">BIQQBBBBHQBBH7qB")
_NO_POSE = (0,) * 7
_LONGEST_HEAD_BYTES = 128
"""Longer than any head up to its check, whatever its widths."""


class FrameRefused(PacketRejected):
    """A frame that cannot be taken; ``address`` says which, with camera "" if it cannot be told."""

    def __init__(self, reason: RejectReason, problem: str, address: FrameAddress) -> None:
        super().__init__(reason, problem)
        self.address = address


class FrameWriter:
    """Makes the messages of the frames of one stream, in the order in which they are sent."""

    def __init__(self, hello: Hello) -> None:
        self._hello = hello
        self._stream = stream_check(hello)
        self._cameras = {camera.camera_id: n for n, camera in enumerate(hello.cameras)}
        self._fields = {field_id: n for n, field_id in enumerate(hello.field_ids)} | {"": 0}
        self._heads = [KeptHeads() for _ in hello.cameras]

    def data(self, frame: Frame, after: FrameAddress | None) -> bytes:
        """Return the frame as bytes; ``after`` is its anchor, if that is still kept here.

        Raises ``InvalidInput`` for a camera or field that Hello does not name, a pose that is not
        on the lattice, and a packet that needs another base than its anchor.
        """
        camera = _place("frame.camera_id", frame.camera_id, self._cameras)
        heads = self._heads[camera]
        anchor = None if after is None else heads.at(after.epoch, after.sequence)
        packet = frame.packet
        if packet.needs_base and (anchor is None or anchor.digest != packet.base_digest):
            raise InvalidInput("frame.base_digest", "is not of the frame that it is sent after")
        head = head_of(frame, self._steps(frame), self._field(frame), anchor)
        heads.add(head)
        return _data(self._hello, self._stream, camera, frame, head, anchor)

    def _field(self, frame: Frame) -> int:
        return _place("frame.field_id", frame.field_id, self._fields)

    def _steps(self, frame: Frame) -> PoseSteps | None:
        if frame.pose is None:
            return None
        steps = self._hello.lattice.steps(frame.pose)
        if self._hello.lattice.pose(steps) != frame.pose:
            raise InvalidInput("frame.pose", f"{frame.pose} is not on the lattice; round it first")
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

    def frame(self, data: bytes) -> Frame:
        """Return the frame that ``FrameWriter.data`` made; it may be the anchor of later ones.

        Raises ``FrameRefused``: INVALID_ARGUMENT for values out of range, UNKNOWN_STATE for an
        anchor that did not arrive, CRC_MISMATCH for a frame that is not the one that was sent.
        """
        address = FrameAddress("", 0, 0)
        bits = BitReader(data[:_LONGEST_HEAD_BYTES])
        try:
            camera = bits.take(5)
            if camera >= len(self._heads):
                last = len(self._heads) - 1
                raise InvalidInput("frame.camera", f"{camera} where Hello has 0..{last}")
            camera_id, heads = self._hello.cameras[camera].camera_id, self._heads[camera]
            address = FrameAddress(camera_id, 0, 0)
            kind = bits.take(2)
            anchor, epoch, sequence = _addressed(bits, kind, heads)
            address = FrameAddress(camera_id, epoch, sequence)
            if kind and anchor is None:
                raise PacketRejected(
                    RejectReason.UNKNOWN_STATE, "the frame that it is sent after did not arrive"
                )
            check_range("frame.epoch", epoch, 0, 2**32 - 1)
            check_range("frame.sequence", sequence, 0, 2**63 - 1)
            check, head, frame = self._read(bits, data, camera, address, anchor)
        except InvalidInput as error:
            raise FrameRefused(RejectReason.INVALID_ARGUMENT, str(error), address) from error
        except PacketRejected as error:
            raise FrameRefused(error.reason, error.problem, address) from error
        expected = _check(self._stream, camera, frame, head)
        if check != expected:
            problem = f"CRC {check:08x} of contents with {expected:08x}"
            raise FrameRefused(RejectReason.CRC_MISMATCH, problem, address)
        heads.add(head)
        return frame

    def _read(
        self,
        bits: BitReader,
        data: bytes,
        camera: int,
        address: FrameAddress,
        anchor: Head | None,
    ) -> tuple[int, Head, Frame]:
        usual = Prediction(self._hello, camera, anchor)
        flags = bits.take(8)
        light_kind = flags & 3
        time_us = usual.time_us + bits.signed(bits.take(6))
        check_range("frame.capture_time_ns", time_us * 1000, 0, 2**63 - 1)
        field = bits.take(6) if flags & _FIELD else usual.field
        check_range("frame.field", field, 0, len(self._hello.field_ids) - 1)
        quality = _read_quality(bits) if flags & _QUALITY else usual.quality
        instant = bits.number() if flags & _INSTANT else usual.instant
        sensing = bits.take(4) if flags & _SENSING else usual.sensing
        check_range("frame.clock", sensing >> 2, 0, max(CLOCK_OF))
        steps = None if flags & _LOST else self._read_pose(bits, usual, time_us)
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
        means = behind.take(BLOCK_MEANS_BYTES if flags & _MEANS else 0)
        light, payload = behind.take(light_bytes), behind.rest()
        check_range("frame.payload bytes", len(payload), 0, MAX_PAYLOAD_BYTES)
        references, relit = REFERENCE_CODES[code], light_kind in (_LEARNT, _SENT)
        needs_base = light_kind == _LEARNT or is_temporal(references)
        if needs_base and anchor is None:
            raise InvalidInput("frame.references", "need an earlier frame, and none is named")
        packet = DeltaPacket(
            epoch=address.epoch,
            sequence=address.sequence,
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
        frame = Frame(
            address.camera_id,
            1000 * time_us,
            None if steps is None else self._hello.lattice.pose(steps),
            self._hello.field_ids[field] if field else "",
            packet,
            quality,
            CLOCK_OF.get(sensing >> 2),
            STATE_OF.get(sensing & 3),
            instant,
        )
        return check, head_of(frame, steps, field, anchor), frame

    def _read_pose(self, bits: BitReader, usual: Prediction, time_us: int) -> PoseSteps:
        lattice = self._hello.lattice
        largest, whole = bits.take(2), lattice.rotation_steps
        metres = [a + b for a, b in zip(bits.triple(), usual.metres(time_us), strict=True)]
        most = round(MAX_TRANSLATION_M) * lattice.steps_per_m
        for name, value in zip("xyz", metres, strict=True):
            check_range(f"frame.pose.{name} in steps", value, -most, most)
        left = iter(bits.triple())
        expected = usual.rotation(time_us, largest)
        parts = [whole if n == largest else expected[n] + next(left) for n in range(4)]
        for place, value in enumerate(parts):
            smallest = whole - 1 if place < largest else whole
            check_range("frame.pose.rotation in steps", value, -smallest, smallest)
        return (*metres, *parts)  # type: ignore[return-value]


def stream_check(hello: Hello) -> int:
    """Return the check of a stream's Hello, which the checks of its frames go on from."""
    return zlib.crc32(hello_to_bytes(hello))


def _place(name: str, value: str, places: Mapping[str, int]) -> int:
    try:
        return places[value]
    except KeyError:
        raise InvalidInput(name, f"{shown(value)} is not named in Hello") from None


def _addressed(bits: BitReader, kind: int, heads: KeptHeads) -> tuple[Head | None, int, int]:
    """Return a frame's anchor, epoch and sequence; without its anchor, the likely address."""
    if kind == _ALONE:
        return None, bits.number(), bits.number()
    if kind not in (_AFTER_LAST, _AFTER_NAMED):
        raise InvalidInput("frame.anchor", f"{kind} is above {_AFTER_NAMED}; update this end")
    epoch_bits, sequence_bits = bits.take(4), bits.take(8)
    if kind == _AFTER_LAST:
        anchor = heads.ending_in(epoch_bits, sequence_bits - 1 & 255)
        if anchor is None:
            return None, *heads.nearest(epoch_bits, sequence_bits)
        return anchor, anchor.epoch, anchor.sequence + 1
    anchor = heads.ending_in(epoch_bits, sequence_bits)
    later, sequence = bits.number(), bits.number()
    epoch = heads.nearest(epoch_bits, sequence_bits)[0] if anchor is None else anchor.epoch
    return anchor, epoch + later, sequence


def _data(
    hello: Hello, stream: int, camera: int, frame: Frame, head: Head, anchor: Head | None
) -> bytes:
    packet = frame.packet
    return b"".join(
        (
            _packed(hello, camera, frame, head, anchor),
            _check(stream, camera, frame, head).to_bytes(_CHECK_BYTES, "big"),
            packet.render_digest,
            packet.reconstruction_digest,
            packet.render_block_means,
            packet.light,
            packet.payload,
        )
    )


def _check(stream: int, camera: int, frame: Frame, head: Head) -> int:
    packet, quality = frame.packet, head.quality
    values = _CHECKED.pack(
        camera,
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
        _light_kind(packet)
        | (_LOST if head.pose is None else 0)
        | (_MEANS if packet.render_block_means else 0),
        len(packet.light),
        *(head.pose or _NO_POSE),
        _CODE_OF[packet.references],
    )
    before = (
        values,
        *(number.to_bytes(2, "big", signed=True) for number in packet.photometric),
        packet.render_digest,
        packet.reconstruction_digest,
        packet.base_digest,
        packet.render_block_means,
        packet.light,
    )
    return zlib.crc32(packet.payload, zlib.crc32(b"".join(before), stream))


def _packed(hello: Hello, camera: int, frame: Frame, head: Head, anchor: Head | None) -> bytes:
    """Return the head up to the check."""
    usual, packet, bits = Prediction(hello, camera, anchor), frame.packet, BitWriter()
    light = _light_kind(packet)
    flags = light
    flags |= _FIELD if head.field != usual.field else 0
    flags |= _QUALITY if head.quality != usual.quality else 0
    flags |= _INSTANT if head.instant != usual.instant else 0
    flags |= _SENSING if head.sensing != usual.sensing else 0
    flags |= _LOST if head.pose is None else 0
    flags |= _MEANS if packet.render_block_means else 0
    bits.put(camera, 5)
    _put_address(bits, head, anchor)
    bits.put(flags, 8)
    bits.signed_values((head.time_us - usual.time_us,))
    if flags & _FIELD:
        bits.put(head.field, 6)
    if flags & _QUALITY:
        _put_quality(bits, head.quality)
    if flags & _INSTANT:
        bits.number(head.instant)
    if flags & _SENSING:
        bits.put(head.sensing, 4)
    if head.pose is not None:
        _put_pose(bits, hello, head.pose, usual, head.time_us)
    bits.put(_CODE_OF[packet.references], 8)
    if light == _MATRIX:
        for number in packet.photometric:
            bits.put(number & 0xFFFF, 16)
    elif light == _SENT:
        bits.put(len(packet.light), 11)
    return bits.to_bytes()


def _light_kind(packet: DeltaPacket) -> int:
    if packet.photometric:
        return _MATRIX
    if packet.relit:
        return _SENT if packet.light else _LEARNT
    return _PLAIN


def _put_address(bits: BitWriter, head: Head, anchor: Head | None) -> None:
    if anchor is None:
        bits.put(_ALONE, 2)
        bits.number(head.epoch)
        bits.number(head.sequence)
    elif (head.epoch, head.sequence) == (anchor.epoch, anchor.sequence + 1):
        bits.put(_AFTER_LAST, 2)
        bits.put(head.epoch & 15, 4)
        bits.put(head.sequence & 255, 8)
    else:
        bits.put(_AFTER_NAMED, 2)
        bits.put(anchor.epoch & 15, 4)
        bits.put(anchor.sequence & 255, 8)
        bits.number(head.epoch - anchor.epoch)
        bits.number(head.sequence)


def _put_pose(
    bits: BitWriter, hello: Hello, pose: PoseSteps, usual: Prediction, time_us: int
) -> None:
    whole = hello.lattice.rotation_steps
    largest = next(n for n, part in enumerate(pose[3:]) if abs(part) == whole)
    metres, turn = usual.metres(time_us), usual.rotation(time_us, largest)
    bits.put(largest, 2)
    bits.signed_values(tuple(a - b for a, b in zip(pose[:3], metres, strict=True)))
    left = [a - b for a, b in zip(pose[3:], turn, strict=True)]
    del left[largest]
    bits.signed_values(tuple(left))


def _put_quality(bits: BitWriter, quality: Quality) -> None:
    bits.put(DETAILS.index(quality.detail), 2)
    bits.put(SCALES.index(quality.scale), 1)
    bits.put(0 if quality.sh_degree is None else quality.sh_degree + 1, 3)
    bits.put(quality.samples_per_ray or 0, 13)


def _read_quality(bits: BitReader) -> Quality:
    detail, scale, degree, samples = bits.take(2), bits.take(1), bits.take(3), bits.take(13)
    return Quality(DETAILS[detail], degree - 1 if degree else None, samples or None, SCALES[scale])
