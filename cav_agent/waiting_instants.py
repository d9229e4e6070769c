"""Pictures that wait for the encoder, by instants: the newest instant wins, one begun is finished.

Pictures of one instant belong together. So a newer instant takes the place of one that waits as a
whole, and an instant that was begun is coded to its end before another begins. An instant begins
when every camera in it may send. A camera that may not, while others may, is left out of the
instants that follow until it may again: what is wrong with one camera costs the others one instant
at most. Without clock; a single camera is a rig of one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from cav_agent.frames import Capture

__all__ = ["WaitingInstants"]


class WaitingInstants:
    """Keeps at most ``slots`` instants that have not begun; ``may_send`` asks for a camera."""

    def __init__(self, slots: int, may_send: Callable[[str], bool]) -> None:
        self._slots, self._may_send = slots, may_send
        self._begun: deque[Capture] = deque()
        self._waiting: deque[tuple[Capture, ...]] = deque()
        self._left_out: set[str] = set()

    def __bool__(self) -> bool:
        return bool(self._begun or self._waiting)

    @property
    def waiting_since_s(self) -> float | None:
        """When the oldest instant that has not begun was captured."""
        return min(c.captured_s for c in self._waiting[0]) if self._waiting else None

    @property
    def is_begun(self) -> bool:
        """Whether pictures of an instant that was begun are left."""
        return bool(self._begun)

    def offer(self, captures: tuple[Capture, ...]) -> list[Capture]:
        """Take the pictures of an instant; return those that it supersedes."""
        superseded: list[Capture] = []
        if self._begun and not any(self._may_send(c.camera_id) for c in self._begun):
            superseded += self._drop_begun()
        if len(self._waiting) >= self._slots:
            late = self._waiting.popleft()
            may = {capture.camera_id: self._may_send(capture.camera_id) for capture in late}
            if any(may.values()):
                self._left_out |= {camera_id for camera_id in may if not may[camera_id]}
            superseded += late
        self._waiting.append(captures)
        return superseded

    def startable(self) -> tuple[Capture, ...]:
        """Return the pictures of the next instant that may begin; empty while none may."""
        self._left_out = {c for c in self._left_out if not self._may_send(c)}
        if self._begun or not self._waiting:
            return ()
        captures = self._waiting[0]
        ready = tuple(c for c in captures if self._may_send(c.camera_id))
        waited_for = {c.camera_id for c in captures} - {c.camera_id for c in ready}
        return () if waited_for - self._left_out else ready

    def begin(self) -> list[Capture]:
        """Begin the instant of ``startable``; return its pictures that are left out."""
        ready = self.startable()
        captures = self._waiting.popleft()
        self._begun.extend(ready)
        begun = {capture.camera_id for capture in ready}
        return [capture for capture in captures if capture.camera_id not in begun]

    def next(self) -> Capture | None:
        """Return, once, the next picture of the instant that was begun, if one may be sent."""
        for place, capture in enumerate(self._begun):
            if self._may_send(capture.camera_id):
                del self._begun[place]
                return capture
        return None

    def drop_oldest(self) -> list[Capture]:
        """Remove the oldest instant that has not begun; return its pictures."""
        return list(self._waiting.popleft())

    def clear(self) -> list[Capture]:
        """Remove everything; return the pictures."""
        dropped = self._drop_begun()
        while self._waiting:
            dropped += self._waiting.popleft()
        return dropped

    def _drop_begun(self) -> list[Capture]:
        dropped = list(self._begun)
        self._begun.clear()
        return dropped
