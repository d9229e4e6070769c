"""Who is let in, and at how many pictures per second, so that those who are in keep their service.

Sans-IO: ``now`` is an argument. What there is to give is the workers' time; what a frame takes of
it is measured while this server works, for each vehicle, and for newcomers by the pixel. Others
that use the machine, or a field that is slow to render, make frames take longer and so less is
given. Vehicles get what they ask for in the order in which they came; the last one gets what is
left, and one for whom too little is left is asked to come again later. When frames become dearer or
cheaper, or somebody leaves, rates are dealt out anew, in the same order; nobody is sent away.
"""

from __future__ import annotations

from dataclasses import dataclass

from mec_server.config import AdmissionLimits
from mec_server.quotas import Limit
from rfcore.errors import LimitExceeded
from rfcore.wire.messages import Hello

__all__ = ["ASSUMED_HZ", "Admission"]

ASSUMED_HZ = 10.0
"""Of a vehicle that does not say how many pictures per second it would send."""

FIRST_S_PER_PIXEL = 1.5e-7
"""Before anything was measured: 35 ms for 640x360, as rendering a field of 200k Gaussians and
decoding took one core of 2.5 GHz."""

MEMORY = 1 / 32
"""Weight of a frame in the running means; at 10 Hz they follow within three seconds."""

OUTLIER = 4.0
"""A frame that took longer than so many usual ones counts as that many: once is an accident."""

REVIEW_S = 1.0
NOTICEABLE = 0.1
"""Rates are dealt out once a second, and a vehicle is told of changes by more than a tenth."""


@dataclass
class AdmittedStream:
    """A vehicle that is in. ``cost_s``: worker time for each of its frames."""

    pixels: int
    cameras: int
    asked_hz: float
    cost_s: float
    granted_hz: float
    says_rate: bool

    @property
    def promised(self) -> float:
        """Workers that its granted rate keeps busy."""
        return self.granted_hz * self.cameras * self.cost_s


class Admission:
    """Deals out ``workers`` seconds of work a second, less what ``limits`` keeps back."""

    def __init__(self, limits: AdmissionLimits, workers: int) -> None:
        self._limits = limits
        self._capacity = limits.load * workers
        self._guests: dict[str, AdmittedStream] = {}
        self._s_per_pixel = FIRST_S_PER_PIXEL
        self._reviewed_s = float("-inf")

    @property
    def promised_share(self) -> float:
        """What is promised, of what may be; above 1 when frames became dearer than they were."""
        if not self._capacity:
            return 0.0
        return sum(guest.promised for guest in self._guests.values()) / self._capacity

    @property
    def reduced(self) -> int:
        """How many vehicles have less than they asked for."""
        return sum(guest.granted_hz < guest.asked_hz for guest in self._guests.values())

    def enter(self, session_id: str, hello: Hello) -> float:
        """Return the rate for each camera of a newcomer, 0 for as many as it likes.

        Raises ``LimitExceeded`` with the time after which to come again.
        """
        guest = self._newcomer(hello)
        if not self._capacity:
            return 0.0
        free = self._capacity - sum(other.promised for other in self._guests.values())
        rate_hz = self._rate(guest, free)
        if rate_hz < self._lowest_hz(guest) and self._guests:
            raise self._full(guest, free)
        guest.granted_hz = max(rate_hz, self._lowest_hz(guest))
        self._guests[session_id] = guest
        return self._said(guest)

    def leave(self, session_id: str) -> None:
        """A stream is over; what it had is for others at the next review."""
        self._guests.pop(session_id, None)

    def worked(self, session_id: str, seconds: float) -> None:
        """Take note that a frame of this session took a worker so long."""
        guest = self._guests.get(session_id)
        if guest is None:
            return
        seconds = min(seconds, OUTLIER * guest.cost_s)
        guest.cost_s += MEMORY * (seconds - guest.cost_s)
        self._s_per_pixel += MEMORY * (seconds / guest.pixels - self._s_per_pixel)

    def review(self, now: float) -> dict[str, float]:
        """Return the sessions whose rate changes, with it; looks once a second."""
        if now < self._reviewed_s + REVIEW_S:
            return {}
        self._reviewed_s = now
        free, changed = self._capacity, {}
        for session_id, guest in self._guests.items():
            rate_hz = max(self._rate(guest, free), self._lowest_hz(guest))
            if abs(rate_hz - guest.granted_hz) > NOTICEABLE * guest.granted_hz:
                guest.granted_hz = rate_hz
                changed[session_id] = self._said(guest)
            free -= guest.promised
        return changed

    def _newcomer(self, hello: Hello) -> AdmittedStream:
        pixels = max(k.intrinsics.width_px * k.intrinsics.height_px for k in hello.cameras)
        asked_hz = max(camera.rate_hz for camera in hello.cameras)
        cost_s = pixels * self._s_per_pixel
        says_rate = asked_hz > 0
        asked_hz = asked_hz or ASSUMED_HZ
        return AdmittedStream(pixels, len(hello.cameras), asked_hz, cost_s, asked_hz, says_rate)

    def _full(self, guest: AdmittedStream, free: float) -> LimitExceeded:
        limits = self._limits
        return LimitExceeded(
            Limit.CAPACITY,
            f"{len(self._guests)} vehicles leave {max(0.0, free):.2f} of {self._capacity:g} "
            f"workers; {guest.cameras} x {guest.pixels} pixels at {guest.asked_hz:g} Hz take "
            f"{guest.promised:.2f}; come again in {limits.retry_s:g} s",
            limits.retry_s,
        )

    def _rate(self, guest: AdmittedStream, free: float) -> float:
        """Return the rate that ``free`` workers allow, up to the one that was asked for."""
        return min(guest.asked_hz, max(0.0, free) / (guest.cameras * guest.cost_s))

    def _lowest_hz(self, guest: AdmittedStream) -> float:
        return min(self._limits.lowest_hz, guest.asked_hz)

    @staticmethod
    def _said(guest: AdmittedStream) -> float:
        """A vehicle that never said its rate is not held to one, unless it must be lower."""
        full = guest.granted_hz >= guest.asked_hz
        return 0.0 if full and not guest.says_rate else guest.granted_hz
