"""The start of a head: which picture was taken when and where, and how the field is rendered there.

It is what a vehicle knows before it codes; ``rfcore.wire.head`` has the layout.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

from rfcore.camera import PoseSteps
from rfcore.errors import InvalidInput, PacketRejected, RejectReason
from rfcore.field.quality import DETAILS, SCALES, Quality
from rfcore.wire.bits import BitReader, BitWriter
from rfcore.wire.head_prediction import Head, KeptHeads, Prediction, before_of
from rfcore.wire.messages import FrameAddress, Hello, PoseAhead
from rfcore.wire.values import CLOCK_OF, MAX_TRANSLATION_M, STATE_OF, check_range

FIELD, QUALITY, INSTANT, SENSING, LOST, MEANS = 128, 64, 32, 16, 8, 4
CODING_FLAGS_BITS = 3
"""The last flags: what is known once the frame was coded."""
_ALONE, _AFTER_LAST, _AFTER_NAMED, _SENT_AHEAD = range(4)


class FrameRefused(PacketRejected):
    """A frame that cannot be taken; ``address`` says which, with camera "" if it cannot be told."""

    def __init__(self, reason: RejectReason, problem: str, address: FrameAddress) -> None:
        super().__init__(reason, problem)
        self.address = address


@contextmanager
def refusing(address: FrameAddress) -> Iterator[None]:
    """Refuse the frame of ``address`` for an error in the block."""
    try:
        yield
    except InvalidInput as error:
        raise FrameRefused(RejectReason.INVALID_ARGUMENT, str(error), address) from error
    except FrameRefused:
        raise
    except PacketRejected as error:
        raise FrameRefused(error.reason, error.problem, address) from error


@dataclass(frozen=True)
class HeadStart:
    """A start that was read; ``flags``: the last ones, 0 of a pose ahead."""

    hello: Hello
    camera: int
    head: Head
    anchor: Head | None
    flags: int = 0

    @property
    def address(self) -> FrameAddress:
        """Return the address of the frame."""
        camera_id = self.hello.cameras[self.camera].camera_id
        return FrameAddress(camera_id, self.head.epoch, self.head.sequence)

    @property
    def ahead(self) -> PoseAhead:
        """Return what it says."""
        head, hello = self.head, self.hello
        return PoseAhead(
            hello.cameras[self.camera].camera_id,
            head.epoch,
            head.sequence,
            1000 * head.time_us,
            None if head.pose is None else hello.lattice.pose(head.pose),
            hello.field_ids[head.field] if head.field else "",
            head.quality,
            CLOCK_OF.get(head.sensing >> 2),
            STATE_OF.get(head.sensing & 3),
            head.instant,
            b"" if self.anchor is None else self.anchor.digest,
        )


def put_start(bits: BitWriter, start: HeadStart) -> None:
    """Write a start that was not sent ahead, with the last flags."""
    head, anchor, flags = start.head, start.anchor, start.flags
    usual = Prediction(start.hello, start.camera, anchor)
    flags |= FIELD if head.field != usual.field else 0
    flags |= QUALITY if head.quality != usual.quality else 0
    flags |= INSTANT if head.instant != usual.instant else 0
    flags |= SENSING if head.sensing != usual.sensing else 0
    flags |= LOST if head.pose is None else 0
    bits.put(start.camera, 5)
    _put_address(bits, head, anchor)
    bits.put(flags, 8)
    bits.signed_values((head.time_us - usual.time_us,))
    if flags & FIELD:
        bits.put(head.field, 6)
    if flags & QUALITY:
        _put_quality(bits, head.quality)
    if flags & INSTANT:
        bits.number(head.instant)
    if flags & SENSING:
        bits.put(head.sensing, 4)
    if head.pose is not None:
        _put_pose(bits, start.hello, head.pose, usual, head.time_us)


def put_start_sent_ahead(bits: BitWriter, start: HeadStart) -> None:
    """Write that the start was sent ahead, and the last flags."""
    bits.put(start.camera, 5)
    bits.put(_SENT_AHEAD, 2)
    _put_lowest_bits(bits, start.head)
    bits.put(start.flags, CODING_FLAGS_BITS)


def read_start(
    bits: BitReader,
    hello: Hello,
    kept: Sequence[KeptHeads],
    sent_ahead: Sequence[HeadStart | None],
) -> HeadStart:
    """Read a start; ``kept`` and ``sent_ahead``: of each camera, frames and the newest pose ahead.

    Raises ``FrameRefused``.
    """
    with refusing(FrameAddress("", 0, 0)):
        camera = bits.take(5)
        if camera >= len(kept):
            raise InvalidInput("frame.camera", f"{camera} where Hello has 0..{len(kept) - 1}")
    camera_id, heads = hello.cameras[camera].camera_id, kept[camera]
    with refusing(FrameAddress(camera_id, 0, 0)):
        kind = bits.take(2)
        if kind == _SENT_AHEAD:
            return _read_sent_ahead(bits, camera_id, heads, sent_ahead[camera])
        anchor, epoch, sequence = _read_address(bits, kind, heads)
    with refusing(FrameAddress(camera_id, epoch, sequence)):
        if kind and anchor is None:
            raise PacketRejected(
                RejectReason.UNKNOWN_STATE, "the frame that it is sent after did not arrive"
            )
        check_range("frame.epoch", epoch, 0, 2**32 - 1)
        check_range("frame.sequence", sequence, 0, 2**63 - 1)
        return _read_rest(bits, hello, camera, (epoch, sequence), anchor)


def _read_sent_ahead(
    bits: BitReader, camera_id: str, heads: KeptHeads, sent: HeadStart | None
) -> HeadStart:
    epoch_bits, sequence_bits = bits.take(4), bits.take(8)
    if sent is None or not sent.head.ends_in(epoch_bits, sequence_bits):
        raise FrameRefused(
            RejectReason.UNKNOWN_STATE,
            "the pose that was sent ahead of it did not arrive",
            FrameAddress(camera_id, *heads.nearest(epoch_bits, sequence_bits)),
        )
    flags = bits.take(CODING_FLAGS_BITS)
    return replace(sent, flags=flags)


def _read_rest(
    bits: BitReader, hello: Hello, camera: int, address: tuple[int, int], anchor: Head | None
) -> HeadStart:
    usual = Prediction(hello, camera, anchor)
    flags = bits.take(8)
    time_us = usual.time_us + bits.signed(bits.take(6))
    check_range("frame.capture_time_ns", time_us * 1000, 0, 2**63 - 1)
    field = bits.take(6) if flags & FIELD else usual.field
    check_range("frame.field", field, 0, len(hello.field_ids) - 1)
    quality = _read_quality(bits) if flags & QUALITY else usual.quality
    instant = bits.number() if flags & INSTANT else usual.instant
    sensing = bits.take(4) if flags & SENSING else usual.sensing
    check_range("frame.clock", sensing >> 2, 0, max(CLOCK_OF))
    steps = None if flags & LOST else _read_pose(bits, hello, usual, time_us)
    before = before_of(anchor)
    head = Head(*address, time_us, steps, field, quality, instant, sensing, before)
    return HeadStart(hello, camera, head, anchor, flags=flags & (1 << CODING_FLAGS_BITS) - 1)


def _put_address(bits: BitWriter, head: Head, anchor: Head | None) -> None:
    if anchor is None:
        bits.put(_ALONE, 2)
        bits.number(head.epoch)
        bits.number(head.sequence)
    elif (head.epoch, head.sequence) == (anchor.epoch, anchor.sequence + 1):
        bits.put(_AFTER_LAST, 2)
        _put_lowest_bits(bits, head)
    else:
        bits.put(_AFTER_NAMED, 2)
        _put_lowest_bits(bits, anchor)
        bits.number(head.epoch - anchor.epoch)
        bits.number(head.sequence)


def _put_lowest_bits(bits: BitWriter, head: Head) -> None:
    """Write the end of an address, as ``Head.ends_in`` compares it."""
    bits.put(head.epoch & 15, 4)
    bits.put(head.sequence & 255, 8)


def _read_address(bits: BitReader, kind: int, heads: KeptHeads) -> tuple[Head | None, int, int]:
    """Return a frame's anchor, epoch and sequence; without its anchor, the likely address."""
    if kind == _ALONE:
        return None, bits.number(), bits.number()
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


def _read_pose(bits: BitReader, hello: Hello, usual: Prediction, time_us: int) -> PoseSteps:
    lattice = hello.lattice
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


def _put_quality(bits: BitWriter, quality: Quality) -> None:
    bits.put(DETAILS.index(quality.detail), 2)
    bits.put(SCALES.index(quality.scale), 1)
    bits.put(0 if quality.sh_degree is None else quality.sh_degree + 1, 3)
    bits.put(quality.samples_per_ray or 0, 13)


def _read_quality(bits: BitReader) -> Quality:
    detail, scale, degree, samples = bits.take(2), bits.take(1), bits.take(3), bits.take(13)
    return Quality(DETAILS[detail], degree - 1 if degree else None, samples or None, SCALES[scale])
