"""Splats on a grid: the integers that a compressed archive stores, and the splats they mean.

Every step is a power of two and every number fits float32's 24 bits, so decoding does not round and
gives the same bytes on every machine. (The three small components of a rotation are a float32
division by 127 each.)

* means: blocks of 256 splats in file order; in a block, ``2^e`` times (base + q), with e chosen so
  that the step is at most an eighth of the block's smaller widths;
* log scales, opacity logits, SH: one step each (``Steps``);
* rotations: the largest component becomes +1 and the others, divided by it, multiples of 1/127.
  Renderers normalise; the sign of a quaternion means nothing;
* colours, per SH coefficient: (r, g, b) as luma and two differences by the reversible transform
  YCoCg-R (Malvar and Sullivan, 2003), which is exact in whole numbers;
* a level's own scales and opacities: their difference to the full level's, in the same steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.field.integers import LIMIT, Integers
from rfcore.field.quality import LevelOfDetail
from rfcore.raster.gaussians import F32, Gaussians

BLOCK = 256
ROTATION_STEPS = 127
EXPONENTS = (-60, 60)


@dataclass(frozen=True)
class Steps:
    """Quantiser steps as powers of two: a step is ``2^-bits``. 0..16 each."""

    log_scales: int = 4
    opacity_logits: int = 3
    sh_dc: int = 5
    sh_rest: int = 5

    def __post_init__(self) -> None:
        for name, bits in vars(self).items():
            if type(bits) is not int or not 0 <= bits <= 16:
                raise InvalidInput(f"steps.{name}", f"{bits!r} is not a whole number 0..16")


@dataclass(frozen=True)
class Grain:
    """Precision at which a writer places splats; readers need not know it.

    A step of means is at most ``2^-means_bits`` of the block's smaller widths; rotations are
    multiples of ``rotation`` of their steps.
    """

    means_bits: int = 3
    rotation: int = 1

    def __post_init__(self) -> None:
        if not (0 <= self.means_bits <= 16 and 1 <= self.rotation <= ROTATION_STEPS):
            raise InvalidInput(
                "grain",
                f"{self.means_bits} bits and {self.rotation} steps are outside 0..16 and "
                f"1..{ROTATION_STEPS}",
            )


FINEST = Grain()


@dataclass(frozen=True)
class SplatNumbers:
    """The whole numbers of N splats in B blocks, int32.

    ``blocks`` [B, 4]: exponent and base; ``means`` [N, 3]; ``rotations`` [N, 4]: which component
    is largest, then the others in order; ``log_scales`` [N, 3]; ``opacity_logits`` [N, 1];
    ``sh`` [N, 3 K]: luma of every coefficient, then the two differences.
    """

    blocks: Integers
    means: Integers
    rotations: Integers
    log_scales: Integers
    opacity_logits: Integers
    sh: Integers


def numbers_of(gaussians: Gaussians, steps: Steps, grain: Grain = FINEST) -> SplatNumbers:
    """Return the nearest splats on the grid."""
    blocks, means = _means_numbers(gaussians, grain.means_bits)
    return SplatNumbers(
        blocks=blocks,
        means=means,
        rotations=_rotation_numbers(gaussians.quaternions, grain.rotation),
        log_scales=_rounded("log_scales", gaussians.log_scales, steps.log_scales),
        opacity_logits=_rounded(
            "opacity_logits", gaussians.opacity_logits[:, None], steps.opacity_logits
        ),
        sh=colour_numbers(gaussians.sh, steps),
    )


def gaussians_of(numbers: SplatNumbers, steps: Steps, means: F32 | None = None) -> Gaussians:
    """Return the splats of ``numbers``; raise ``InvalidInput`` for numbers that are none.

    ``means`` [N, 3]: instead of those that the blocks say.
    """
    return Gaussians(
        means=_means_of(numbers) if means is None else means,
        quaternions=_quaternions_of(numbers.rotations),
        log_scales=_scaled(numbers.log_scales, steps.log_scales),
        opacity_logits=_scaled(numbers.opacity_logits, steps.opacity_logits)[:, 0].copy(),
        sh=colours_of(numbers.sh, steps),
    )


def level_numbers_of(level: LevelOfDetail, numbers: SplatNumbers, steps: Steps) -> Integers:
    """Return a level's [K, 4]: log scales and opacity less those of the full level."""
    kept = len(level.opacity_logits)
    scales = _rounded("log_scales", level.log_scales, steps.log_scales) - numbers.log_scales[:kept]
    opacity = _rounded("opacity_logits", level.opacity_logits[:, None], steps.opacity_logits)
    return np.hstack([scales, opacity - numbers.opacity_logits[:kept]])


