"""Limits the bytes of the next frame so that its answer comes within a delay.

The delay runs from capture to Ack, as ``rfedge_agent_capture_to_ack_seconds`` measures it: waiting,
rendering, coding, the uplink, the server's work and the downlink. Quality falls first: a frame gets
the bytes that the path's recent behaviour leaves room for (``cav_agent.path_estimator``), and no
more than it can carry at the rate of capture. When not even the smallest frame has room, the next
picture waits for an answer; a newer one may take its place, so pictures are dropped before they are
coded.

The frames of a rig's instant count as one packet on the path: sent when the first of them was,
answered with the last, less the time for which none was on its way because the next was being
coded. One frame of a camera among several is too short to tell the path's rate from its jitter.

Only what fewer bytes can change is taken for the path's. An Ack says how long the server worked on
the frame; that time is no part of the round trip. Answers may wait behind a field that the vehicle
downloads (``own_wait_s``); that wait makes no frame late. Nor is a frame late for its bytes if an
empty one would have been late too. And however slow the processors at both ends are, bytes have
``PATH_SHARE`` of the delay: slow ends do not make frames small. What an end takes is the median of
its last frames, so one slow frame changes nothing.

``BitDivision`` divides the bytes of an instant among the cameras of a rig, so that quality is even.
A slice of complexity c takes about c 2^(-CRF / 6) bytes. So all cameras come out at one CRF when
each gets bytes in proportion to its complexity, which is learnt from its coded frames. Motion, a
field that shows something else than the camera sees, and a mask that is coded finer make slices
longer at the same CRF: they are in the complexity. The shares sum to the budget, and none is below
``LEAST_CAMERA_SHARE`` of an even share: a camera that shows little now is ready for what comes.

No clock is read: ``now`` is an argument.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import median

from cav_agent.path_estimator import PathEstimator
from rfcore.errors import InvalidInput
from rfcore.wire.messages import FrameAddress

SHARE = 0.75
"""Share of the delay that is aimed at; the rest is a margin for frames, path and machine."""

PATH_SHARE = 0.25
"""Share of the delay that bytes may always use beyond the shortest round trip. When processors
leave less, the delay is not kept: smaller frames would not make them quicker."""

SUSTAINED = 0.85
"""Share of the path's rate that frames may use steadily; the rest drains queues."""

LEAST_BYTES = 240
"""The smallest frame worth coding; at the highest CRF a frame of a street has 100 to 300."""

MOST_BYTES = 1e9
"""Stands for an unlimited number of bytes."""

LIMIT = 1.5
"""A slice of more than this many times its target is coded again."""

SHRINK, GROW = 0.7, 0.004
"""The share of the time for bytes that is used shrinks to 0.7 of itself when a frame was late
(unless it was coded before the last cut), and grows by 0.004 for each in time. They balance at 1
late frame in 100: 0.3 of any share up to 1 against 99 times 0.004."""
LEAST_SHARE = 0.1

MEMORY = 0.75
"""Weight of what was known in the running means."""

LEAST_CAMERA_SHARE = 0.25
"""Part of an even share that every camera of a rig gets at least."""

HALVING_CRF = 6.0
"""CRF that halves a slice (4 of CRF change the bits of a street by 60 %)."""

REMEMBERED_FRAMES = 8
"""Frames of which the median time counts at each end. An answer is overdue when it takes longer
than the server's longest of them."""

OVERHEAD_BYTES = 150
"""Pose, digests, gRPC and HTTP/2 framing around a slice: assumed until one was sent."""


@dataclass(frozen=True)
class ByteBudget:
    """The bytes that a slice may have.

    It aims at ``target_bytes``; a slice above ``limit_bytes`` is coded again.
    ``rate_bps``: what answers have proven the path to carry; None before the first one.
    """

    target_bytes: float
    limit_bytes: int
    rate_bps: float | None = None

    def with_target(self, target_bytes: float) -> ByteBudget:
        """Return the budget of a camera that gets this part of it."""
        return replace(self, target_bytes=target_bytes, limit_bytes=int(LIMIT * target_bytes))


@dataclass
class InstantInFlight:
    """The frames of an instant that are ``unsent`` or ``unanswered``; times in seconds."""

    unsent: int
    unanswered: set[FrameAddress] = field(default_factory=set)
    answered_s: float | None = None
    longest_latency_s: float = 0.0

    @property
    def is_over(self) -> bool:
        """Return whether nothing more will be sent or answered."""
        return not (self.unsent > 0 or self.unanswered)


