"""The slice coder's kernels on another architecture: the same bytes, NEON and scalar."""

import struct

import numpy as np
import pytest

from rfcore.codec.h264.slice_coder import Effort
from rfcore.image import I420
from rfcore.native import _native
from rfcore.native.backend import available_isas

pytestmark = [pytest.mark.nightly, pytest.mark.slow, pytest.mark.timeout(900)]


SIZE = WIDTH, HEIGHT = 83, 45
MACROBLOCKS = 6 * 3
SQUARED = 0.6 * 2.0 ** ((np.arange(52) - 12) / 3)
LAMBDA_Q8 = np.rint(256 * SQUARED).astype(np.uint32)
MOTION_Q8 = np.rint(256 * 1.3 * np.sqrt(SQUARED)).astype(np.uint32)


def pictures(count: int) -> list[I420]:
    """A frame of blocks and noise, and references that are shifted against it."""
    rng = np.random.default_rng(1)
    blocks = np.kron(rng.integers(40, 200, (12, 20)), np.ones((7, 7), np.int64))
    made = []
    for shift in range(count):
        planes = []
        for step in (1, 2, 2):
            shape = (-(-HEIGHT // step), -(-WIDTH // step))
            part = np.roll(blocks, (shift, 2 * shift), (0, 1))[: shape[0], : shape[1]]
            planes.append((part + rng.integers(-4, 5, shape)).astype(np.uint8))
        made.append(I420(*planes))
    return made


@pytest.mark.parametrize("isa", ["neon", "scalar"])
@pytest.mark.parametrize(("references", "qp"), [(3, 20), (1, 36), (0, 28)])
@pytest.mark.parametrize("effort", Effort)
def test_aarch64_codes_a_picture_to_the_same_bytes(
    emulated, first_difference, effort, references, qp, isa
):
    frame, *others = pictures(1 + references)
    quantisers = (qp + np.arange(MACROBLOCKS) % 3).astype(np.int8)
    reconstruction = I420(*(np.empty_like(plane) for plane in frame.planes))
    data = _native.SliceCoder(WIDTH, HEIGHT, available_isas()[0]).encode(
        frame.planes,
        [other.planes for other in others],
        qp,
        quantisers,
        np.full(MACROBLOCKS, -1, np.int8),
        LAMBDA_Q8,
        MOTION_Q8,
        _native.SliceEffort(**effort.value._asdict()),
        True,
        252,
        reconstruction.planes,
        np.empty(MACROBLOCKS, np.int8),
    )
    scene = struct.pack("<13i", *SIZE, references, qp, *effort.value, True)
    scene += LAMBDA_Q8.tobytes() + MOTION_Q8.tobytes() + quantisers.tobytes()
    scene += b"".join(picture.packed() for picture in (frame, *others))
    there = emulated("exactness_slices", isa, 1, scene)
    assert first_difference(there, data + reconstruction.packed()) is None
