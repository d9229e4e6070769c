"""The delta packet: one slice with everything a receiver needs to verify it or refuse it."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

from rfcore.codec.block_means import BLOCK_MEANS_BYTES
from rfcore.codec.photometric import MOST_LIGHT_BYTES, Photometric, check_photometric
from rfcore.codec.references import RENDER_ONLY, References, check_references, is_temporal
from rfcore.errors import InvalidInput, PacketRejected, RejectReason

DIGEST_BYTES = 16

BASE_DIGEST_BYTES = 4
"""Four bytes tell a few kept frames apart. If two digests begin alike, the check of the
reconstruction's digest fails; no wrong picture is shown."""

_UINT32, _UINT64 = 1 << 32, 1 << 64
_DIGEST, _BLOCK_MEANS, _NOTHING = (DIGEST_BYTES,), (0, BLOCK_MEANS_BYTES), (0,)
_BASE = range(BASE_DIGEST_BYTES, DIGEST_BYTES + 1)


@dataclass(frozen=True)
class DeltaPacket:
    """One coded frame. Raises ``InvalidInput`` for digests of a wrong length and for numbers
    outside uint64 (``epoch``, ``sequence``) or uint32 (``crc32``); nothing else is checked here.

    ``payload`` is one NAL unit without start code; if it is empty, the frame equals its only
    reference. ``render_digest`` and ``render_block_means`` describe the sender's render at the
    frame's pose, whatever the frame is predicted from, so that the receiver can tell whether both
    ends have the same pose and field.
    ``render_block_means`` is empty between exact renderers, where no difference is tolerated.
    ``reconstruction_digest`` is of the picture the receiver must get (``I420.digest``).
    ``base_digest`` names the earlier frame that ``references`` need by the first bytes of its
    reconstruction digest (we write 4, up to 16 are read); it is empty when they need none.
    ``photometric`` changes the render before it is used. If ``relit``, the render is mapped to
    ``light`` (``rfcore.codec.photometric``) or, where that is empty, to the light of the frame that
    ``base_digest`` names (``rfcore.native.warp.relight_i420``).
    ``crc32`` covers all other fields (``expected_crc32``): a damaged sequence number would
    otherwise make every later packet look stale.
    """

    epoch: int
    sequence: int
    render_digest: bytes
    render_block_means: bytes
    reconstruction_digest: bytes
    payload: bytes
    crc32: int
    references: References = RENDER_ONLY
    base_digest: bytes = b""
    photometric: Photometric = ()
    relit: bool = False
    light: bytes = b""

    def __post_init__(self) -> None:
        _require_number("epoch", self.epoch, _UINT64)
        _require_number("sequence", self.sequence, _UINT64)
        _require_number("crc32", self.crc32, _UINT32)
        check_references(self.references)
        if self.photometric:
            check_photometric(self.photometric)
            if self.relit:
                raise InvalidInput("packet.relit", "photometric already changes the render")
        if self.light:
            if not self.relit:
                raise InvalidInput("packet.light", "of a frame that is not relit")
            _require_length("light", self.light, range(2, MOST_LIGHT_BYTES + 1))
        base_lengths = _BASE if self.needs_base else _NOTHING
        _require_length("render_digest", self.render_digest, _DIGEST)
        _require_length("render_block_means", self.render_block_means, _BLOCK_MEANS)
        _require_length("reconstruction_digest", self.reconstruction_digest, _DIGEST)
        _require_length("base_digest", self.base_digest, base_lengths)

    @property
    def needs_base(self) -> bool:
        """True if an earlier frame is needed, which ``base_digest`` names."""
        return self.learns_light or is_temporal(self.references)

    @property
    def learns_light(self) -> bool:
        """True if the render's light is learnt from that earlier frame."""
        return self.relit and not self.light

    def expected_crc32(self) -> int:
        """Return zlib.crc32 of the packet's other fields.

        They are epoch and sequence (8 bytes each, big-endian), the digests in the order of the
        fields, the payload, a byte for each reference, the base digest, the photometric numbers (2
        bytes each), and if the frame is relit a byte 1 and the light.
        """
        head = (
            self.epoch.to_bytes(8, "big"),
            self.sequence.to_bytes(8, "big"),
            self.render_digest,
            self.render_block_means,
            self.reconstruction_digest,
        )
        tail = (
            bytes(self.references),
            self.base_digest,
            *(number.to_bytes(2, "big", signed=True) for number in self.photometric),
            b"\x01" if self.relit else b"",
            self.light,
        )
        crc = zlib.crc32(self.payload, zlib.crc32(b"".join(head)))
        return zlib.crc32(b"".join(tail), crc)

    def sealed(self) -> DeltaPacket:
        """Return the packet with the CRC its other fields call for."""
        return replace(self, crc32=self.expected_crc32())


@dataclass(frozen=True)
class CheckedPacket:
    """A packet that arrived intact and in order, as ``check_packet`` returns it.

    Decoders take only this type, so every packet is checked once, before anything is rendered for
    it. ``lost``: how many packets are missing right before it.
    """

    packet: DeltaPacket
    lost: int


def check_packet(packet: DeltaPacket, epoch: int, next_sequence: int) -> CheckedPacket:
    """Check a packet where ``next_sequence`` of ``epoch`` is the lowest that may come.

    A higher epoch is a new start, whose sequences count from 0. Raises ``PacketRejected`` with
    STALE_EPOCH or STALE_SEQUENCE for a packet that comes too late, and with CRC_MISMATCH if the
    contents are not those that were sealed. It takes microseconds.
    """
    if packet.epoch < epoch:
        raise PacketRejected(
            RejectReason.STALE_EPOCH, f"epoch {packet.epoch} where {epoch} is current"
        )
    lowest = next_sequence if packet.epoch == epoch else 0
    if packet.sequence < lowest:
        raise PacketRejected(
            RejectReason.STALE_SEQUENCE,
            f"sequence {packet.sequence} where {lowest} or later is expected",
        )
    expected = packet.expected_crc32()
    if packet.crc32 != expected:
        raise PacketRejected(
            RejectReason.CRC_MISMATCH, f"CRC {packet.crc32:08x} of contents with {expected:08x}"
        )
    return CheckedPacket(packet, packet.sequence - lowest)


def _require_number(name: str, value: int, limit: int) -> None:
    if not 0 <= value < limit:
        raise InvalidInput(f"packet.{name}", f"{value} is outside 0..{limit - 1}")


def _require_length(name: str, value: bytes, lengths: Sequence[int]) -> None:
    if len(value) not in lengths:
        expected = " or ".join(str(length) for length in sorted({lengths[0], lengths[-1]}))
        raise InvalidInput(f"packet.{name}", f"{len(value)} bytes where {expected} are expected")
