"""The delta packet: one slice with everything a receiver needs to verify it or refuse it.

A packet carries the block means of its render, enough to tell rounding from a wrong pose. The luma
plane is cut into 8 x 8 blocks; their means, rounded half up, are 64 bytes in reading order. Block i
of a side of n samples covers samples floor(i n / 8) up to floor((i + 1) n / 8), but at least one.

Tolerance: if no sample differs by more than one level, no mean differs by more than one level,
and neither do the rounded means (x -> floor(x + 1/2) maps numbers at most 1 apart to integers at
most 1 apart). So two renderers that disagree in the last bit always pass at a tolerance of 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.codec.photometric import MOST_LIGHT_BYTES, Photometric, check_photometric
from rfcore.codec.references import RENDER_ONLY, References, check_references, is_temporal
from rfcore.errors import InvalidInput, PacketRejected, RejectReason
from rfcore.image import I420

_BLOCKS_PER_SIDE = 8
BLOCK_MEANS_BYTES = _BLOCKS_PER_SIDE * _BLOCKS_PER_SIDE
BLOCK_MEANS_TOLERANCE = 1
"""Levels by which a block's mean may differ between renderers that agree up to rounding."""


def block_mean_digest(picture: I420) -> bytes:
    """Return the 64 rounded luma means of ``picture``."""
    height, width = picture.y.shape
    rows, row_counts = _blocks(height)
    columns, column_counts = _blocks(width)
    sums = np.add.reduceat(picture.y, columns, axis=1, dtype=np.int64)
    sums = np.add.reduceat(sums, rows, axis=0)
    counts = row_counts[:, None] * column_counts[None, :]
    means: NDArray[np.int64] = (2 * sums + counts) // (2 * counts)
    return means.astype(np.uint8).tobytes()


def block_mean_difference(a: bytes, b: bytes) -> int:
    """Return the largest difference of the block means of two pictures, in levels."""
    means = (np.frombuffer(digest, np.uint8).astype(np.int16) for digest in (a, b))
    return int(np.abs(np.subtract(*means)).max())


def median_block_mean_difference(a: I420, b: I420) -> float:
    """Return the median of the block means' differences, in levels: how much two lights differ.

    An object that covers less than half of the blocks, as a vehicle does, does not change it.
    """
    means = (np.frombuffer(block_mean_digest(p), np.uint8).astype(np.int16) for p in (a, b))
    return float(np.median(np.abs(np.subtract(*means))))


