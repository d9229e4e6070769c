"""Log lines about peers, at a rate that a peer cannot choose.

Each identity may cause a burst of lines, then a few per second. Lines beyond that are counted, and
the next one that is written says how many are missing (``suppressed``).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import structlog

from mec_server.ledger.ledger import TokenBucket

LINES_PER_S, LINE_BURST = 5.0, 100.0
"""Enough for a vehicle that reconnects twice a second, and for all that one has to say at once."""

MOST_IDENTITIES = 1024
"""Identities that are remembered; the one that was silent longest is forgotten."""


class LogLimiter:
    """Decides which lines are written; sans-IO. ``suppressed`` counts those that were not."""

    def __init__(self) -> None:
        self.suppressed = 0
        self._buckets: OrderedDict[str, TokenBucket] = OrderedDict()
        self._missing: dict[str, int] = {}

    def admit(self, identity: str, now: float) -> int | None:
        """Return how many lines about ``identity`` were suppressed before this one, or None to
        suppress this one, too."""
        bucket = self._buckets.get(identity)
        if bucket is None:
            bucket = self._buckets[identity] = TokenBucket(LINES_PER_S, now, LINE_BURST)
            if len(self._buckets) > MOST_IDENTITIES:
                forgotten, _ = self._buckets.popitem(last=False)
                self._missing.pop(forgotten, None)
        self._buckets.move_to_end(identity)
        if bucket.take(1.0, now):
            return self._missing.pop(identity, 0)
        self._missing[identity] = self._missing.get(identity, 0) + 1
        self.suppressed += 1
        return None


class PeerLog:
    """structlog's ``logger`` for lines about one identity, within the limiter's rate."""

    def __init__(
        self,
        logger: structlog.typing.FilteringBoundLogger,
        limiter: LogLimiter,
        identity: str,
        clock_s: Callable[[], float],
    ) -> None:
        self._logger = logger
        self._limiter = limiter
        self._identity = identity
        self._clock_s = clock_s

    def bind(self, **values: Any) -> PeerLog:
        """Return a log whose lines have ``values``, too."""
        logger = self._logger.bind(**values)
        return PeerLog(logger, self._limiter, self._identity, self._clock_s)

    def info(self, event: str, **values: Any) -> None:
        """Write a line about something usual."""
        self._write(self._logger.info, event, values)

    def warning(self, event: str, **values: Any) -> None:
        """Write a line about something that was refused."""
        self._write(self._logger.warning, event, values)

    def error(self, event: str, **values: Any) -> None:
        """Write a line about something that failed here."""
        self._write(self._logger.error, event, values)

    def _write(self, write: Callable[..., Any], event: str, values: dict[str, Any]) -> None:
        suppressed = self._limiter.admit(self._identity, self._clock_s())
        if suppressed is not None:
            write(event, **values, **({"suppressed": suppressed} if suppressed else {}))
