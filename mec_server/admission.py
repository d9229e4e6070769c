"""Who is let in, and at how many pictures per second, so that admitted streams keep their service.

Sans-IO: ``now`` is an argument. What is shared out is the workers' time. What a frame takes of it
is measured while the server works: for each stream, and per pixel for new ones. So when other
processes use the machine, or a field is slow to render, frames take longer and lower rates are
granted. Streams get what they ask for in the order in which they came; the last one gets what is
left, and one for which too little is left is refused and told when to try again. When frames take
longer or shorter, or a stream ends, rates are reallocated in the same order; no admitted stream is
ended for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from mec_server.config import AdmissionLimits
from mec_server.quotas import ActiveCameras, Allowance, CameraSender, Limit, Quotas
from rfcore.errors import LimitExceeded
from rfcore.wire.messages import Hello

__all__ = ["ASSUMED_HZ", "Admission", "EntryControl", "StreamPermit"]

ASSUMED_HZ = 10.0
"""Rate of a vehicle that does not state how many pictures per second it would send."""

FIRST_S_PER_PIXEL = 1.5e-7
"""Before anything was measured: 35 ms for 640x360, as rendering a field of 200k Gaussians and
decoding took one core of 2.5 GHz."""

FRAME_WEIGHT = 1 / 32
"""Weight of a frame in the running means; at 10 Hz they follow within three seconds."""

MAX_RELATIVE_COST = 4.0
"""A frame that took longer than so many usual ones counts as that many: one may be an accident."""

REVIEW_S = 1.0
MIN_RELATIVE_CHANGE = 0.1
"""Rates are reallocated once a second, and a vehicle is told of changes by more than a tenth."""


@dataclass
class AdmittedStream:
    """A stream that was let in. ``cost_s``: worker time for each of its frames."""

    pixels: int
    cameras: int
    requested_hz: float
    cost_s: float
    granted_hz: float
    states_rate: bool

    @property
    def promised(self) -> float:
        """Return how many workers its granted rate keeps busy."""
        return self.granted_hz * self.cameras * self.cost_s


class Admission:
    """Shares out the time of ``workers``, less what ``limits`` keeps back."""

    def __init__(self, limits: AdmissionLimits, workers: int) -> None:
        self._limits = limits
        self._capacity = limits.load * workers
        self._streams: dict[str, AdmittedStream] = {}
        self._s_per_pixel = FIRST_S_PER_PIXEL
        self._reviewed_s = float("-inf")

    @property
    def promised_share(self) -> float:
        """Return what is promised, of what may be; above 1 when frames take longer than before."""
        if not self._capacity:
            return 0.0
        return sum(stream.promised for stream in self._streams.values()) / self._capacity

    @property
    def reduced(self) -> int:
        """Return how many streams have less than they asked for."""
        return sum(stream.granted_hz < stream.requested_hz for stream in self._streams.values())

    def enter(self, session_id: str, hello: Hello) -> float:
        """Admit a stream; return the rate for each of its cameras, 0 for as many as it likes.

        Raises ``LimitExceeded`` with the time after which to try again.
        """
        stream = self._new_stream(hello)
        if not self._capacity:
            return 0.0
        free = self._capacity - sum(other.promised for other in self._streams.values())
        rate_hz = self._affordable_hz(stream, free)
        if rate_hz < self._lowest_hz(stream) and self._streams:
            raise self._full(stream, free)
        stream.granted_hz = max(rate_hz, self._lowest_hz(stream))
        self._streams[session_id] = stream
        return self._offered_rate(stream)

    def leave(self, session_id: str) -> None:
        """Forget a stream that ended; what it had is shared out at the next reallocation."""
        self._streams.pop(session_id, None)

    def worked(self, session_id: str, worker_s: float) -> None:
        """Note for how long a frame of this session kept a worker busy."""
        stream = self._streams.get(session_id)
        if stream is None:
            return
        worker_s = min(worker_s, MAX_RELATIVE_COST * stream.cost_s)
        stream.cost_s += FRAME_WEIGHT * (worker_s - stream.cost_s)
        self._s_per_pixel += FRAME_WEIGHT * (worker_s / stream.pixels - self._s_per_pixel)

    def reallocate_rates(self, now: float) -> dict[str, float]:
        """Return the new rates of the sessions whose rate changes; looks once a second."""
        if now < self._reviewed_s + REVIEW_S:
            return {}
        self._reviewed_s = now
        free, changed = self._capacity, {}
        for session_id, stream in self._streams.items():
            rate_hz = max(self._affordable_hz(stream, free), self._lowest_hz(stream))
            if abs(rate_hz - stream.granted_hz) > MIN_RELATIVE_CHANGE * stream.granted_hz:
                stream.granted_hz = rate_hz
                changed[session_id] = self._offered_rate(stream)
            free -= stream.promised
        return changed

    def _new_stream(self, hello: Hello) -> AdmittedStream:
        pixels = max(k.intrinsics.width_px * k.intrinsics.height_px for k in hello.cameras)
        stated_hz = max(camera.rate_hz for camera in hello.cameras)
        requested_hz = stated_hz or ASSUMED_HZ
        return AdmittedStream(
            pixels=pixels,
            cameras=len(hello.cameras),
            requested_hz=requested_hz,
            cost_s=pixels * self._s_per_pixel,
            granted_hz=requested_hz,
            states_rate=stated_hz > 0,
        )

    def _full(self, stream: AdmittedStream, free: float) -> LimitExceeded:
        limits = self._limits
        return LimitExceeded(
            Limit.CAPACITY,
            f"{len(self._streams)} vehicles leave {max(0.0, free):.2f} of {self._capacity:g} "
            f"workers; {stream.cameras} x {stream.pixels} pixels at {stream.requested_hz:g} Hz "
            f"take {stream.promised:.2f}; come again in {limits.retry_s:g} s",
            limits.retry_s,
        )

    def _affordable_hz(self, stream: AdmittedStream, free: float) -> float:
        """Return the rate that ``free`` workers allow, up to the one that was asked for."""
        return min(stream.requested_hz, max(0.0, free) / (stream.cameras * stream.cost_s))

    def _lowest_hz(self, stream: AdmittedStream) -> float:
        return min(self._limits.lowest_hz, stream.requested_hz)

    @staticmethod
    def _offered_rate(stream: AdmittedStream) -> float:
        """Return the rate to tell the vehicle: 0, "no limit", if it stated none and gets all."""
        full = stream.granted_hz >= stream.requested_hz
        return 0.0 if full and not stream.states_rate else stream.granted_hz


@dataclass(frozen=True)
class StreamPermit:
    """A stream that was let in: what its vehicle may use, and the rate of each of its cameras."""

    rate_hz: float
    allowance: Allowance
    worked: Callable[[float], None]
    """Called with the seconds for which a frame kept a worker busy."""
    leave: Callable[[], None]
    """Gives back everything the stream was granted; to be called once."""


class EntryControl:
    """Judges a Hello by everything that limits who may stream: quotas, cameras, workers' time."""

    def __init__(self, quotas: Quotas, admission: Admission) -> None:
        self._quotas = quotas
        self._cameras = ActiveCameras()
        self._admission = admission

    def enter(
        self, hello: Hello, account: str, session_id: str, sender: CameraSender, now: float
    ) -> StreamPermit:
        """Let a stream in that ``account`` is to be charged for.

        Raises ``LimitExceeded``, after which nothing is held for the stream.
        """
        allowance = self._quotas.enter(account, now)

        def leave() -> None:
            allowance.leave()
            self._cameras.leave(sender)
            self._admission.leave(session_id)

        try:
            rate_hz = self._admission.enter(session_id, hello)
            self._cameras.enter(hello, sender, now)
        except LimitExceeded:
            leave()
            raise
        worked = partial(self._admission.worked, session_id)
        return StreamPermit(rate_hz, allowance, worked, leave)

    def reallocate_rates(self, now: float) -> dict[str, float]:
        """Return the new rates of the sessions whose rate changes."""
        return self._admission.reallocate_rates(now)
