"""Which streams send which cameras, so that two agents never send the same one.

Sans-IO: ``now`` is an argument.
"""

from __future__ import annotations

from typing import Protocol

from mec_server.ledger.budgets import Limit
from rfcore.errors import LimitExceeded
from rfcore.wire.messages import Hello

__all__ = ["CAMERA_SILENT_S", "ActiveCameras", "CameraSender"]

CAMERA_SILENT_S = 3.0
"""A stream that sent nothing for so long may be taken over by another agent: its own keepalive
(2 s and 1 s) has noticed by then that the connection is dead. Cameras slower than 1 Hz get two of
their periods more."""


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
