"""Worker time that is promised to vehicles, as pictures per second of each of their cameras.

Sans-IO: ``now`` is an argument. The quantity shared out is the workers' time. The time that a frame
takes is measured while the server works: for each stream, and per pixel of each field for new ones.
So when other processes use the machine, or a field is slow to render, frames take longer and lower
rates are granted.

Worker time is given out in three rounds, each in the order in which streams came: the time a stream
uses, within its identity's share; the time it asked for, within that share; and the rest. So an
unused promise decays to the use made of it, one identity holds more than its share only while
nobody else wants it, and a newcomer finds the rest at once. Rejected frames count as no use (their
time has a limit of its own, ``IdentityBudget.rejected_workers``), and a stream of a doubtful
identity needs nothing until it uses something: neither junk nor streams that are opened again and
again keep newcomers out. A vehicle for which less than the lowest rate is left is refused, with the
time to try again; no admitted stream is ended or given a rate below the lowest.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass

from mec_server.config import AdmissionLimits
from mec_server.ledger.budgets import Limit
from rfcore.errors import LimitExceeded
from rfcore.wire.messages import Hello

ASSUMED_HZ = 10.0
"""Rate of a vehicle that does not state how many pictures per second it would send."""

FIRST_S_PER_PIXEL = 1.5e-7
"""Before anything was measured: 35 ms for 640x360, as rendering a field of 200k Gaussians and
decoding took one core of 2.5 GHz."""

FRAME_WEIGHT = 1 / 32
"""Weight of a frame in the running means; at 10 Hz they follow within three seconds."""

MAX_RELATIVE_COST = 4.0
"""Limit of the cost of one frame, relative to the mean: a slow frame may be an accident."""

REVIEW_S = 1.0
MIN_RELATIVE_CHANGE = 0.1
"""Period of reallocation, and the smallest relative change of a rate that a vehicle is sent."""

DECAY_S = 8.0
"""Time constant with which the rate that a stream is taken to use follows the one it does use."""

HEADROOM = 1.25
"""A stream's need relative to its use: room to come back to its full rate."""


@dataclass
class Promise:
    """The worker time promised to one stream. ``cost_s``: worker time for each of its frames."""

    identity: str
    pixels: int
    cameras: int
    requested_hz: float
    states_rate: bool
    cost_s: float
    granted_hz: float
    used_hz: float
    frames: int = 0

    @property
    def workers_per_hz(self) -> float:
        """Return how many workers one picture per second of each camera keeps busy."""
        return self.cameras * self.cost_s

    @property
    def promised(self) -> float:
        """Return how many workers its granted rate keeps busy."""
        return self.granted_hz * self.workers_per_hz

    @property
    def needed_hz(self) -> float:
        """Return the rate that it uses, and some more."""
        return min(self.requested_hz, HEADROOM * self.used_hz)


