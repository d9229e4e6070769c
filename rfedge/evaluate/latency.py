"""How long a frame takes over a link, on a virtual clock: the paper's tau, and what users feel.

``tau`` is a message's own transmission time. The network latency adds waiting behind earlier
frames and the link's propagation; end to end adds what both ends compute. A clip is played again
and again (its first frame once), captured at its rate. As the product does, at most ``WINDOW``
frames are under way: a frame that finds more is dropped before it is coded, and counts as late.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.link import DirectionPlan, LinkProfile

__all__ = [
    "BUDGETS_MS",
    "FRAMES_FOR_REQUIREMENT",
    "REQUIREMENT",
    "Played",
    "needed_rate_bps",
    "play",
    "repeated",
]

WINDOW = 2
"""Frames of one camera under way (``mec_server.config.SessionLimits``)."""

BUDGETS_MS = (5.0, 10.0)
"""Network latencies a digital twin asks for (the paper: 5 to 10 ms)."""

REQUIREMENT = 0.99999
"""Share of frames that must be so quick (the paper)."""

FRAMES_FOR_REQUIREMENT = math.ceil(math.log(0.05) / math.log(REQUIREMENT))
"""Frames in time without a single late one before 99.999 % may be claimed with 95 % confidence."""

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Played:
    """A clip over a link. ``tau_ms`` and ``network_ms`` [N] are of the frames that were sent."""

    tau_ms: F64
    network_ms: F64
    dropped: int

    @property
    def frames(self) -> int:
        """How many frames were captured."""
        return len(self.network_ms) + self.dropped

    def share_within(self, budget_ms: float) -> float:
        """Return the share of all captured frames that came within ``budget_ms``."""
        return float((self.network_ms <= budget_ms).sum() / self.frames)

    def quantile_ms(self, share: float) -> float:
        """Return the latency that ``share`` of the captured frames stay within; dropped ones never
        come, so it may be infinite."""
        late = np.full(self.dropped, np.inf)
        return float(np.quantile(np.concatenate([self.network_ms, late]), share, method="higher"))


def repeated(frame_bytes: Sequence[int], count: int) -> list[int]:
    """Return ``count`` sizes: the clip without its first frame, which a stream sends once, again
    and again."""
    steady = list(frame_bytes)[1:]
    if not steady:
        raise InvalidInput("frames", "a clip needs at least two frames")
    return [steady[k % len(steady)] for k in range(count)]


def play(frame_bytes: Sequence[int], rate_hz: float, link: DirectionPlan) -> Played:
    """Send a frame of each size, one every ``1 / rate_hz`` seconds, over ``link``."""
    machine = link.unbounded().link()
    due: list[float] = []
    tau, network = [], []
    dropped = 0
    for index, size in enumerate(frame_bytes):
        now = index / rate_hz
        machine.pop_due(now)
        due = [at for at in due if at > now]
        if len(due) >= WINDOW:
            dropped += 1
            continue
        delivery = machine.push(index, size, now)
        due.append(delivery.due_s)
        tau.append(1e3 * (delivery.end_s - delivery.start_s))
        network.append(1e3 * (delivery.due_s - now))
    return Played(np.array(tau), np.array(network), dropped)


def needed_rate_bps(
    frame_bytes: Sequence[int], rate_hz: float, budget_ms: float, share: float = 0.99
) -> float:
    """Return the lowest constant rate, to 0.5 %, at which ``share`` of the frames come in time."""

    def in_time(rate_bps: float) -> bool:
        plan = DirectionPlan(LinkProfile(rate_bps))
        return play(frame_bytes, rate_hz, plan).quantile_ms(share) <= budget_ms

    return _lowest(in_time, 1e4, 1e10)


def _lowest(holds: Callable[[float], bool], low: float, high: float) -> float:
    """Return the lowest value for which ``holds``, which is monotonic, by halving in logarithms."""
    if not holds(high):
        raise InvalidInput("budget", f"not even {high:g} bit/s are enough")
    while high > 1.005 * low:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high