def level_of(own: Integers, numbers: SplatNumbers, steps: Steps) -> LevelOfDetail:
    """Return the level of ``own`` [K, 4]."""
    kept = len(own)
    opacity = own[:, 3:] + numbers.opacity_logits[:kept]
    return LevelOfDetail(
        log_scales=_scaled(own[:, :3] + numbers.log_scales[:kept], steps.log_scales),
        opacity_logits=_scaled(opacity, steps.opacity_logits)[:, 0].copy(),
    )


def _rounded(name: str, values: F32, bits: int | NDArray[np.int64]) -> Integers:
    """Return values in steps of 2^-bits; raise ``InvalidInput`` for one that is too large."""
    scaled = np.rint(np.ldexp(values.astype(np.float64), bits))
    if scaled.size and np.abs(scaled).max() >= LIMIT // 4:
        raise InvalidInput(
            f"gaussians.{name}",
            f"{np.abs(values).max():g} is too large for a compressed archive; save it "
            "uncompressed (rfedge train --plain, rfedge field --raw)",
        )
    return scaled.astype(np.int32)


def _scaled(numbers: Integers, bits: int) -> F32:
    return np.ascontiguousarray(np.ldexp(numbers.astype(np.float64), -bits), dtype=np.float32)


def _means_numbers(gaussians: Gaussians, means_bits: int) -> tuple[Integers, Integers]:
    n = len(gaussians)
    starts = np.arange(0, n, BLOCK)
    exponents = np.array(
        [_exponent(gaussians, start, means_bits) for start in range(0, n, BLOCK)], np.int32
    )
    steps = np.ldexp(1.0, np.repeat(exponents, BLOCK)[:n])
    whole = np.rint(gaussians.means.astype(np.float64) / steps[:, None]).astype(np.int32)
    bases = np.minimum.reduceat(whole, starts, axis=0) if n else np.zeros((0, 3), np.int32)
    blocks = np.hstack([exponents[:, None], bases])
    return blocks, whole - np.repeat(bases, BLOCK, axis=0)[:n]


def _exponent(gaussians: Gaussians, start: int, means_bits: int) -> int:
    """Return e of a block: a fine enough step, no finer than float32 is where the block lies."""
    part = slice(start, start + BLOCK)
    widths = np.sort(gaussians.log_scales[part].astype(np.float64), axis=1)[:, 1]
    wanted = float(np.quantile(widths, 0.1)) / np.log(2) - means_bits
    furthest = float(np.abs(gaussians.means[part]).max())
    finest = np.ceil(np.log2(max(furthest, 2.0**-36))) - 23
    return int(np.clip(max(np.floor(wanted), finest), *EXPONENTS))


def _means_of(numbers: SplatNumbers) -> F32:
    return means_of_steps(*placed(numbers))


def means_steps(means: F32, exponents: Integers) -> NDArray[np.float64]:
    """Return ``means`` [N, 3] in steps of ``2^exponents`` [N], whole numbers."""
    return np.rint(np.ldexp(means.astype(np.float64), -exponents[:, None]))


def means_of_steps(steps: Integers, exponents: Integers) -> F32:
    """Return the means [N, 3] of so many steps of ``2^exponents`` [N]."""
    return np.ascontiguousarray(np.ldexp(steps.astype(np.float64), exponents[:, None]), np.float32)


