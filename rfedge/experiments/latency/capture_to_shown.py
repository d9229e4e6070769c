"""From capture to the picture shown: two processors and a link between them, on a virtual clock.

Either end works at one frame at a time, for as long as that very frame took when it was measured,
and frames wait for it: a mean would hide what a slow frame does to those behind it. As the product
does, a vehicle has at most ``WINDOW`` frames under way, from the beginning of its coding until it
hears that the server shows it, and begins with the newest that was captured; older ones are
dropped. An answer takes the link's delay and none of its rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.link import DirectionPlan

__all__ = ["WINDOW", "FrameWork", "Shown", "quantile_of_all_ms", "show"]

WINDOW = 2
"""Frames of one camera under way (``mec_server.config.SessionLimits``)."""
CAPTURED = 1e-9
"""Of a frame's period: the frame of a moment is there at that moment, whatever rounding says."""
F64 = NDArray[np.float64]


@dataclass(frozen=True)
class FrameWork:
    """What one frame takes: of the link, and of a processor at both ends."""

    size_bytes: int
    sender_ms: float
    receiver_ms: float


@dataclass(frozen=True)
class Shown:
    """``latency_ms`` [N], from capture to shown, of the frames that were sent; ``sender_busy`` and
    ``receiver_busy``: for which share of the time either end computed."""

    latency_ms: F64
    dropped: int
    sender_busy: float
    receiver_busy: float

    @property
    def frames(self) -> int:
        """How many frames were captured."""
        return len(self.latency_ms) + self.dropped

    def share_within(self, budget_ms: float) -> float:
        """Return the share of all captured frames that were shown within ``budget_ms``."""
        return float((self.latency_ms <= budget_ms).sum() / self.frames)

    def quantile_ms(self, share: float) -> float:
        """Return the latency that ``share`` of the captured frames stay within, or infinity."""
        return quantile_of_all_ms(self.latency_ms, self.dropped, share)


def quantile_of_all_ms(latency_ms: F64, dropped: int, share: float) -> float:
    """Return the latency that ``share`` of the captured frames stay within; dropped ones never
    come, so it may be infinite."""
    late = np.full(dropped, np.inf)
    return float(np.quantile(np.concatenate([latency_ms, late]), share, method="higher"))


def show(frames: Sequence[FrameWork], rate_hz: float, link: DirectionPlan) -> Shown:
    """Capture a frame every ``1 / rate_hz`` seconds, send what can be sent over ``link``, show it.

    ``frames`` must not be empty.
    """
    machine = link.unbounded().link()
    answer_s = link.profile.delay_s
    heard_s = [0.0] * WINDOW
    """When the vehicle heard of each frame it sent, in the order of sending."""
    sender_free_s = receiver_free_s = 0.0
    latency_ms: list[float] = []
    sent: list[FrameWork] = []
    next_frame = 0
    while next_frame < len(frames):
        begin_s = max(next_frame / rate_hz, sender_free_s, heard_s[-WINDOW])
        newest = min(len(frames) - 1, int(begin_s * rate_hz + CAPTURED))
        work = frames[newest]
        sender_free_s = begin_s + work.sender_ms / 1e3
        machine.pop_due(sender_free_s)
        arrived_s = machine.push(newest, work.size_bytes, sender_free_s).due_s
        receiver_free_s = max(arrived_s, receiver_free_s) + work.receiver_ms / 1e3
        heard_s.append(receiver_free_s + answer_s)
        latency_ms.append(1e3 * (receiver_free_s - newest / rate_hz))
        sent.append(work)
        next_frame = newest + 1
    lasted_ms = 1e3 * max(receiver_free_s, len(frames) / rate_hz)
    return Shown(
        np.array(latency_ms),
        len(frames) - len(sent),
        sum(work.sender_ms for work in sent) / lasted_ms,
        sum(work.receiver_ms for work in sent) / lasted_ms,
    )
