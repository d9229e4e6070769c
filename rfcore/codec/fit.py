"""A slice that is no longer than a limit: coded again at a higher CRF until it fits.

6 of CRF double the quantiser's step and, in pictures of a street, about halve the bits; in noise
they take one bit from each coefficient, which is far less. So the first step assumes a halving, and
the further ones what the steps before have brought.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from rfcore.codec.config import CRF_RANGE

__all__ = ["MAX_TRIES", "FittedSlice", "code_to_fit"]

MAX_TRIES = 5
"""Codings of one frame; the last is at the highest CRF there is."""

HALVING_CRF = 6.0
SLOWEST_CRF = 48.0
"""CRF steps that are taken to halve a slice, at the least and at the most."""

AIM = 0.95
"""Share of the limit that a step aims at: a little less costs little, a miss costs a coding."""

Code = Callable[[float], bytes]


@dataclass(frozen=True)
class FittedSlice:
    """A slice, the CRF it was coded at, and how often the frame was coded for it."""

    payload: bytes
    crf: float
    tries: int


def code_to_fit(code: Code, crf: float, limit_bytes: int) -> FittedSlice:
    """Return ``code`` at ``crf``, or at the lowest of a few higher ones that fits ``limit_bytes``.

    What does not fit at the highest CRF is returned as it is: check the length.
    """
    payload = code(crf)
    halving = HALVING_CRF
    for tries in range(1, MAX_TRIES):
        if len(payload) <= limit_bytes or crf == CRF_RANGE[1]:
            return FittedSlice(payload, crf, tries)
        last = tries == MAX_TRIES - 1
        excess = math.log2(len(payload) / (AIM * limit_bytes))
        following = CRF_RANGE[1] if last else min(crf + max(1.0, halving * excess), CRF_RANGE[1])
        shorter = code(following)
        halving = _halving_crf(following - crf, len(payload), len(shorter))
        payload, crf = shorter, following
    return FittedSlice(payload, crf, MAX_TRIES)


def _halving_crf(step: float, before_bytes: int, after_bytes: int) -> float:
    """Return how much CRF halves a slice, judging by one step."""
    octaves = math.log2(before_bytes / after_bytes)
    if octaves <= step / SLOWEST_CRF:
        return SLOWEST_CRF
    return max(HALVING_CRF, step / octaves)
