"""The rate a link needs so that frames arrive in time, by the link model of the paper.

Cameras of a vehicle take their pictures at the same instant and share the link first come, first
served: a frame of b bytes occupies it for 8 b / rate (the delay tau of NetworkTX), behind those
that came before. The sizes of frames are those of the measured clip, again and again.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle, islice

from rfcore.errors import InvalidInput

__all__ = ["needed_bps", "share_in_time"]

INSTANTS = 400
"""How long the link is watched, in pictures of a camera."""
PRECISION = 1.005
MOST_BPS = 1e12


def share_in_time(
    frame_bytes: Sequence[float], cameras: int, hz: float, rate_bps: float, within_s: float
) -> float:
    """Return the share of frames that leave a link of ``rate_bps`` ``within_s`` of their start."""
    free_s, in_time = 0.0, 0
    for instant, size_bytes in enumerate(islice(cycle(frame_bytes), INSTANTS)):
        start_s = instant / hz
        free_s = max(free_s, start_s)
        for _ in range(cameras):
            free_s += 8 * size_bytes / rate_bps
            in_time += free_s - start_s <= within_s
    return in_time / (INSTANTS * cameras)


def needed_bps(
    frame_bytes: Sequence[float], cameras: int, hz: float, within_s: float, share: float
) -> float:
    """Return the least rate, within 0.5 %, at which ``share`` of the frames are in time.

    Never less than the mean rate, which any link has to carry. Raises ``InvalidInput`` when there
    is no time left for sending.
    """
    if within_s <= 0:
        raise InvalidInput("delay-ms", f"no time is left for sending ({1e3 * within_s:.0f} ms)")

    def enough(rate_bps: float) -> bool:
        return share_in_time(frame_bytes, cameras, hz, rate_bps, within_s) >= share

    low = 8 * hz * cameras * sum(frame_bytes) / len(frame_bytes)
    if enough(low):
        return low
    high = low
    while not enough(high) and high < MOST_BPS:
        low, high = high, 2 * high
    while high > PRECISION * low:
        middle = (low * high) ** 0.5
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high