def placed(numbers: SplatNumbers) -> tuple[Integers, Integers]:
    """Return the means of ``numbers`` as steps [N, 3], and the exponents [N] of those."""
    n = len(numbers.means)
    blocks = np.repeat(numbers.blocks, BLOCK, axis=0)[:n]
    return blocks[:, 1:] + numbers.means, np.clip(blocks[:, 0], *EXPONENTS)


def _rotation_numbers(quaternions: F32, multiple: int) -> Integers:
    largest = np.abs(quaternions.astype(np.float64)).argmax(axis=1)
    most = ROTATION_STEPS // multiple
    steps = np.clip(np.rint(_beside(quaternions, largest) / multiple), -most, most) * multiple
    return np.hstack([largest[:, None], steps]).astype(np.int32)


def rotations_like(quaternions: F32, like: Integers) -> Integers:
    """Return the nearest numbers [N, 4], with the component that is largest in ``like`` [N, 4], the
    numbers of nearby rotations, as long as it is not small."""
    size = np.abs(quaternions.astype(np.float64))
    of_like = np.take_along_axis(size, like[:, :1].astype(np.intp), axis=1)[:, 0]
    keeps = of_like >= 0.7 * size.max(axis=1, initial=0.0)
    largest = np.where(keeps, like[:, 0], size.argmax(axis=1)).astype(np.intp)
    steps = np.rint(_beside(quaternions, largest))
    return np.hstack([largest[:, None], steps]).astype(np.int32)


def _beside(quaternions: F32, largest: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return the three components that are not ``largest`` [N] in rotation steps of that one."""
    q = quaternions.astype(np.float64)
    divisor = np.take_along_axis(q, largest[:, None], axis=1)
    unit = np.where(divisor == 0, 0.0, q / np.where(divisor == 0, 1, divisor))
    return np.take_along_axis(unit, _others(largest), axis=1) * ROTATION_STEPS


def _quaternions_of(rotations: Integers) -> F32:
    largest = rotations[:, 0]
    if ((largest < 0) | (largest > 3)).any():
        raise InvalidInput("rotations", "a largest component is none of 0..3")
    q = np.empty((len(largest), 4), np.float32)
    others = rotations[:, 1:].astype(np.float32) / np.float32(ROTATION_STEPS)
    np.put_along_axis(q, largest[:, None], np.float32(1), axis=1)
    np.put_along_axis(q, _others(largest), others, axis=1)
    return q


def _others(largest: NDArray[np.signedinteger[Any]]) -> NDArray[np.intp]:
    """Return the three components [N, 3] that are not ``largest`` [N], in order."""
    rest = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
    return np.asarray(rest[largest], np.intp)


def colour_numbers(sh: F32, steps: Steps) -> Integers:
    """Return the nearest numbers [N, 3 K] of colours [N, K, 3]."""
    bits = _bits_of_bands(sh.shape[1], steps)
    q = _rounded("sh", sh, bits[:, None])
    r, g, b = q[..., 0], q[..., 1], q[..., 2]
    orange = r - b
    middle = b + (orange >> 1)
    green = g - middle
    return np.hstack([middle + (green >> 1), orange, green])


def colours_of(numbers: Integers, steps: Steps) -> F32:
    """Return the colours [N, K, 3] of ``numbers`` [N, 3 K]."""
    coefficients = numbers.shape[1] // 3
    luma, orange, green = (numbers[:, i * coefficients :][:, :coefficients] for i in range(3))
    middle = luma - (green >> 1)
    b = middle - (orange >> 1)
    q = np.stack([b + orange, green + middle, b], axis=2).astype(np.float64)
    bits = _bits_of_bands(coefficients, steps)
    return np.ascontiguousarray(np.ldexp(q, -bits[:, None]), dtype=np.float32)


def _bits_of_bands(coefficients: int, steps: Steps) -> NDArray[np.int64]:
    return np.array([steps.sh_dc] + [steps.sh_rest] * (coefficients - 1))