class RateControl:
    """Keeps frames, or a rig's instants, within ``max_delay_s`` from capture to Ack.

    ``own_wait_s`` returns how long an answer to what was sent at the first time, not there before
    the second, can have waited behind the vehicle's own downloads.
    """

    def __init__(
        self,
        max_delay_s: float,
        own_wait_s: Callable[[float, float], float] = lambda _since_s, _until_s: 0.0,
    ) -> None:
        if not 0.01 <= max_delay_s <= 60:
            raise InvalidInput("max_delay", f"{1e3 * max_delay_s:g} ms is outside 10..60000 ms")
        self._max_delay_s = max_delay_s
        self._path = PathEstimator(lambda a, b: _ns(own_wait_s(a / 1e9, b / 1e9)))
        self._share = 1.0
        self._cut_s = float("-inf")
        self._asked_s = float("-inf"), 0.0
        """A time of capture, and when coding was first possible but for the path."""
        self._work_times_s: deque[float] = deque(maxlen=REMEMBERED_FRAMES)
        self._server_times_s: deque[float] = deque(maxlen=REMEMBERED_FRAMES)
        self._overhead_bytes = float(OVERHEAD_BYTES)
        self._interval_s: float | None = None
        self._captured_s: float | None = None
        self._instants: dict[Hashable, InstantInFlight] = {}
        self._instant_of: dict[FrameAddress, Hashable] = {}

    @property
    def _work_s(self) -> float:
        return median(self._work_times_s) if self._work_times_s else 0.0

    @property
    def _server_s(self) -> float:
        return median(self._server_times_s) if self._server_times_s else 0.0

    def captured(self, now: float) -> None:
        """Note that a picture was captured, or those of an instant."""
        if self._captured_s is not None:
            interval_s = now - self._captured_s
            self._interval_s = _mean(self._interval_s, interval_s)
        self._captured_s = now

    def is_late(self, captured_s: float, now: float) -> bool:
        """Return whether a picture has waited so long that even an empty frame would be late."""
        least_s = self._work_s + self._server_s + self._path.min_rtt_ns / 1e9
        left_s = self._max_delay_s - least_s
        return now - captured_s > (left_s if left_s > 0 else self._max_delay_s)

    def budget(self, captured_s: float, now: float, pictures: int = 1) -> ByteBudget | None:
        """Return the bytes for the pictures of ``captured_s`` together if coding begins ``now``.

        ``pictures``: how many of one instant. None while they should wait for an answer.
        """
        if captured_s != self._asked_s[0]:
            self._asked_s = captured_s, now
        room = self._room_bytes(captured_s, now, 1.0, 1.0, pictures)
        if self._path.bytes_in_flight and room < LEAST_BYTES * pictures:
            return None
        room = self._room_bytes(captured_s, now, SHARE, self._share, pictures)
        if self._interval_s:
            carried = self._path.sustained_bytes(1e9 * self._interval_s, self._off_path_ns(now))
            room = min(room, SUSTAINED * carried - pictures * self._overhead_bytes)
        target = min(max(room, LEAST_BYTES * pictures), MOST_BYTES)
        return ByteBudget(target, int(LIMIT * target), self._path.rate_bps)

    def _room_bytes(
        self, captured_s: float, now: float, part: float, share: float, pictures: int
    ) -> float:
        """Return the bytes that slices of an instant may have together to be answered in time.

        In time is within ``part`` of the delay or, if that is later, after coding, without a wait
        for the path, and ``PATH_SHARE``. ``share`` of the room is used. Sending begins when the
        first is coded, and the last has its part of the room.
        """
        work_s, delay_s = self._work_s, part * self._max_delay_s
        way_s = min(self._path.min_rtt_ns / 1e9, self._max_delay_s / 2)
        least_s = part * (PATH_SHARE * self._max_delay_s + way_s)
        coded_s = self._asked_s[1] + pictures * work_s
        due_s = max(captured_s + delay_s - self._server_s, coded_s + least_s)
        first, last = (
            self._path.room_bytes(
                _ns(now + coded * work_s), _ns(due_s), self._off_path_ns(now), share
            )
            for coded in (1, pictures)
        )
        return min(first, pictures * last) - pictures * self._overhead_bytes

    def _off_path_ns(self, now: float) -> int:
        """Return when an answer that comes ``now`` left the path at the latest."""
        return _ns(now - max(self._server_times_s, default=0.0))

    def coded(self, sender_s: float, payload_bytes: int, packet_bytes: int) -> None:
        """Note that a frame took the sender ``sender_s`` from the picture to the packet."""
        self._work_times_s.append(sender_s)
        self._overhead_bytes = _mean(self._overhead_bytes, packet_bytes - payload_bytes)

    def begun(self, instant: int, pictures: int) -> None:
        """Note that so many pictures of an instant will be coded; instant 0: of a camera alone."""
        for key in [key for key, other in self._instants.items() if not other.unanswered]:
            self._path.lost(key)
            del self._instants[key]
        if instant:
            self._instants[instant] = InstantInFlight(pictures)

    def sent(self, address: FrameAddress, packet_bytes: int, now: float, instant: int = 0) -> None:
        """Note that a frame was sent, of a rig's ``instant`` or (0) of a camera alone."""
        key: Hashable = instant or address
        frames = self._instants.setdefault(key, InstantInFlight(1))
        if frames.unanswered:
            self._path.grew(key, packet_bytes, 0)
        elif frames.answered_s is not None:
            self._path.grew(key, packet_bytes, max(0, _ns(now - frames.answered_s)))
        else:
            self._path.sent(key, packet_bytes, _ns(now))
        frames.unsent -= 1
        frames.unanswered.add(address)
        self._instant_of[address] = key

    def not_sent(self, instant: int) -> None:
        """Note that a frame of an instant was not sent after all."""
        frames = self._instants.get(instant)
        if frames is not None:
            frames.unsent -= 1
            self._close(instant, frames)

    def answered(
        self, address: FrameAddress, latency_s: float, now: float, server_s: float | None = None
    ) -> None:
        """Note an answer, by Ack or Nack, ``latency_s`` after the frame's capture.

        ``server_s``: how long the server worked on it, where the answer says so.
        """
        if server_s is not None:
            self._server_times_s.append(server_s)
        key = self._instant_of.pop(address, None)
        if key is None:
            return
        frames = self._instants[key]
        frames.unanswered.discard(address)
        frames.answered_s = now - (self._server_s if server_s is None else server_s)
        frames.longest_latency_s = max(frames.longest_latency_s, latency_s)
        self._close(key, frames)

    def lost(self, address: FrameAddress) -> None:
        """Note that no answer to a frame will come: its instant gives no time."""
        key = self._instant_of.pop(address, None)
        if key is None:
            return
        frames = self._instants[key]
        frames.unanswered.discard(address)
        self._path.lost(key)
        self._close(key, frames)

    def _close(self, key: Hashable, frames: InstantInFlight) -> None:
        """Learn about the path from an instant that is over.

        Less of the room is used from now on if it was late, and in time without the bytes, and they
        took more than they always may.
        """
        if not frames.is_over:
            return
        del self._instants[key]
        if frames.answered_s is None:
            return
        sample = self._path.answered(key, _ns(frames.answered_s))
        latency_s = bytes_s = beyond_s = frames.longest_latency_s
        if sample is not None:
            own_s = sample.own_ns / 1e9
            beyond_s = (sample.rtt_ns - self._path.min_rtt_ns) / 1e9
            latency_s, bytes_s = latency_s - own_s, beyond_s - own_s
        if latency_s <= self._max_delay_s:
            self._share = min(1.0, self._share + GROW)
        elif (
            not (sample is not None and sample.is_stall)
            and latency_s - bytes_s <= self._max_delay_s < beyond_s / PATH_SHARE
            and frames.answered_s - latency_s >= self._cut_s
        ):
            self._share = max(LEAST_SHARE, SHRINK * self._share)
            self._cut_s = frames.answered_s


