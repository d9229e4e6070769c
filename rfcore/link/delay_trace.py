"""A recorded delay, in the format of the CICV5G recordings (doi:10.5281/zenodo.17475688).

A header line, then columns parted by blanks: time of sending and of receiving in ms, delay in ms,
and what else was recorded. The delay was taken from vehicle to network to vehicle, so a direction
gets a ``share`` of it, one half unless said otherwise. It holds until the next sample; after the
last one the recording begins again.

In a profile: ``[uplink.delay_trace]`` with ``file`` and ``share``. It adds to ``delay_ms``.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random

from rfcore.errors import InvalidData
from rfcore.link.plan import Parts
from rfcore.link.profile import MAX_DELAY_S
from rfcore.tables import Range, Table

__all__ = ["DelayTrace", "parse", "read_cicv5g"]

COLUMNS = ("pub_time(ms)", "sub_time(ms)", "delay(ms)")


@dataclass(frozen=True)
class DelayTrace:
    """``delays_s[i]`` from ``times_s[i]`` on; ``times_s`` begins at 0 and ascends.

    Raises ``InvalidData`` for samples that cannot be a recording.
    """

    times_s: Sequence[float]
    delays_s: Sequence[float]
    name: str = "delay_trace"

    def __post_init__(self) -> None:
        if len(self.times_s) != len(self.delays_s) or len(self.times_s) < 2:
            raise InvalidData(f"{len(self.times_s)} samples of delay, expected 2 or more")
        if self.times_s[0] != 0.0 or any(
            not a <= b for a, b in zip(self.times_s, self.times_s[1:], strict=False)
        ):
            raise InvalidData("the times of a delay trace must begin at 0 and ascend")
        if self.times_s[-1] <= 0.0:
            raise InvalidData("every sample is at 0 s; a recording has to last some time")
        for delay_s in self.delays_s:
            if not 0.0 <= delay_s <= MAX_DELAY_S:
                raise InvalidData(f"a delay of {delay_s} s is outside 0..{MAX_DELAY_S:g} s")

    @property
    def period_s(self) -> float:
        """Seconds until the recording begins again: its length and one mean interval."""
        return self.times_s[-1] * len(self.times_s) / (len(self.times_s) - 1)

    def delay_s(self, at_s: float) -> float:
        """Return the delay at ``at_s`` seconds after the beginning."""
        index = bisect_right(self.times_s, math.fmod(max(0.0, at_s), self.period_s)) - 1
        return self.delays_s[index]

    def apply(self, parts: Parts, random: Random) -> Parts:  # noqa: ARG002
        """Add this delay."""
        return parts.with_delay(self)


def read_cicv5g(path: Path, share: float = 0.5) -> DelayTrace:
    """Read a recording; raise ``InvalidData`` naming the line that is wrong."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    if not lines or tuple(lines[0].split()[:3]) != COLUMNS:
        raise InvalidData(f"{path}: line 1 must begin with {' '.join(COLUMNS)}")
    samples = [
        _sample(path, number, line) for number, line in enumerate(lines[1:], start=2) if line
    ]
    begin_ms = samples[0][0] if samples else 0.0
    try:
        return DelayTrace(
            tuple((sent_ms - begin_ms) / 1e3 for sent_ms, _ in samples),
            tuple(share * delay_ms / 1e3 for _, delay_ms in samples),
        )
    except InvalidData as error:
        raise InvalidData(f"{path}: {error}") from error


def _sample(path: Path, number: int, line: str) -> tuple[float, float]:
    try:
        sent, _, delay = (float(word) for word in line.split()[:3])
    except ValueError as error:
        raise InvalidData(f"{path}: line {number} has no three numbers in front") from error
    if not (math.isfinite(sent) and math.isfinite(delay)):
        raise InvalidData(f"{path}: line {number}: {line[:40]!r} is not finite")
    return sent, delay


def parse(table: Table, folder: Path) -> DelayTrace:
    """Return the impairment of a profile's table; its file is looked for in ``folder``."""
    trace = read_cicv5g(folder / table.text("file"), table.number("share", Range(0.0, 1.0), 0.5))
    table.finish()
    return trace
