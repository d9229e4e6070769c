"""How long a vehicle waits for the answer to a frame before it takes the link for dead.

A silent partition is noticed by the kernel when it has bytes that nobody acknowledges. A stopped
server, or a middlebox that forwards nothing, acknowledges everything and answers nothing; there
only waiting helps. How long depends on what was usual: a frame may take ``STALL_S``, the time its
bytes need at ``SLOWEST_BPS``, and twice the longest of the last answers.
"""

from __future__ import annotations

from collections import deque

__all__ = ["SLOWEST_BPS", "STALL_S", "AnswerTimeout"]

STALL_S = 1.0
SLOWEST_BPS = 0.3e6
"""A link that has collapsed to this rate still counts as one."""

REMEMBERED = 8


class AnswerTimeout:
    """Says how long to wait; at most ``longest_s``, which is also what a first answer may take."""

    def __init__(self, longest_s: float) -> None:
        self._longest_s = longest_s
        self._usual_s: deque[float] = deque(maxlen=REMEMBERED)

    def begin(self) -> None:
        """A new stream has no usual time yet."""
        self._usual_s.clear()

    def answered(self, within_s: float) -> None:
        """Take note of how long an answer took."""
        self._usual_s.append(within_s)

    def limit_s(self, bytes_under_way: int) -> float:
        """Return how long the answer to the newest of so many bytes may take."""
        if not self._usual_s:
            return self._longest_s
        link_s = 8 * bytes_under_way / SLOWEST_BPS
        return min(self._longest_s, STALL_S + link_s + 2 * max(self._usual_s))