def _blocks(side: int) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Return the first sample and the number of samples of each block."""
    edges = np.arange(_BLOCKS_PER_SIDE + 1) * side // _BLOCKS_PER_SIDE
    return edges[:-1].astype(np.intp), np.maximum(np.diff(edges), 1)


RENDER_DIGEST_BYTES = 2
"""Enough to tell a wrong render from a slice that decodes otherwise, where the picture is wrong."""

RECONSTRUCTION_DIGEST_BYTES = 6
"""Bytes that prove a picture and name it (``rfcore.wire.head`` has the arithmetic)."""

_UINT64 = 1 << 64
_RENDER, _RECONSTRUCTION = (RENDER_DIGEST_BYTES,), (RECONSTRUCTION_DIGEST_BYTES,)
_BLOCK_MEANS, _NOTHING = (0, BLOCK_MEANS_BYTES), (0,)


@dataclass(frozen=True)
class DeltaPacket:
    """One coded frame. Raises ``InvalidInput`` for digests of a wrong length and for numbers
    outside uint64 (``epoch``, ``sequence``); nothing else is checked here.

    ``payload`` is one NAL unit without start code; if it is empty, the frame equals its only
    reference. ``render_digest`` and ``render_block_means`` describe the sender's render at the
    frame's pose, whatever the frame is predicted from, so that the receiver can tell whether both
    ends have the same pose and field.
    ``render_block_means`` is empty between exact renderers, where no difference is tolerated.
    ``reconstruction_digest`` is of the picture the receiver must get; both digests are the first
    bytes of ``I420.digest``. ``base_digest`` names the earlier frame that ``references`` need by
    its reconstruction digest; it is empty when they need none.
    ``photometric`` changes the render before it is used. If ``relit``, the render is mapped to
    ``light`` (``rfcore.codec.photometric``) or, where that is empty, to the light of the frame that
    ``base_digest`` names (``rfcore.native.warp.relight_i420``).
    """

    epoch: int
    sequence: int
    render_digest: bytes
    render_block_means: bytes
    reconstruction_digest: bytes
    payload: bytes
    references: References = RENDER_ONLY
    base_digest: bytes = b""
    photometric: Photometric = ()
    relit: bool = False
    light: bytes = b""

    def __post_init__(self) -> None:
        _require_number("epoch", self.epoch, _UINT64)
        _require_number("sequence", self.sequence, _UINT64)
        check_references(self.references)
        if self.photometric:
            check_photometric(self.photometric)
            if self.relit:
                raise InvalidInput("packet.relit", "photometric already changes the render")
        if self.light:
            if not self.relit:
                raise InvalidInput("packet.light", "of a frame that is not relit")
            _require_length("light", self.light, range(2, MOST_LIGHT_BYTES + 1))
        base_lengths = _RECONSTRUCTION if self.needs_base else _NOTHING
        _require_length("render_digest", self.render_digest, _RENDER)
        _require_length("render_block_means", self.render_block_means, _BLOCK_MEANS)
        _require_length("reconstruction_digest", self.reconstruction_digest, _RECONSTRUCTION)
        _require_length("base_digest", self.base_digest, base_lengths)

    @property
    def needs_base(self) -> bool:
        """True if an earlier frame is needed, which ``base_digest`` names."""
        return self.learns_light or is_temporal(self.references)

    @property
    def learns_light(self) -> bool:
        """True if the render's light is learnt from that earlier frame."""
        return self.relit and not self.light


@dataclass(frozen=True)
class CheckedPacket:
    """A packet that arrived in order, as ``check_packet`` returns it.

    Decoders take only this type, so every packet is checked once, before anything is rendered for
    it. ``lost``: how many packets are missing right before it.
    """

    packet: DeltaPacket
    lost: int


def check_packet(packet: DeltaPacket, epoch: int, next_sequence: int) -> CheckedPacket:
    """Check a packet where ``next_sequence`` of ``epoch`` is the lowest that may come.

    Raises ``PacketRejected`` as ``check_order``.
    """
    lost = check_order(packet.epoch, packet.sequence, epoch, next_sequence)
    return CheckedPacket(packet, lost)


def check_order(epoch: int, sequence: int, current: int, next_sequence: int) -> int:
    """Return how many packets are missing right before ``sequence`` of ``epoch``, where
    ``next_sequence`` of the epoch ``current`` is the lowest that may come.

    A higher epoch is a new start, whose sequences count from 0. Raises ``PacketRejected`` with
    STALE_EPOCH or STALE_SEQUENCE for a packet that comes too late.
    """
    if epoch < current:
        raise PacketRejected(RejectReason.STALE_EPOCH, f"epoch {epoch} where {current} is current")
    lowest = next_sequence if epoch == current else 0
    if sequence < lowest:
        raise PacketRejected(
            RejectReason.STALE_SEQUENCE, f"sequence {sequence} where {lowest} or later is expected"
        )
    return sequence - lowest


def _require_number(name: str, value: int, limit: int) -> None:
    if not 0 <= value < limit:
        raise InvalidInput(f"packet.{name}", f"{value} is outside 0..{limit - 1}")


def _require_length(name: str, value: bytes, lengths: Sequence[int]) -> None:
    if len(value) not in lengths:
        expected = " or ".join(str(length) for length in sorted({lengths[0], lengths[-1]}))
        raise InvalidInput(f"packet.{name}", f"{len(value)} bytes where {expected} are expected")
