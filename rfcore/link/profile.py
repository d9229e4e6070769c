"""What a plain link is: a constant rate, a constant delay, and how much it may hold.

Seconds, bits per second and bytes. The transmission time of ``n`` bytes is ``8 n / rate_bps``, the
tau of the paper's NetworkTX; the delay is added after it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from rfcore.errors import InvalidInput

__all__ = ["MAX_DELAY_S", "MAX_RATE_BPS", "LinkProfile"]

MAX_RATE_BPS = 1e12
"""Above a terabit per second the transmission time drowns in the clock's resolution."""

MAX_DELAY_S = 60.0
"""A delay longer than a minute is a unit mistake (milliseconds given as seconds)."""


@dataclass(frozen=True)
class LinkProfile:
    """A link of ``rate_bps`` bits per second and ``delay_s`` seconds of propagation.

    ``queue_limit_bytes`` is how much may wait for transmission, beside what is in propagation.
    Raises ``InvalidInput`` naming the value and its limit.
    """

    rate_bps: float
    delay_s: float = 0.0
    queue_limit_bytes: int = 64 * 1024

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate_bps) and 1.0 <= self.rate_bps <= MAX_RATE_BPS):
            raise InvalidInput(
                "link.rate_bps", f"{self.rate_bps} is outside 1..{MAX_RATE_BPS:g} bits per second"
            )
        if not (math.isfinite(self.delay_s) and 0.0 <= self.delay_s <= MAX_DELAY_S):
            raise InvalidInput("link.delay_s", f"{self.delay_s} is outside 0..{MAX_DELAY_S:g} s")
        if self.queue_limit_bytes < 1:
            raise InvalidInput(
                "link.queue_limit_bytes", f"{self.queue_limit_bytes} must be at least 1 byte"
            )
