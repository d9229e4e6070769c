"""Decides when the next picture of a drive is captured: the first step of a frame's path.

``Realtime`` captures picture i at its time, whatever became of the ones before. ``Lockstep``
captures the next picture when the previous one was answered, and a lost one again. An experiment
then covers every picture, at the speed of the link or the rate that a full server grants. Both are
state machines without a clock: ``now`` is an argument. ``cav_agent.handover_controller`` asks them
and decides which server takes the picture.
"""

from __future__ import annotations

from typing import Protocol

from cav_agent.config import AgentConfig, PaceKind
from cav_agent.frames import EndReason, FrameResult, Outcome
from rfcore.errors import InvalidInput, RfedgeError

ROUNDING_S = 1e-6
"""Tolerance for the rounding error of summed periods."""

MAX_TRIES = 5
"""Captures of the same picture before lockstep gives up."""

HOPELESS = frozenset({EndReason.NOT_CODED, EndReason.OVERSIZE})
"""Ends that another capture of the same picture would only repeat."""


class CaptureSchedule(Protocol):
    """Decides which picture of a drive is captured when."""

    def next_capture(self, now: float) -> int | None:
        """Return, once, the index of the picture to capture now, or None."""

    def ended(self, result: FrameResult) -> None:
        """Note how a captured picture ended; raise ``RfedgeError`` to give up."""

    def get_timer(self) -> float | None:
        """Return when ``next_capture`` will have a picture by time alone, or None."""

    def limit(self, rate_hz: float) -> None:
        """Capture no more than ``rate_hz`` pictures per second; 0: as many as there are."""

    @property
    def finished(self) -> bool:
        """Return whether no further picture will be captured."""


class RateLimit:
    """Limits the captures per second on average; at first, and with 0 Hz, any number is allowed."""

    def __init__(self) -> None:
        self.period_s = 0.0
        self.open_s = float("-inf")
        """Time from which the next capture is allowed."""

    def set_hz(self, rate_hz: float) -> None:
        """Allow ``rate_hz`` captures per second from now on."""
        self.period_s = 1.0 / rate_hz if rate_hz else 0.0

    def allows(self, at_s: float) -> bool:
        """Return whether a picture may be captured at a time."""
        return at_s >= self.open_s - ROUNDING_S

    def captured(self, at_s: float) -> None:
        """Note that a picture was captured."""
        is_behind = self.open_s < at_s - self.period_s
        self.open_s = (at_s if is_behind else self.open_s) + self.period_s


class Realtime:
    """Captures picture i at ``start + i / rate_hz``; a caller that asks late gets each one late.

    Under a limit, pictures in between are not captured: the drive goes on at its own speed.
    """

    def __init__(self, pictures: int, rate_hz: float, *, loop: bool = False) -> None:
        _check(pictures, rate_hz)
        self._pictures, self._rate_hz, self._loop = pictures, rate_hz, loop
        self._count = 0
        self._start_s: float | None = None
        self._limit = RateLimit()

    def next_capture(self, now: float) -> int | None:
        """Return the next index once its time has come."""
        if self._start_s is None:
            self._start_s = now
        while not self.finished and now >= (due_s := self._due_s(self._start_s)):
            self._count += 1
            if self._limit.allows(due_s):
                self._limit.captured(due_s)
                return (self._count - 1) % self._pictures
        return None

    def limit(self, rate_hz: float) -> None:
        """Capture no more than ``rate_hz`` pictures per second on average."""
        self._limit.set_hz(rate_hz)

    def ended(self, result: FrameResult) -> None:
        """Do nothing: the schedule does not depend on it."""

    def get_timer(self) -> float | None:
        """Return when the next picture is due."""
        if self.finished or self._start_s is None:
            return None
        return self._due_s(self._start_s)

    @property
    def finished(self) -> bool:
        """Return whether every picture was captured and the drive is not to begin again."""
        return not self._loop and self._count >= self._pictures

    def _due_s(self, start_s: float) -> float:
        return start_s + self._count / self._rate_hz


class Lockstep:
    """Captures the next picture when the previous was answered and the server's limit allows it.

    A lost picture is captured again. A rig of several ``cameras`` captures its next instant when
    all pictures of the last have ended, and all of them again when one was lost. A camera whose
    picture cannot be coded does not hold up the others.
    """

    def __init__(self, pictures: int, *, cameras: int = 1, loop: bool = False) -> None:
        _check(pictures, 1.0)
        self._pictures, self._cameras, self._loop = pictures, cameras, loop
        self._ended: list[FrameResult] = []
        self._index = 0
        self._tries = 0
        self._waiting = False
        self._limit = RateLimit()

    def next_capture(self, now: float) -> int | None:
        """Return the index to capture, unless one is on its way or the limit is reached."""
        if self._waiting or self.finished or not self._limit.allows(now):
            return None
        self._waiting = True
        self._limit.captured(now)
        self._tries += 1
        return self._index % self._pictures

    def ended(self, result: FrameResult) -> None:
        """Go on after an answer; raise ``RfedgeError`` for a picture that cannot be delivered."""
        self._ended.append(result)
        if len(self._ended) < self._cameras:
            return
        ended, self._ended, self._waiting = self._ended, [], False
        left = [r for r in ended if r.outcome not in (Outcome.ACKED, Outcome.NACKED)]
        retried = [r for r in left if r.reason not in HOPELESS]
        if not retried and len(left) < len(ended):
            self._index += 1
            self._tries = 0
            return
        result = (retried or left)[0]
        name = result.capture.picture.name
        if not retried:
            raise RfedgeError(f"picture {name} could not be coded: {result.problem}")
        if self._tries >= MAX_TRIES and result.reason is not EndReason.STOPPING:
            raise RfedgeError(f"picture {name} was lost {self._tries} times: {result.explanation}")

    def limit(self, rate_hz: float) -> None:
        """Capture no more than ``rate_hz`` pictures per second on average."""
        self._limit.set_hz(rate_hz)

    def get_timer(self) -> float | None:
        """Return when the limit allows the next picture, if nothing else is waited for."""
        if self._waiting or self.finished or not self._limit.period_s:
            return None
        return self._limit.open_s

    @property
    def finished(self) -> bool:
        """Return whether every picture was answered."""
        return not self._loop and self._index >= self._pictures


def recorded_schedule(config: AgentConfig, pictures: int, cameras: int) -> CaptureSchedule:
    """Return when the pictures of a recorded drive are captured."""
    if config.pace is PaceKind.LOCKSTEP:
        return Lockstep(pictures, cameras=cameras, loop=config.loop)
    return Realtime(pictures, config.rate, loop=config.loop)


def _check(pictures: int, rate_hz: float) -> None:
    if pictures < 1:
        raise InvalidInput("drive", "has no pictures")
    if not 0.01 <= rate_hz <= 1000:
        raise InvalidInput("rate", f"{rate_hz} Hz is outside 0.01..1000 Hz")
