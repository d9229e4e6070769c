"""Tells which pictures of a camera rest on whole pictures only.

A decoder hides what it lost. After a lost P picture FFmpeg 8 gives all pictures up to the next key
frame without a flag or an error, 18 to 20 dB from the truth; it flags at most the damaged one. So
nothing is passed on from the first sign of a loss until a key frame, or a recovery point that was
reached. Signs are an error or a flag of the decoder, a flag of the packet, a gap in H.264's frame
numbers (7.4.3), and a gap in the time stamps: where frame numbers repeat within it, or for a codec
without them on a transport that loses packets.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from statistics import median
from typing import Generic, TypeVar

from rfcore.codec.h264.bitstream import (
    NAL_IDR,
    NAL_P,
    NAL_SPS,
    BitReader,
    nal_type,
    split_nals,
)
from rfcore.errors import BitstreamError

NAL_SEI = 6
HIGH_PROFILES = {44, 83, 86, 100, 110, 118, 122, 128, 134, 138, 139, 244}
RECOVERY_POINT = 6
MAX_PARSED_BYTES = 256
"""Bytes of a unit that are read; the fields wanted come first."""
LEAST_STEPS, STEPS = 4, 16
"""Steps of the time stamps before a gap is told, and of which the usual one is the median."""
KEPT_PACKETS = 64
MOST_INSIDE = 17
"""Packets that a decoder may hold; the picture of one before them is never shown."""
P = TypeVar("P")


class UnbrokenPictures(Generic[P]):
    """Follows one stream: call ``packet`` before its packet is decoded, then ``broke`` for an error
    and ``released`` for each picture that came out.

    A picture that is shown before one that it may be predicted from (a B picture) waits for that
    one's flag.

    ``has_frame_numbers``: H.264 as a byte stream, of which ``headers`` come before the packets.
    ``may_lose``: the transport loses packets.
    """

    def __init__(self, *, has_frame_numbers: bool, may_lose: bool, headers: bytes = b"") -> None:
        self._has_frame_numbers = has_frame_numbers
        self._may_lose = may_lose
        self._count = 0
        self._broken_at: int | None = None
        self._numbers = FrameNumbers()
        if headers:
            self._numbers.follows(headers, 1.0)
        self._packets: dict[int, tuple[int, int | None]] = {}
        """Number of the packet, and pictures that a recovery point takes, by time stamp."""
        self._recovered_from: int | None = None
        self._waiting: list[tuple[int, P]] = []
        """Numbers of packets, and their pictures, which other pictures must come out before."""
        self._inside: set[int] = set()
        """Numbers of packets of which no picture has come out."""
        self.left_out = 0
        self._last_time: int | None = None
        self._steps: deque[int] = deque(maxlen=STEPS)

    def packet(self, data: bytes, pts: int | None, dts: int | None, *, is_flagged: bool) -> None:
        """Examine a packet: one picture, with a time stamp if it has one."""
        self._count += 1
        self._inside.add(self._count)
        recovery = None
        periods = self._periods(pts if dts is None else dts)
        if self._has_frame_numbers:
            whole, recovery = self._numbers.follows(data, periods)
        else:
            whole = not (self._may_lose and periods > 1.6)
        if not whole:  # what was lost came before: this packet may be a key frame
            self._broken_at, self._recovered_from = self._count - 1, None
        if is_flagged:
            self.broke()
        if pts is not None:
            self._packets[pts] = (self._count, recovery)
            while len(self._packets) > KEPT_PACKETS:
                del self._packets[next(iter(self._packets))]

    def broke(self) -> None:
        """Note that the last packet was damaged."""
        self._break(self._count)
        self._inside.discard(self._count)
        self.left_out += 1

    def released(self, picture: P, pts: int | None, *, is_key: bool, is_flagged: bool) -> list[P]:
        """Take a picture, and return those that rest on whole ones only, for certain by now."""
        number, recovery = self._packets.get(-1 if pts is None else pts, (self._count, None))
        self._inside = {at for at in self._inside if at != number and at > number - MOST_INSIDE}
        if is_flagged:
            self._break(number)
        if self._rests_on_whole(number, recovery, is_key=is_key):
            self._waiting.append((number, picture))
        else:
            self.left_out += 1
        return list(self._certain())

    def _break(self, number: int) -> None:
        """Note that a packet was damaged: what was decoded after it is not passed on."""
        self._broken_at = max(number, self._broken_at or 0)
        self._recovered_from = None
        kept = [(at, picture) for at, picture in self._waiting if at < number]
        self.left_out += len(self._waiting) - len(kept)
        self._waiting = kept

    def _certain(self) -> Iterator[P]:
        while self._waiting and not any(at < self._waiting[0][0] for at in self._inside):
            yield self._waiting.pop(0)[1]

    def _rests_on_whole(self, number: int, recovery: int | None, *, is_key: bool) -> bool:
        if self._broken_at is None:
            return True
        is_entry = is_key or recovery is not None
        if is_entry and number > self._broken_at and self._recovered_from is None:
            self._recovered_from = number + (recovery or 0)
        if self._recovered_from is None or number < self._recovered_from:
            return False
        self._broken_at = self._recovered_from = None
        return True

    def _periods(self, time: int | None) -> float:
        """Return how many usual steps of the time stamps this is after the last; 1 if unknown."""
        last, self._last_time = self._last_time, time
        if time is None or last is None or time <= last:
            return 1.0
        usual = median(self._steps) if len(self._steps) >= LEAST_STEPS else time - last
        self._steps.append(time - last)
        return (time - last) / usual


class FrameNumbers:
    """Follows ``frame_num`` of H.264 pictures (7.4.3): a reference picture adds one."""

    def __init__(self) -> None:
        self._bits = 0
        """Bits of a frame number; 0: no parameter set came yet."""
        self._may_gap = False
        self._last: int | None = None
        """Number of the last reference picture; None: not known."""

    def follows(self, data: bytes, periods: float) -> tuple[bool, int | None]:
        """Return whether a packet follows the one before, and how many pictures after it all is
        well again if it is a recovery point."""
        recovery = None
        try:
            for nal in split_nals(data):
                kind = nal_type(nal)
                if kind == NAL_SPS:
                    self._bits, self._may_gap = _numbering(_beginning(nal))
                elif kind == NAL_SEI:
                    recovery = _recovery_pictures(nal) if recovery is None else recovery
                elif kind in (NAL_P, NAL_IDR):
                    return self._slice_follows(nal, periods), recovery
        except BitstreamError:
            self._last = None
            return False, None
        return True, recovery

    def _slice_follows(self, nal: bytes, periods: float) -> bool:
        if not self._bits:
            return True
        r = BitReader(_beginning(nal))
        r.ue(), r.ue(), r.ue()  # first_mb_in_slice, slice_type, pic_parameter_set_id
        number, last = r.u(self._bits), self._last
        is_reference = bool(nal[0] >> 5 & 3)
        if is_reference:
            self._last = number
        if nal_type(nal) == NAL_IDR or last is None or self._may_gap:
            return True
        if periods > (1 << self._bits) - 0.5:
            return False
        return (number - last) % (1 << self._bits) in (0, 1)


def _beginning(nal: bytes) -> bytes:
    """Return the first bytes of a unit's payload without emulation prevention (7.3.1)."""
    return nal[1:MAX_PARSED_BYTES].replace(b"\x00\x00\x03", b"\x00\x00")


