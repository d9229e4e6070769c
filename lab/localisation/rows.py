"""The rows of a result of kind ``localise``."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LocaliseRow:
    """A drive's attempts at one start error; errors are over all poses that tries brought."""

    drive: str
    start_m: float
    start_deg: float
    tries: int
    false_starts: int
    localised_percent: float
    median_m: float | None
    median_deg: float | None
    p95_m: float | None
    false_percent: float
    """Poses that came back and are wrong, of all tries and false starts."""
    localise_ms: float
    """Median over the tries, features of the picture included; false starts take longer."""
    localise_cpu_ms: float | None
    """The same in processor time, which other work on the machine changes less."""
    track_cpu_ms: float | None = None
    """Median processor time of tracking a picture with all its renders, if it was measured."""
    render_cpu_ms: float | None = None
    """Median processor time of a render alone in the same run."""
    false_cpu_ms: float | None = None
    """Median processor time of a false start."""


@dataclass(frozen=True)
class BitsRow:
    """The bits that a sensor's errors cost on one drive."""

    drive: str
    pose_error: str
    bits_percent: float
    psnr_db: float
    """Luma PSNR of the drive at found poses, mean over the qualities coded."""
    tracked_percent: float
    localise_cpu_ms: float | None
    """Median processor time of a search."""
    track_cpu_ms: float
    """Median time of the tracker with all its renders, of the frames without a search."""
    render_cpu_ms: float
    """Median time of a render in the same run."""
