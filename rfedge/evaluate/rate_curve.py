"""Rate-distortion curves and what lies between two of them.

The distortion of a clip is the PSNR of the mean squared error over its frames (not the mean of
PSNRs, which lets one easy frame outweigh a hard one). Between points, log(rate) is interpolated
over decibels by a monotone cubic (PCHIP; Bjontegaard, VCEG-M33, with the interpolation of
JVET-M0166). There is no extrapolation: a window that a curve does not span is an error. A curve
over another ``Quality`` has its distance from equal pictures, as -10 log10, for decibels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.extras import needs
from rfedge.evaluate.clips import CodedClip

with needs("eval"):
    from scipy.interpolate import PchipInterpolator

MIN_POINTS = 6
QUICK_POINTS = 4
"""Fewest points of a curve: of a figure to report, and of a quick one."""
PEAK = 255.0
Window = tuple[float, float]
"""Lowest and highest quality, in decibels."""


@dataclass(frozen=True)
class RateCurve:
    """Points of a rate-distortion curve, ascending: ``bytes_per_frame`` over ``psnr_db``, [N].

    ``psnr_db`` is another quality in decibels where a curve is over that.
    """

    psnr_db: NDArray[np.float64]
    bytes_per_frame: NDArray[np.float64]
    least_points: int = MIN_POINTS

    def __post_init__(self) -> None:
        count, least = len(self.psnr_db), self.least_points
        if count < least:
            raise InvalidInput("curve", f"{count} points, at least {least} needed")
        if not np.isfinite(self.psnr_db).all() or (self.bytes_per_frame <= 0).any():
            raise InvalidInput("curve", "qualities must be finite and rates above 0")
        if (np.diff(self.psnr_db) <= 0).any():
            raise InvalidInput("curve", f"qualities {self.psnr_db.round(2)} must differ")

    def bytes_at(self, psnr_db: float) -> float:
        """Return the rate at a quality; raise ``InvalidInput`` outside the curve."""
        self.check_spans((psnr_db, psnr_db))
        return math.exp(float(self._log_rate(psnr_db)))

    def mean_log_bytes(self, window_db: Window) -> float:
        """Return the mean of log(rate) over a window of qualities the curve spans."""
        low, high = window_db
        self.check_spans(window_db)
        return float(self._log_rate.integrate(low, high)) / (high - low)

    def spans(self, window_db: Window) -> bool:
        """Tell whether the curve covers all of ``window_db``."""
        low, high = window_db
        return bool(self.psnr_db[0] <= low and high <= self.psnr_db[-1])

    def check_spans(self, window_db: Window) -> None:
        """Raise ``InvalidInput`` unless the curve covers all of ``window_db``."""
        low, high = window_db
        if not self.spans(window_db):
            raise InvalidInput(
                "window_db",
                f"{low:g}..{high:g} dB is not within the curve's {self.psnr_db[0]:.2f}.."
                f"{self.psnr_db[-1]:.2f} dB; code at more operating points",
            )

    @property
    def _log_rate(self) -> PchipInterpolator:
        return PchipInterpolator(self.psnr_db, np.log(self.bytes_per_frame))


def rate_curve(
    clips: Sequence[CodedClip],
    frames: NDArray[np.intp] | slice,
    least_points: int = MIN_POINTS,
) -> RateCurve:
    """Return the curve of one clip coded at several points, over the chosen ``frames``.

    Points of one quality, as of a good field at rates where nothing is sent, count once, at the
    fewest bytes. Raises ``InvalidInput`` when there are too few points.
    """
    mse = np.array([clip.luma_mse[frames].mean() for clip in clips])
    with np.errstate(divide="ignore"):
        psnr_db = 10 * np.log10(PEAK * PEAK / mse)
    return _curve(psnr_db, clips, frames, least_points)


@dataclass(frozen=True)
class Quality:
    """A quality of pictures beside the PSNR: its name in results and ``CodedClip.values``, its
    value for equal pictures, and the window of means over the frames that is compared over."""

    name: str
    title: str
    of_equal: float
    window: tuple[float, float]
    """Its worst and its best mean."""

    def db(self, mean: float) -> float:
        """Return a mean in decibels: an SSIM of 0.9 and an LPIPS of 0.1 are 10 dB."""
        return -10 * math.log10(abs(self.of_equal - mean))

    @property
    def window_db(self) -> Window:
        """The window in decibels."""
        worst, best = self.window
        return self.db(worst), self.db(best)

    def curve(
        self,
        clips: Sequence[CodedClip],
        frames: NDArray[np.intp] | slice,
        least_points: int = MIN_POINTS,
    ) -> RateCurve:
        """Return the curve over the mean of the frames, in decibels; raises as ``rate_curve``."""
        qualities = [self.db(float(clip.values(self.name)[frames].mean())) for clip in clips]
        return _curve(np.array(qualities), clips, frames, least_points)


SSIM = Quality("ssim", "SSIM", 1.0, (0.88, 0.92))
LPIPS = Quality("lpips", "LPIPS (AlexNet)", 0.0, (0.15, 0.1))
"""Windows about where the streets at hand have 33 to 35 dB."""


def _curve(
    quality_db: NDArray[np.float64],
    clips: Sequence[CodedClip],
    frames: NDArray[np.intp] | slice,
    least_points: int = MIN_POINTS,
) -> RateCurve:
    rates = np.array([clip.frame_bytes[frames].mean() for clip in clips])
    order = np.lexsort((rates, quality_db))
    qualities, first = np.unique(quality_db[order], return_index=True)
    return RateCurve(qualities, rates[order][first], least_points)


def bd_rate_percent(anchor: RateCurve, test: RateCurve, window_db: Window) -> float:
    """Return by how many percent ``test`` needs more bytes than ``anchor`` at equal quality.

    Negative is a saving. Raises ``InvalidInput`` unless both curves span the window.
    """
    difference = test.mean_log_bytes(window_db) - anchor.mean_log_bytes(window_db)
    return 100 * math.expm1(difference)


def bd_rate_interval(
    anchor: Sequence[CodedClip],
    test: Sequence[CodedClip],
    window_db: Window,
    rng: np.random.Generator,
    *,
    first: int = 1,
    repetitions: int = 400,
    least_share: float = 1.0,
    curve: Callable[[Sequence[CodedClip], NDArray[np.intp]], RateCurve] = rate_curve,
) -> tuple[float, float]:
    """Return the 95 % interval of the BD-rate from resampled blocks of frames.

    The moving-block bootstrap of Kuensch (1989), percentiles: neighbouring frames resemble each
    other, so blocks of sqrt(N) consecutive frames are drawn, the same for both, from frame
    ``first`` on. It says how far the figure hangs on which part of the street the clip happens to
    show; another street may lie outside. Draws whose curves leave the window are compared over what
    both reach of it, and count as no figure where that is less than ``least_share`` of it: an
    encoder at its coarsest may just reach the window with the whole clip. If these are more than
    5 %, ``InvalidInput`` is raised.
    """
    count = len(anchor[0].frame_bytes)
    figures = []
    for _ in range(repetitions):
        frames = drawn_blocks(first, count, rng)
        try:
            curves = curve(anchor, frames), curve(test, frames)
            figures.append(bd_rate_percent(*curves, _reached(curves, window_db, least_share)))
        except InvalidInput:
            continue
    if len(figures) < 0.95 * repetitions:
        raise InvalidInput(
            "window_db",
            f"only {len(figures)} of {repetitions} resampled clips span {window_db} dB",
        )
    low, high = np.percentile(figures, (2.5, 97.5))
    return float(low), float(high)


def _reached(curves: Sequence[RateCurve], window_db: Window, least_share: float) -> Window:
    """Return what all curves reach of a window; raise ``InvalidInput`` below a share of it."""
    low_db = max(window_db[0], *(curve.psnr_db[0] for curve in curves))
    high_db = min(window_db[1], *(curve.psnr_db[-1] for curve in curves))
    if high_db - low_db < least_share * (window_db[1] - window_db[0]):
        raise InvalidInput("window_db", f"only {low_db:.2f}..{high_db:.2f} dB of it are reached")
    return (low_db, high_db)


def drawn_blocks(first: int, count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return as many frames as there are from ``first`` on, drawn in blocks of their root."""
    wanted = count - first
    length = max(1, round(math.sqrt(wanted)))
    starts = rng.integers(first, count - length + 1, -(-wanted // length))
    return (starts[:, None] + np.arange(length)).ravel()[:wanted]
