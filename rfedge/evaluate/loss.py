"""A link that loses datagrams, and who predicts from what over it: machines on a virtual clock.

Losses come in bursts (Gilbert 1960, Elliott 1963: a good state that delivers, a bad one that does
not). A frame is cut into datagrams of 1200 bytes and is lost if one of them is; no repetition, no
forward error correction. What became of a frame is known to the sender one round trip after it was
sent, and what was lost, one frame later, when the next one shows the gap. Answers are not lost.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from random import Random

from rfcore.errors import InvalidInput

__all__ = ["DATAGRAM_BYTES", "Bursts", "Feedback", "Lossy", "Policy"]

DATAGRAM_BYTES = 1200
"""What passes every network without fragments (RFC 9000, 14)."""


@dataclass(frozen=True)
class Bursts:
    """``share`` of the datagrams lost on average, ``length`` in a row on average."""

    share: float
    length: float = 2.0

    def __post_init__(self) -> None:
        if not 0 <= self.share < 0.5:
            raise InvalidInput("loss.share", f"{self.share} is outside 0..0.5")
        if not self.length >= 1:
            raise InvalidInput("loss.length", f"{self.length} must be at least 1 datagram")


class Lossy:
    """The link: tells of one frame after another whether it arrives."""

    def __init__(self, bursts: Bursts, random: Random) -> None:
        self._random = random
        self._leave_bad = 1 / bursts.length
        self._enter_bad = bursts.share / (1 - bursts.share) / bursts.length
        self._bad = False

    def delivers(self, size_bytes: int) -> bool:
        """Send a frame of ``size_bytes``; return whether all its datagrams arrived."""
        datagrams = max(1, -(-size_bytes // DATAGRAM_BYTES))
        lost = sum(self._loses() for _ in range(datagrams))
        return lost == 0

    def _loses(self) -> bool:
        chance = self._leave_bad if self._bad else self._enter_bad
        if self._random.random() < chance:
            self._bad = not self._bad
        return self._bad


class Policy(StrEnum):
    """Which earlier frame a sender predicts from."""

    LAST_SENT = "last-sent"
    """The one before, as if it had arrived; after bad news the last one known to have."""
    LAST_ACKED = "last-acked"
    """The newest that is known to have arrived, however old."""
    RENDER_ONLY = "render-only"
    """None: every frame needs the field alone."""


@dataclass
class Feedback:
    """What a sender knows at ``frame / rate_hz`` seconds of the frames before ``frame``."""

    rate_hz: float
    rtt_s: float
    _good: list[bool] = field(default_factory=list)
    _chain_start: int = 0

    def sent(self, good: bool) -> None:
        """The next frame was sent, and was or was not decoded at the other end."""
        self._good.append(good)

    def known_good(self) -> int | None:
        """Return the newest frame known now to have been decoded."""
        return next((k for k in range(len(self._good) - 1, -1, -1) if self._acked(k)), None)

    def known_bad(self) -> list[int]:
        """Return the frames known now not to have been."""
        return [k for k in range(len(self._good)) if not self._good[k] and self._known(k + 1)]

    def base(self, policy: Policy) -> int | None:
        """Return the frame that the next one is predicted from."""
        if policy is Policy.RENDER_ONLY or not self._good:
            return None
        if policy is Policy.LAST_ACKED:
            return self.known_good()
        if any(k >= self._chain_start for k in self.known_bad()):
            self._chain_start = len(self._good)
            return self.known_good()
        return len(self._good) - 1

    def news_of_loss(self, since: int) -> bool:
        """Tell whether a frame from ``since`` on is known to be lost."""
        return any(k >= since for k in self.known_bad())

    def _acked(self, frame: int) -> bool:
        return self._good[frame] and self._known(frame)

    def _known(self, frame: int) -> bool:
        """A frame's answer has come back by the time the next one is made."""
        now_s = len(self._good) / self.rate_hz
        return frame / self.rate_hz + self.rtt_s <= now_s + 1e-9