class Promises:
    """Shares out the time of ``workers``, less the reserve of ``limits``, between identities.

    Each identity has a right to no more than ``share``.
    """

    def __init__(self, limits: AdmissionLimits, workers: int, share: float) -> None:
        self._limits = limits
        self._capacity = limits.load * workers
        self._share = share
        self._streams: dict[str, Promise] = {}
        self._s_per_pixel: dict[str, float] = {}
        self._reviewed_s = float("-inf")
        self._counted_s = float("-inf")
        self.is_crowded = False
        """Whether more than one identity was promised something; may be read from any thread."""

    @property
    def promised_share(self) -> float:
        """Return the promised share of the worker time; above 1 when frames take longer than
        before."""
        if not self._capacity:
            return 0.0
        return sum(stream.promised for stream in tuple(self._streams.values())) / self._capacity

    @property
    def reduced(self) -> int:
        """Return the number of streams that have less than they asked for."""
        return sum(s.granted_hz < s.requested_hz for s in tuple(self._streams.values()))

    def promised_to(self, identity: str) -> float:
        """Return how many workers are promised to ``identity``."""
        return sum(s.promised for s in self._streams.values() if s.identity == identity)

    def identities(self) -> set[str]:
        """Return the identities that were promised something."""
        return {stream.identity for stream in self._streams.values()}

    def enter(
        self,
        session_id: str,
        identity: str,
        hello: Hello,
        now: float,
        *,
        is_doubtful: bool = False,
    ) -> float:
        """Admit a stream; return the rate for each of its cameras, 0 for as many as it likes.

        ``is_doubtful``: work for this identity came to nothing lately (``Ledger.is_doubtful``).
        Raises ``LimitExceeded`` with the time after which to try again.
        """
        if not self._capacity:
            return 0.0
        self._count_use(now)
        stream = self._new_stream(identity, hello)
        if is_doubtful:
            stream.used_hz = 0.0
        is_first = not self._streams
        self._streams[session_id] = stream
        rate_hz = self._rates_hz()[session_id]
        if rate_hz < self._lowest_hz(stream) and not is_first:
            del self._streams[session_id]
            raise self._full(stream, rate_hz)
        stream.granted_hz = max(rate_hz, self._lowest_hz(stream))
        stream.used_hz = min(stream.used_hz, stream.granted_hz)
        self.is_crowded = len(self.identities()) > 1
        self._reviewed_s = float("-inf")  # what others used less than promised, they lose now
        return _offered_hz(stream)

    def leave(self, session_id: str) -> None:
        """Remove a stream that ended; its share is given out at the next reallocation."""
        self._streams.pop(session_id, None)
        self.is_crowded = len(self.identities()) > 1

    def worked(
        self, session_id: str, field_id: str, worker_s: float, *, complete: bool = True
    ) -> None:
        """Note for how long a frame of this session kept a worker busy.

        One that was rejected on the way (not ``complete``) is no use of its promise, and can make
        neither frames seem quick nor those of others slow.
        """
        stream = self._streams.get(session_id)
        if stream is None:
            return
        if not complete and worker_s < stream.cost_s:
            return
        worker_s = min(worker_s, MAX_RELATIVE_COST * stream.cost_s)
        stream.cost_s += FRAME_WEIGHT * (worker_s - stream.cost_s)
        if not complete:
            return
        stream.frames += 1
        s_per_pixel = self._field_s_per_pixel(field_id)
        s_per_pixel += FRAME_WEIGHT * (worker_s / stream.pixels - s_per_pixel)
        self._s_per_pixel[field_id] = s_per_pixel

    def expected_s(self, session_id: str) -> float:
        """Return for how long the next frame of this session will keep a worker busy."""
        stream = self._streams.get(session_id)
        return stream.cost_s if stream is not None else 0.0

    def reallocate_rates(self, now: float) -> dict[str, float]:
        """Return the new rates of the sessions whose rate changes; looks once a second."""
        if not self._capacity or now < self._reviewed_s + REVIEW_S:
            return {}
        self._reviewed_s = now
        self._count_use(now)
        changed = {}
        for session_id, rate_hz in self._rates_hz().items():
            stream = self._streams[session_id]
            rate_hz = max(rate_hz, self._lowest_hz(stream))
            if abs(rate_hz - stream.granted_hz) > MIN_RELATIVE_CHANGE * stream.granted_hz:
                stream.granted_hz = rate_hz
                changed[session_id] = _offered_hz(stream)
        return changed

    def _rates_hz(self) -> dict[str, float]:
        """Return the rate that each stream can be given, in three rounds (see the module)."""
        rates_hz = dict.fromkeys(self._streams, 0.0)
        given: dict[str, float] = defaultdict(float)
        left = self._capacity
        rounds: tuple[tuple[Callable[[Promise], float], float], ...] = (
            (lambda s: s.needed_hz, self._share),
            (lambda s: s.requested_hz, self._share),
            (lambda s: s.requested_hz, 1.0),
        )
        for wanted_hz, share in rounds:
            for session_id, stream in self._streams.items():
                free = max(0.0, min(left, share * self._capacity - given[stream.identity]))
                more_hz = max(0.0, wanted_hz(stream) - rates_hz[session_id])
                more_hz = min(more_hz, free / stream.workers_per_hz)
                rates_hz[session_id] += more_hz
                given[stream.identity] += more_hz * stream.workers_per_hz
                left -= more_hz * stream.workers_per_hz
        return rates_hz

    def _count_use(self, now: float) -> None:
        """Let the rate that each stream is taken to use follow the frames that came."""
        elapsed_s = now - self._counted_s
        if elapsed_s < REVIEW_S:
            return
        self._counted_s = now
        weight = -math.expm1(-elapsed_s / DECAY_S)
        for stream in self._streams.values():
            if math.isfinite(elapsed_s):
                seen_hz = stream.frames / stream.cameras / elapsed_s
                stream.used_hz += (seen_hz - stream.used_hz) * (
                    1.0 if seen_hz > stream.used_hz else weight
                )
            stream.frames = 0

    def _new_stream(self, identity: str, hello: Hello) -> Promise:
        pixels = max(k.intrinsics.width_px * k.intrinsics.height_px for k in hello.cameras)
        stated_hz = max(camera.rate_hz for camera in hello.cameras)
        requested_hz = stated_hz or ASSUMED_HZ
        return Promise(
            identity=identity,
            pixels=pixels,
            cameras=len(hello.cameras),
            requested_hz=requested_hz,
            states_rate=stated_hz > 0,
            cost_s=pixels * max(map(self._field_s_per_pixel, hello.field_ids)),
            granted_hz=requested_hz,
            used_hz=requested_hz,
        )

    def _field_s_per_pixel(self, field_id: str) -> float:
        """Return the time per pixel of a field; of one never rendered, what others take."""
        known = self._s_per_pixel
        if field_id in known:
            return known[field_id]
        return sum(known.values()) / len(known) if known else FIRST_S_PER_PIXEL

    def _full(self, stream: Promise, rate_hz: float) -> LimitExceeded:
        retry_s = self._limits.retry_s
        return LimitExceeded(
            Limit.CAPACITY,
            f"{len(self._streams)} vehicles leave {rate_hz * stream.workers_per_hz:.2f} of "
            f"{self._capacity:g} workers; {stream.cameras} x {stream.pixels} pixels at "
            f"{stream.requested_hz:g} Hz take {stream.promised:.2f}; come again in {retry_s:g} s",
            retry_s,
        )

    def _lowest_hz(self, stream: Promise) -> float:
        return min(self._limits.lowest_hz, stream.requested_hz)


def _offered_hz(stream: Promise) -> float:
    """Return the rate to send to the vehicle: 0 ("no limit") if it stated none and is granted
    all."""
    full = stream.granted_hz >= stream.requested_hz
    return 0.0 if full and not stream.states_rate else stream.granted_hz
