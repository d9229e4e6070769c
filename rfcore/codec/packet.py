"""The delta packet: one P slice with everything a receiver needs to trust or refuse it."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace

from rfcore.codec.coarse import COARSE_BYTES
from rfcore.errors import InvalidInput

__all__ = ["DIGEST_BYTES", "DeltaPacket"]

DIGEST_BYTES = 16
_UINT32, _UINT64 = 1 << 32, 1 << 64


@dataclass(frozen=True)
class DeltaPacket:
    """One coded frame. Raises ``InvalidInput`` for digests of a wrong length and for numbers
    outside uint64 (``epoch``, ``sequence``) or uint32 (``crc32``); nothing else is checked here.

    ``payload`` is one NAL unit without start code. ``reference_digest`` and
    ``reference_coarse`` are of the sender's render, ``reconstruction_digest`` is of what the
    receiver must get (``I420.digest``). ``crc32`` covers all other fields (``expected_crc32``): a
    damaged sequence number would otherwise make every later packet look stale.
    """

    epoch: int
    sequence: int
    reference_digest: bytes
    reference_coarse: bytes
    reconstruction_digest: bytes
    payload: bytes
    crc32: int

    def __post_init__(self) -> None:
        for name, limit in (("epoch", _UINT64), ("sequence", _UINT64), ("crc32", _UINT32)):
            value = getattr(self, name)
            if not 0 <= value < limit:
                raise InvalidInput(f"packet.{name}", f"{value} is outside 0..{limit - 1}")
        for name, length in (
            ("reference_digest", DIGEST_BYTES),
            ("reference_coarse", COARSE_BYTES),
            ("reconstruction_digest", DIGEST_BYTES),
        ):
            got = len(getattr(self, name))
            if got != length:
                raise InvalidInput(f"packet.{name}", f"{got} bytes where {length} are expected")

    def expected_crc32(self) -> int:
        """Return zlib.crc32 of epoch and sequence (8 bytes each, big-endian), the digests in the
        order of the fields, and the payload."""
        crc = zlib.crc32(self.epoch.to_bytes(8, "big") + self.sequence.to_bytes(8, "big"))
        for part in (
            self.reference_digest,
            self.reference_coarse,
            self.reconstruction_digest,
            self.payload,
        ):
            crc = zlib.crc32(part, crc)
        return crc

    def sealed(self) -> DeltaPacket:
        """Return the packet with the CRC its other fields call for."""
        return replace(self, crc32=self.expected_crc32())
