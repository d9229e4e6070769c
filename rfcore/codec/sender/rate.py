"""Rate control of one frame: predicts the size of a slice at each CRF, and codes until it fits.

The bits of a frame at every CRF are estimated from the residual of each 8x8 block by the formula
below. The coded size differs from the estimate by a factor that changes little between frames of
the same references. ``RateModel`` keeps that factor for each set of references. States are values:
``after`` returns the next.

A slice that is longer than a limit is coded again at a higher CRF until it fits (``code_to_fit``).
6 of CRF double the quantiser's step and, in pictures of a street, about halve the bits; in noise
they take one bit from each coefficient, which is far less. So the first step assumes a halving, and
the further ones take the slope of the step before.

``FrameCosts`` estimates the cost D + lambda R of a frame predicted from a picture. Coding with
every set of references and comparing would take a run of the coder each, and comparing bytes at
equal CRF would mislead, since a better reference also gives a better picture at the same CRF.
Instead each block's cost is estimated from the sum of absolute Hadamard coefficients (SATD) and the
sum of squares (SSD) of its difference from the picture, 0.1 ms a picture at 640x360::

    coded  = min(SSD, step**2 * 64 / 12) + lambda * bits,   bits = 1 + max(0, SATD / step - 16)
    copied = SSD                    (reference 0 only)
    step = 2**((CRF - 4) / 6),  lambda = 0.57 * 2**((CRF - 12) / 3)

16 is the quantiser's dead zone. The estimates of frames against their render are 0.9 to 1.4 times
what our coder takes, CRF 17 to 35.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rfcore.codec.h264.config import CRF_RANGE, check_crf
from rfcore.codec.references import Reference, References
from rfcore.codec.sender.picture_coder import CodedPicture
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native.warp import BLOCK_PX, BlockCosts, block_costs

BLOCK_BITS = 1.0
DEAD_ZONE_SATD = 16.0

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class RateDistortion:
    """The estimate at one quality: the quantiser's ``step`` and the price of a bit."""

    step: float
    bit_price: float

    @staticmethod
    def at(crf: float) -> RateDistortion:
        """Return the estimate for ``crf``; raise ``InvalidInput`` outside 1..51."""
        check_crf("crf", crf)
        return RateDistortion(2 ** ((crf - 4) / 6), 0.57 * 2 ** ((crf - 12) / 3))

    def bits(self, satd: F64) -> F64:
        """Return the bits of blocks that are coded."""
        return BLOCK_BITS + np.maximum(0.0, satd / self.step - DEAD_ZONE_SATD)

    def coded(self, satd: F64, ssd: F64) -> F64:
        """Return D + lambda R of blocks that are coded."""
        return np.minimum(ssd, BLOCK_PX**2 * self.step**2 / 12) + self.bit_price * self.bits(satd)

    def coded_or_copied(self, costs: BlockCosts) -> F64:
        """Return D + lambda R of blocks that may also be copied from reference 0."""
        satd, ssd = costs.satd.astype(np.float64), costs.ssd.astype(np.float64)
        return np.minimum(ssd, self.coded(satd, ssd))


class FrameCosts:
    """SATD and SSD of the blocks of one ``frame`` against pictures, computed once for each.

    A picture is known by its identity, not its samples: pass the same object again.
    """

    def __init__(self, frame: I420) -> None:
        self.frame = frame
        self._known: dict[int, tuple[I420, BlockCosts]] = {}

    def against(self, picture: I420) -> BlockCosts:
        """Return the costs of predicting the frame from ``picture``, of the frame's size."""
        if id(picture) not in self._known:
            # Keeping the picture keeps its id from being given to another one.
            self._known[id(picture)] = (picture, block_costs(self.frame.y, picture.y))
        return self._known[id(picture)][1]

    @cached_property
    def intra(self) -> BlockCosts:
        """The costs of predicting each block from its own mean, as without any reference."""
        return block_costs(self.frame.y, _at_block_means(self.frame.y))