class BitDivision:
    """Divides bytes among cameras by complexity, weighed by ``priorities``.

    A camera of priority 2 gets twice the bytes of one like it.
    """

    def __init__(self, priorities: Mapping[str, float]) -> None:
        for camera_id, priority in priorities.items():
            if not (math.isfinite(priority) and priority > 0):
                raise InvalidInput("priority", f"{priority} of camera {camera_id} must be above 0")
        self._priorities = dict(priorities)
        self._complexity: dict[str, float] = {}

    def coded(self, camera_id: str, payload_bytes: int, crf: float) -> None:
        """Note that a frame of a camera took so many bytes at ``crf``."""
        found = max(1, payload_bytes) * 2 ** (crf / HALVING_CRF)
        self._complexity[camera_id] = _mean(self._complexity.get(camera_id), found)

    def divide(self, total_bytes: float, camera_ids: Sequence[str]) -> dict[str, float]:
        """Return the bytes of each camera; they sum to ``total_bytes``.

        A camera without a coded frame counts as complex as the mean of the others.
        """
        known = [self._complexity[c] for c in camera_ids if c in self._complexity]
        usual = sum(known) / len(known) if known else 1.0
        weights = {
            c: self._priorities.get(c, 1.0) * self._complexity.get(c, usual) for c in camera_ids
        }
        whole, least = sum(weights.values()), LEAST_CAMERA_SHARE / len(camera_ids)
        return {
            c: total_bytes * (least + (1 - LEAST_CAMERA_SHARE) * weight / whole)
            for c, weight in weights.items()
        }


def _mean(known: float | None, found: float) -> float:
    return found if known is None else MEMORY * known + (1 - MEMORY) * found


def _ns(seconds: float) -> int:
    return round(1e9 * seconds)