def _numbering(rbsp: bytes) -> tuple[int, bool]:
    """Return the bits of a frame number by a sequence parameter set, and whether numbers may be
    left out (7.3.2.1.1)."""
    r = BitReader(rbsp)
    profile = r.u(8)
    r.u(16)
    r.ue()
    if profile in HIGH_PROFILES:
        colours = r.ue()
        if colours == 3:
            r.u(1)
        r.ue(), r.ue(), r.u(1)
        if r.u(1):
            _skip_scaling_lists(r, 12 if colours == 3 else 8)
    bits = r.ue() + 4
    if bits > 16:
        raise BitstreamError(f"frame numbers of {bits} bits")
    order = r.ue()
    if order == 0:
        r.ue()
    elif order == 1:
        r.u(1), r.ue(), r.ue()
        for _ in range(min(r.ue(), 255)):
            r.ue()
    r.ue()
    return bits, bool(r.u(1))


def _skip_scaling_lists(r: BitReader, count: int) -> None:
    """Read over the lists of 7.3.2.1.1.1."""
    for number in range(count):
        last = following = 8
        for _ in range((16 if number < 6 else 64) if r.u(1) else 0):
            if following:
                code = r.ue()
                following = (last + (code + 1) // 2 * (1 if code % 2 else -1)) % 256
            last = following or last


def _recovery_pictures(nal: bytes) -> int | None:
    """Return ``recovery_frame_cnt`` of a recovery point (D.1.8); None if the unit has none."""
    data, at = _beginning(nal), 0
    while at + 2 < len(data):
        kind = size = 0
        while at < len(data) and data[at] == 255:
            kind, at = kind + 255, at + 1
        kind, at = kind + data[at], at + 1
        while at < len(data) and data[at] == 255:
            size, at = size + 255, at + 1
        if at >= len(data):
            break
        size, at = size + data[at], at + 1
        if kind == RECOVERY_POINT:
            return BitReader(data[at : at + size]).ue()
        at += size
    return None