def _at_block_means(luma: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return ``luma`` with each whole 8x8 block at its mean."""
    height, width = (side // BLOCK_PX * BLOCK_PX for side in luma.shape)
    blocks = luma[:height, :width].reshape(height // BLOCK_PX, BLOCK_PX, width)
    down = blocks.sum(axis=1, dtype=np.uint16).reshape(height // BLOCK_PX, -1, BLOCK_PX)
    means = np.rint(down.sum(axis=2, dtype=np.uint16) / BLOCK_PX**2).astype(np.uint8)
    flat = luma.copy()
    flat[:height, :width] = means.repeat(BLOCK_PX, axis=1).repeat(BLOCK_PX, axis=0)
    return flat


CRF_STEP = 1.0
LEAST_BITS = 400.0
"""Bits of a slice in which every block is copied from reference 0: a header, a run of skips, and an
allowance for what the estimate misses. With 200, the sample's drive with vehicles misses its
targets by 5.4 % in the median instead of 4.5."""
MEMORY = 0.5
"""Weight of the factor so far when a coded frame corrects it."""
CLIMB_CRF = 2.0
"""Most that the CRF may fall from one frame to the next, against flicker; it may rise at once."""
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BitsCurve:
    """Estimated ``bits`` [K], falling, at each of the ascending ``crfs`` [K]."""

    crfs: Array
    bits: Array

    def at(self, crf: float) -> float:
        """Return the bits at ``crf``, between entries on a straight line of their logarithm."""
        return float(2 ** np.interp(crf, self.crfs, np.log2(self.bits)))

    def crf_for(self, bits: float) -> float:
        """Return the lowest CRF that takes at most ``bits``, or the highest CRF if none does."""
        falling = np.log2(self.bits)
        if math.log2(max(bits, 1.0)) >= falling[0]:
            return float(self.crfs[0])
        wanted = np.interp(-math.log2(max(bits, 1.0)), -falling, self.crfs)
        return float(min(wanted, self.crfs[-1]))


def bits_curve(costs: FrameCosts, pictures: Sequence[I420], lowest_crf: float) -> BitsCurve:
    """Estimate a frame's bits when each block is predicted from the best of ``pictures``.

    Without pictures each block is predicted from its mean. Raises ``InvalidInput`` for a CRF
    outside 1..51.
    """
    check_crf("crf", lowest_crf)
    crfs = np.append(np.arange(lowest_crf, CRF_RANGE[1], CRF_STEP), CRF_RANGE[1])
    satd, ssd = _residual(costs, pictures)
    bits = np.array([_coded_bits(satd, ssd, crf) for crf in crfs])
    return BitsCurve(crfs, np.minimum.accumulate(LEAST_BITS + bits))


def _residual(costs: FrameCosts, pictures: Sequence[I420]) -> tuple[Array, Array]:
    """Return SATD and SSD [N] of the blocks, each against the best of ``pictures``."""
    if not pictures:
        return _around_means(costs.frame)
    found = [costs.against(picture) for picture in pictures]
    satd = np.minimum.reduce([blocks.satd for blocks in found])
    ssd = np.minimum.reduce([blocks.ssd for blocks in found])
    return satd.astype(np.float64).ravel(), ssd.astype(np.float64).ravel()


def _around_means(frame: I420) -> tuple[Array, Array]:
    height, width = (side // BLOCK_PX * BLOCK_PX for side in frame.y.shape)
    shape = (height // BLOCK_PX, BLOCK_PX, width // BLOCK_PX, BLOCK_PX)
    blocks = frame.y[:height, :width].reshape(shape)
    ssd = BLOCK_PX**2 * blocks.astype(np.float64).var(axis=(1, 3)).ravel()
    return np.sqrt(BLOCK_PX**2 * ssd), ssd


def _coded_bits(satd: Array, ssd: Array, crf: float) -> float:
    """Return the bits of the blocks that are not better copied from reference 0."""
    at_crf = RateDistortion.at(crf)
    return float(at_crf.bits(satd)[at_crf.coded(satd, ssd) < ssd].sum())


@dataclass(frozen=True)
class RateModel:
    """Model of the rate, learnt from coded frames.

    ``octaves``: log2 of coded over estimated bits, by references. ``crf`` is that of the
    last frame, which limits how fast quality rises; None before the first.
    """

    octaves: Mapping[References, float] = field(default_factory=dict)
    crf: float | None = None

    def bytes_at(self, crf: float, curve: BitsCurve, references: References) -> float:
        """Return the predicted size of a slice in bytes."""
        return curve.at(crf) / 8 * 2 ** self._octaves_of(references)

    def crf_for(self, size_bytes: float, curve: BitsCurve, references: References) -> float:
        """Return the CRF predicted to give ``size_bytes``, not below the curve's first."""
        wanted = curve.crf_for(8 * size_bytes / 2 ** self._octaves_of(references))
        slowest = wanted if self.crf is None else max(wanted, self.crf - CLIMB_CRF)
        return min(max(slowest, float(curve.crfs[0])), CRF_RANGE[1])

    def after(
        self, crf: float, curve: BitsCurve, references: References, coded_bytes: int
    ) -> RateModel:
        """Return the model once a frame took ``coded_bytes`` at ``crf``."""
        if coded_bytes < 1:
            raise InvalidInput("coded_bytes", f"{coded_bytes} must be at least 1")
        found = math.log2(8 * coded_bytes / curve.at(crf))
        known = self.octaves.get(references)
        octaves = found if known is None else MEMORY * known + (1 - MEMORY) * found
        return RateModel({**self.octaves, references: octaves}, crf)

    def _octaves_of(self, references: References) -> float:
        """Return the factor of ``references``, or of the most similar known set."""
        if not self.octaves:
            return 0.0
        like = max(self.octaves, key=lambda known: _likeness(known, references))
        return self.octaves[like]


def _likeness(known: References, wanted: References) -> tuple[bool, int]:
    shared: set[Reference] = set(known) & set(wanted)
    return known == wanted, 2 * len(shared) - len(known)


@dataclass(frozen=True)
class RateTarget:
    """The size to aim at, and the ``model`` that finds the CRF for it."""

    size_bytes: float
    model: RateModel = RateModel()

    def __post_init__(self) -> None:
        if not (math.isfinite(self.size_bytes) and self.size_bytes >= 1):
            raise InvalidInput("target.size_bytes", f"{self.size_bytes} must be at least 1 byte")


MAX_TRIES = 5
"""Most codings of one frame; the last is at the highest CRF."""
MIN_HALVING_CRF = 6.0
MAX_HALVING_CRF = 48.0
"""Fewest and most CRF steps that are assumed to halve a slice."""
AIM = 0.95
"""Share of the limit to aim at: aiming low costs few bits, a miss costs one more coding."""
Code = Callable[[float], CodedPicture]


@dataclass(frozen=True)
class FittedSlice:
    """A slice, the CRF it was coded at, and how many times the frame was coded."""

    coded: CodedPicture
    crf: float
    tries: int


def code_to_fit(code: Code, crf: float, limit_bytes: int) -> FittedSlice:
    """Return ``code`` at ``crf``, or at the lowest of a few higher ones that fits ``limit_bytes``.

    A slice that does not fit even at the highest CRF is returned all the same: check the length.
    """
    coded = code(crf)
    halving = MIN_HALVING_CRF
    for tries in range(1, MAX_TRIES):
        size_bytes = len(coded.payload)
        if size_bytes <= limit_bytes or crf == CRF_RANGE[1]:
            return FittedSlice(coded, crf, tries)
        last = tries == MAX_TRIES - 1
        excess = math.log2(size_bytes / (AIM * limit_bytes))
        following = CRF_RANGE[1] if last else min(crf + max(1.0, halving * excess), CRF_RANGE[1])
        shorter = code(following)
        halving = _halving_crf(following - crf, size_bytes, len(shorter.payload))
        coded, crf = shorter, following
    return FittedSlice(coded, crf, MAX_TRIES)


def _halving_crf(step: float, before_bytes: int, after_bytes: int) -> float:
    """Return how much CRF halves a slice, judging by one step."""
    octaves = math.log2(before_bytes / after_bytes)
    if octaves <= step / MAX_HALVING_CRF:
        return MAX_HALVING_CRF
    return max(MIN_HALVING_CRF, step / octaves)
