"""How many bytes the next frame may have, so that its answer comes within a delay. No clock.

The delay runs from capture to Ack, as ``rfedge_agent_capture_to_ack_seconds`` measures it: waiting,
rendering, coding, the uplink, the server's work and the downlink. Quality falls first: a frame gets
the bytes that the path's recent behaviour leaves room for (``cav_agent.path_estimator``), and no
more than it can carry at the rate of capture. When not even the smallest frame has room, the next
picture waits for an answer; a newer one may take its place, so pictures are dropped before they are
coded.
"""

from __future__ import annotations

from dataclasses import dataclass

from cav_agent.path_estimator import PathEstimator
from rfcore.errors import InvalidInput
from rfcore.wire.messages import FrameAddress

__all__ = ["ByteBudget", "QualitySteps", "RateControl"]

SHARE = 0.75
"""Share of the delay that is aimed at; the rest is a margin for frames, path and machine."""

SUSTAINED = 0.85
"""Share of the path's rate that frames may use steadily; the rest drains queues."""

LEAST_BYTES = 240
"""The smallest frame worth coding; at the highest CRF a frame of a street has 100 to 300."""

MOST_BYTES = 1e9
"""Stands for an unlimited number of bytes."""

LIMIT = 1.5
"""A slice of more than this many times its target is coded again."""

SHRINK, GROW = 0.7, 0.004
"""How the share of the room that is used changes: times 0.7 when a frame was late (unless it was
coded before the last cut), plus 0.004 for each in time. They balance at 1 late frame in 100: 0.3 of
any share up to 1 against 99 times 0.004."""
LEAST_SHARE = 0.1

MEMORY = 0.75
"""Weight of what was known in the running means."""

OVERHEAD_BYTES = 150
"""Pose, digests, gRPC and HTTP/2 framing around a slice: assumed until one was sent."""

STEP_CRF = 4.0
"""A change of quality worth a line in the log: 4 of CRF change the bits by 60 %."""


@dataclass(frozen=True)
class ByteBudget:
    """The bytes a slice is to have: ``target_bytes``; above ``limit_bytes`` it is coded again.

    ``rate_bps``: what answers have proven the path to carry; None before the first one.
    """

    target_bytes: float
    limit_bytes: int
    rate_bps: float | None = None


class RateControl:
    """Keeps one camera's frames within ``max_delay_s`` from capture to Ack."""

    def __init__(self, max_delay_s: float) -> None:
        if not 0.01 <= max_delay_s <= 60:
            raise InvalidInput("max_delay", f"{1e3 * max_delay_s:g} ms is outside 10..60000 ms")
        self._max_delay_s = max_delay_s
        self._path = PathEstimator()
        self._share = 1.0
        self._cut_s = float("-inf")
        self._work_s = 0.0
        self._overhead_bytes = float(OVERHEAD_BYTES)
        self._interval_s: float | None = None
        self._captured_s: float | None = None

    @property
    def rate_bps(self) -> float | None:
        """What answers have proven the path to carry; None before the first one."""
        return self._path.rate_bps

    def captured(self, now: float) -> None:
        """A picture was captured."""
        if self._captured_s is not None:
            interval_s = now - self._captured_s
            self._interval_s = _mean(self._interval_s, interval_s)
        self._captured_s = now

    def is_late(self, captured_s: float, now: float) -> bool:
        """Whether a picture has waited so long that not even an empty frame would be in time."""
        least_s = self._work_s + self._path.min_rtt_ns / 1e9
        left_s = self._max_delay_s - least_s
        return now - captured_s > (left_s if left_s > 0 else self._max_delay_s)

    def budget(self, captured_s: float, now: float) -> ByteBudget | None:
        """Return the bytes for the picture of ``captured_s`` if coding begins ``now``.

        None while it should wait for an answer.
        """
        if self._path.bytes_in_flight and self._room_bytes(captured_s, now, 1.0) < LEAST_BYTES:
            return None
        room = self._share * self._room_bytes(captured_s, now, SHARE)
        if self._interval_s:
            carried = self._path.sustained_bytes(1e9 * self._interval_s, _ns(now))
            room = min(room, SUSTAINED * carried - self._overhead_bytes)
        target = min(max(room, LEAST_BYTES), MOST_BYTES)
        return ByteBudget(target, int(LIMIT * target), self._path.rate_bps)

    def _room_bytes(self, captured_s: float, now: float, share: float) -> float:
        """Return how large a slice may be to be answered within ``share`` of the delay."""
        due_s = captured_s + share * self._max_delay_s
        room = self._path.room_bytes(_ns(now + self._work_s), _ns(due_s), _ns(now))
        return room - self._overhead_bytes

    def coded(self, sender_s: float, payload_bytes: int, packet_bytes: int) -> None:
        """A frame took the sender ``sender_s`` from the picture to the packet."""
        self._work_s = _mean(self._work_s or None, sender_s)
        self._overhead_bytes = _mean(self._overhead_bytes, packet_bytes - payload_bytes)

    def sent(self, address: FrameAddress, packet_bytes: int, now: float) -> None:
        """A frame was sent."""
        self._path.sent(address, packet_bytes, _ns(now))

    def answered(self, address: FrameAddress, latency_s: float, now: float) -> None:
        """A frame was answered ``latency_s`` after its capture, by Ack or Nack."""
        self._path.answered(address, _ns(now))
        if latency_s <= self._max_delay_s:
            self._share = min(1.0, self._share + GROW)
        elif now - latency_s >= self._cut_s:
            self._share = max(LEAST_SHARE, SHRINK * self._share)
            self._cut_s = now

    def lost(self, address: FrameAddress) -> None:
        """No answer to a frame will come."""
        self._path.lost(address)


class QualitySteps:
    """Detects changes of CRF that are worth a line in the log."""

    def __init__(self) -> None:
        self._reported: float | None = None

    def step(self, crf: float) -> tuple[float, float] | None:
        """Return (before, after) when ``crf`` is ``STEP_CRF`` from the one reported last."""
        before = self._reported
        if before is not None and abs(crf - before) < STEP_CRF:
            return None
        self._reported = crf
        return None if before is None else (before, crf)


def _mean(known: float | None, found: float) -> float:
    return found if known is None else MEMORY * known + (1 - MEMORY) * found


def _ns(seconds: float) -> int:
    return round(1e9 * seconds)
