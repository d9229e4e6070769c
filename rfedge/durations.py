"""Durations as people say them."""

__all__ = ["time_text"]


def time_text(seconds: float) -> str:
    """Return a duration in the unit that fits it."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
