"""How much one vehicle may ask of the server, whatever number of streams it opens.

Sans-IO: ``now`` is an argument. Who a vehicle is comes from its certificate; without one it is who
it says, and the quotas then guard against mistakes, not against lies.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum

from mec_server.config import VehicleQuota
from rfcore.errors import LimitExceeded

__all__ = ["BARRED_S", "MAX_LOST_DECODERS", "Allowance", "Limit", "Quotas", "TokenBucket"]

MAX_LOST_DECODERS = 3
BARRED_S = 60.0
"""Whose packets cost so many decoder processes within this time is not let in for as long."""


class Limit(StrEnum):
    """What somebody had too much of; label of ``rfedge_server_limited_total``."""

    SERVER_STREAMS = "server_streams"
    CAPACITY = "capacity"
    VEHICLE_STREAMS = "vehicle_streams"
    FRAME_RATE = "frame_rate"
    BYTE_RATE = "byte_rate"
    LOST_DECODERS = "lost_decoders"
    UNUSABLE_FRAMES = "unusable_frames"


class TokenBucket:
    """Lets ``rate`` a second through, and one second's worth at once."""

    def __init__(self, rate: float, now: float) -> None:
        self._rate = rate
        self._left = rate
        self._filled_s = now

    def take(self, amount: float, now: float) -> bool:
        """Tell whether anything is left, and if so take ``amount``, be it more than that."""
        elapsed_s = max(0.0, now - self._filled_s)
        self._left = min(self._rate, self._left + elapsed_s * self._rate)
        self._filled_s = now
        if self._left <= 0:
            return False
        self._left -= amount
        return True


@dataclass
class Account:
    """What one vehicle has used."""

    frames: TokenBucket
    bytes: TokenBucket
    streams: int = 0
    lost_decoders_s: deque[float] = field(default_factory=lambda: deque(maxlen=MAX_LOST_DECODERS))

    def is_barred(self, now: float) -> bool:
        """Whether its packets have cost too many decoders of late."""
        lost = self.lost_decoders_s
        return len(lost) == MAX_LOST_DECODERS and now - lost[0] < BARRED_S


class Quotas:
    """The accounts of the vehicles that are here, or were barred a moment ago."""

    def __init__(self, quota: VehicleQuota) -> None:
        self._quota = quota
        self._accounts: dict[str, Account] = {}

    def enter(self, vehicle: str, now: float) -> Allowance:
        """Return what a new stream of ``vehicle`` may do; raise ``LimitExceeded``."""
        self._forget(now)
        quota = self._quota
        account = self._accounts.get(vehicle)
        if account is None:
            frames = TokenBucket(quota.frames_per_s, now)
            account = Account(frames, TokenBucket(quota.bytes_per_s, now))
        if account.is_barred(now):
            raise _barred()
        if account.streams >= quota.streams:
            raise LimitExceeded(
                Limit.VEHICLE_STREAMS,
                f"this vehicle has {account.streams} streams open, {quota.streams} may be; "
                "close one, or wait until those of lost connections are let go",
            )
        account.streams += 1
        self._accounts[vehicle] = account
        return Allowance(quota, account)

    def _forget(self, now: float) -> None:
        """Drop who is gone, so that names cost no memory."""
        gone = [
            name
            for name, account in self._accounts.items()
            if account.streams == 0 and not account.is_barred(now)
        ]
        for name in gone:
            del self._accounts[name]


class Allowance:
    """What one stream may do; its vehicle's other streams draw on the same account."""

    def __init__(self, quota: VehicleQuota, account: Account) -> None:
        self._quota = quota
        self._account = account

    def spend(self, message_bytes: int, now: float) -> None:
        """Take note of a message; raise ``LimitExceeded`` if it is one too many."""
        if not self._account.frames.take(1, now):
            raise LimitExceeded(
                Limit.FRAME_RATE, f"more than {self._quota.frames_per_s:g} frames a second"
            )
        if not self._account.bytes.take(message_bytes, now):
            raise LimitExceeded(
                Limit.BYTE_RATE, f"more than {self._quota.bytes_per_s:g} bytes a second"
            )

    def lost_decoder(self, now: float) -> None:
        """Take note that a packet cost a decoder; raise ``LimitExceeded`` if it was the last."""
        self._account.lost_decoders_s.append(now)
        if self._account.is_barred(now):
            raise _barred()

    def leave(self) -> None:
        """The stream is over."""
        self._account.streams -= 1


def _barred() -> LimitExceeded:
    return LimitExceeded(
        Limit.LOST_DECODERS,
        f"packets of this vehicle cost {MAX_LOST_DECODERS} decoders within {BARRED_S:g} s; "
        f"it is let in again {BARRED_S:g} s after the first",
    )
