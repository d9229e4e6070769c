"""How much one vehicle may ask of the server over all its streams, and who may send a camera.

Sans-IO: ``now`` is an argument. A vehicle's name comes from its certificate; without one it is the
name in its Hello, and the quotas then guard against mistakes, not against lies.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

from mec_server.config import VehicleQuota
from rfcore.errors import LimitExceeded
from rfcore.wire.messages import Hello

__all__ = [
    "BARRED_S",
    "CAMERA_SILENT_S",
    "MAX_LOST_DECODERS",
    "ActiveCameras",
    "Allowance",
    "CameraSender",
    "Limit",
    "Quotas",
    "TokenBucket",
]

MAX_LOST_DECODERS = 3
BARRED_S = 60.0
"""A vehicle whose packets cost so many decoder processes within this time is kept out for as long.
"""

CAMERA_SILENT_S = 3.0
"""A stream that sent nothing for so long may be taken over by another agent: its own keepalive
(2 s and 1 s) has noticed by then that the connection is dead. Cameras slower than 1 Hz get two of
their periods more."""


class Limit(StrEnum):
    """Which limit was exceeded; label of ``rfedge_server_limited_total``."""

    SERVER_STREAMS = "server_streams"
    CAPACITY = "capacity"
    VEHICLE_STREAMS = "vehicle_streams"
    CAMERA_TAKEN = "camera_taken"
    FRAME_RATE = "frame_rate"
    BYTE_RATE = "byte_rate"
    LOST_DECODERS = "lost_decoders"
    UNUSABLE_FRAMES = "unusable_frames"


class TokenBucket:
    """Lets ``rate`` per second through, in bursts of up to one second's worth."""

    def __init__(self, rate: float, now: float) -> None:
        self._rate = rate
        self._left = rate
        self._filled_s = now

    def take(self, amount: float, now: float) -> bool:
        """Return whether anything is left; if so take ``amount``, even if that is more."""
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
        """Return whether its packets cost too many decoders lately."""
        lost = self.lost_decoders_s
        return len(lost) == MAX_LOST_DECODERS and now - lost[0] < BARRED_S


class Quotas:
    """The accounts of the vehicles that have streams, or are barred."""

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
        """Drop the accounts of vehicles without streams, so that names cost no memory."""
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
        """Count a message; raise ``LimitExceeded`` if it is one too many."""
        if not self._account.frames.take(1, now):
            raise LimitExceeded(
                Limit.FRAME_RATE, f"more than {self._quota.frames_per_s:g} frames a second"
            )
        if not self._account.bytes.take(message_bytes, now):
            raise LimitExceeded(
                Limit.BYTE_RATE, f"more than {self._quota.bytes_per_s:g} bytes a second"
            )

    def lost_decoder(self, now: float) -> None:
        """Count a decoder that a packet cost; raise ``LimitExceeded`` if that bars the vehicle."""
        self._account.lost_decoders_s.append(now)
        if self._account.is_barred(now):
            raise _barred()

    def leave(self) -> None:
        """Give the stream back to the account."""
        self._account.streams -= 1


class CameraSender(Protocol):
    """A stream, as far as the question of who sends a camera goes."""

    @property
    def agent(self) -> str:
        """Return which agent process opened the stream; an agent may open several."""

    def silent_s(self, now: float) -> float:
        """Return for how long it has sent nothing; 0 while it waits for an answer."""

    def displace(self, error: LimitExceeded) -> None:
        """End it: another agent sends its cameras from now on."""


class ActiveCameras:
    """Which streams send which cameras, so that two agents never send the same one.

    Streams of one agent may share a camera: during a handover between tiles, or when its stream
    broke and is opened again. Another agent is refused while a stream of the first one is alive;
    one that has fallen silent is ended, and the other agent takes its cameras over.
    """

    def __init__(self) -> None:
        self._senders: dict[tuple[str, str], dict[CameraSender, float]] = {}

    def enter(self, hello: Hello, sender: CameraSender, now: float) -> None:
        """Note that ``sender`` sends the cameras of ``hello``; raise ``LimitExceeded``."""
        cameras = {(hello.vehicle_id, c.camera_id): c.rate_hz for c in hello.cameras}
        displaced: dict[CameraSender, str] = {}
        for key in cameras:
            for other, silent_after_s in self._senders.get(key, {}).items():
                if other.agent == sender.agent:
                    continue
                if other.silent_s(now) < silent_after_s:
                    raise _taken(key, silent_after_s)
                displaced[other] = "/".join(key)
        for other, camera in displaced.items():
            self.leave(other)
            other.displace(_displaced(camera, other.silent_s(now)))
        for key, rate_hz in cameras.items():
            slower_s = 2.0 / rate_hz if 0 < rate_hz < 1 else 0.0
            self._senders.setdefault(key, {})[sender] = CAMERA_SILENT_S + slower_s

    def leave(self, sender: CameraSender) -> None:
        """Forget a stream; does nothing for one that was refused or displaced."""
        for key in [key for key, senders in self._senders.items() if sender in senders]:
            del self._senders[key][sender]
            if not self._senders[key]:
                del self._senders[key]


def _taken(key: tuple[str, str], silent_after_s: float) -> LimitExceeded:
    vehicle_id, camera_id = key
    return LimitExceeded(
        Limit.CAMERA_TAKEN,
        f"another agent sends camera {camera_id} of vehicle {vehicle_id}; stop it, or give this "
        f"one another --vehicle or --camera (an agent that sends nothing for {silent_after_s:g} s "
        "may be replaced)",
        silent_after_s,
    )


def _displaced(camera: str, silent_s: float) -> LimitExceeded:
    return LimitExceeded(
        Limit.CAMERA_TAKEN,
        f"nothing came for {silent_s:.1f} s, and another agent sends {camera} now",
        CAMERA_SILENT_S,
    )


def _barred() -> LimitExceeded:
    return LimitExceeded(
        Limit.LOST_DECODERS,
        f"packets of this vehicle cost {MAX_LOST_DECODERS} decoders within {BARRED_S:g} s; "
        f"it is let in again {BARRED_S:g} s after the first",
    )
