"""When a frame was taken: by its sender's reports, or by its arrival less the jitter.

RTCP sender reports (RFC 3550, 6.4.1) say which wall-clock time belongs to which time stamp, so a
frame's capture is known as well as both machines' clocks agree. Without them a frame was taken at
the latest when it arrived: its time is its stamp plus the least (arrival - stamp) of the last
frames, which takes the jitter out but leaves the camera's own, constant delay in. That is stated as
``arrival``, never mixed up with the other.

Times handed out increase; a frame whose time does not is left out. Where that goes on for longer
than ``PATIENCE_NS`` it begins anew from the arrival: this machine's clock was set back, or the
sender's is not to be believed, as where it is further than ``MAX_APART_NS`` from the arrival.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from rfcore.wire.sensing import ClockKind

__all__ = ["CaptureClock", "Stamp"]

NS = 1_000_000_000
MAX_APART_NS = 10 * NS
PATIENCE_NS = 1 * NS
WINDOW_FRAMES = 300


@dataclass(frozen=True)
class Stamp:
    """When a frame was taken, Unix time, and on whose word."""

    time_ns: int
    clock: ClockKind


class CaptureClock:
    """Stamps the frames of one connection; all later than ``after_ns``."""

    def __init__(self, after_ns: int = 0) -> None:
        self.last_ns = after_ns
        self._delays: deque[int] = deque(maxlen=WINDOW_FRAMES)
        self._last_pts_ns: int | None = None
        self._distrusts_sender = False
        self._backwards_since_ns: int | None = None

    def stamp(self, pts_ns: int | None, received_ns: int, sender_ns: int | None) -> Stamp | None:
        """Return a frame's time; ``None`` for one that is not later than the one before it."""
        arrival_ns = self._arrival_ns(pts_ns, received_ns)
        stamp = Stamp(arrival_ns, ClockKind.ARRIVAL)
        if sender_ns is not None and not self._distrusts_sender:
            if abs(received_ns - sender_ns) > MAX_APART_NS:
                self._distrusts_sender = True
            else:
                stamp = Stamp(min(sender_ns, received_ns), ClockKind.SENDER_REPORT)
        if stamp.time_ns > self.last_ns:
            self._backwards_since_ns = None
            self.last_ns = stamp.time_ns
            return stamp
        return self._backwards(received_ns)

    def _backwards(self, received_ns: int) -> Stamp | None:
        """Drop frames that go back; after a while begin anew with their arrival."""
        since = self._backwards_since_ns
        if since is None:
            self._backwards_since_ns = received_ns
            return None
        if abs(received_ns - since) < PATIENCE_NS:
            return None
        self._distrusts_sender = True
        self._delays.clear()
        self._backwards_since_ns = None
        self.last_ns = received_ns
        return Stamp(received_ns, ClockKind.ARRIVAL)

    def _arrival_ns(self, pts_ns: int | None, received_ns: int) -> int:
        if pts_ns is None:
            return received_ns
        delay_ns = received_ns - pts_ns
        if self._last_pts_ns is not None and pts_ns < self._last_pts_ns:
            self._delays.clear()  # the sender began anew
        self._last_pts_ns = pts_ns
        self._delays.append(delay_ns)
        return pts_ns + min(self._delays)
