"""Say what a program waits for: soon, then ever more rarely."""

from __future__ import annotations

import contextvars
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import structlog

FIRST_S, LONGEST_S = 2.0, 60.0
"""A wait is told of after ``FIRST_S``, then at doubling intervals of at most ``LONGEST_S``."""

Say = Callable[[str, float], None]
"""Takes what is waited for, and for how many seconds it has been."""


def log_wait(what: str, waited_s: float) -> None:
    """Log what is waited for."""
    structlog.get_logger().info("waiting", what=what, since_s=round(waited_s, 1))


class WaitLog:
    """Tells ``say`` of waits that last; time is an argument."""

    def __init__(self, say: Say, first_s: float = FIRST_S) -> None:
        self._say = say
        self._first_s = first_s
        self._what = ""
        self._since_s = 0.0
        self._pause_s = first_s
        self._due_s = float("inf")

    def note(self, what: str, now: float) -> None:
        """Note what is waited for now, "" for nothing; another wait begins anew."""
        if what != self._what:
            self._what, self._since_s, self._pause_s = what, now, self._first_s
            self._due_s = now + self._first_s if what else float("inf")
        self.note_again(now)

    def note_again(self, now: float) -> None:
        """Note that the same is waited for."""
        if now >= self._due_s:
            self._say(self._what, now - self._since_s)
            self._pause_s = min(2 * max(self._pause_s, FIRST_S), LONGEST_S)
            self._due_s = now + self._pause_s


@contextmanager
def waiting(what: str, say: Say) -> Iterator[Callable[[str], None]]:
    """Tell ``say``, on a thread of its own, as long as the block lasts.

    What is yielded begins another wait, "" none.
    """
    log, ended = WaitLog(say), threading.Event()

    def begin(what: str) -> None:
        nonlocal log
        log = WaitLog(say)
        log.note(what, time.monotonic())

    def tell() -> None:
        while not ended.wait(FIRST_S / 4):
            log.note_again(time.monotonic())

    begin(what)
    context = contextvars.copy_context()
    threading.Thread(target=context.run, args=(tell,), name="waiting", daemon=True).start()
    try:
        yield begin
    finally:
        ended.set()
