"""What all kernels have in common: the instruction sets of this machine, and limits."""

from __future__ import annotations

import numpy as np

from rfcore.errors import BackendUnavailable, InvalidInput
from rfcore.native import _native

__all__ = ["FLOAT32_MAX", "MAX_THREADS", "available_isas", "check_backend"]

MAX_THREADS = 256
FLOAT32_MAX = float(np.finfo(np.float32).max)


def available_isas() -> tuple[str, ...]:
    """Return the instruction sets this machine can run, best first, ``scalar`` last."""
    return tuple(_native.available_isas())


def check_backend(threads: int, isa: str | None) -> str:
    """Return the instruction set to use.

    Raises ``BackendUnavailable`` for one this machine lacks, ``InvalidInput`` for a number of
    threads outside 1..256.
    """
    if not 1 <= threads <= MAX_THREADS:
        raise InvalidInput("threads", f"{threads} is outside 1..{MAX_THREADS}")
    present = available_isas()
    if isa is not None and isa not in present:
        raise BackendUnavailable(
            f"instruction set {isa!r} is not available here; choose from {', '.join(present)}"
        )
    return present[0] if isa is None else isa
