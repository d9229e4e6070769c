"""A light as it is written: what is read is what was written, in a kilobyte, or refused."""

import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rfcore.codec.photometric import LIGHT_STEPS, MOST_LIGHT_BYTES, lit_by, sent_light
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native.warp import apply_light, light_shape, solve_light

SIZE_PX = (200, 130)


def street(size_px: tuple[int, int], seed: int) -> I420:
    rng, (width, height) = np.random.default_rng(seed), size_px
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    luma = 110 + 60 * np.sin(x / 9) * np.cos(y / 7) + rng.normal(0, 8, x.shape)
    half = ((height + 1) // 2, (width + 1) // 2)
    chroma = [rng.integers(110, 146, half, dtype=np.uint8) for _ in range(2)]
    return I420(np.clip(luma, 1, 255).astype(np.uint8), *chroma)


def lamplit(picture: I420, darkest: float) -> I420:
    ramp = np.linspace(1.1, darkest, picture.size_px[0])[None, :]
    luma = np.clip((picture.y - 16.0) * ramp + 16, 1, 255).astype(np.uint8)
    return I420(luma, picture.u + np.uint8(6), picture.v - np.uint8(4))


def error(a: I420, b: I420) -> float:
    return float(((a.y.astype(float) - b.y) ** 2).mean())


def written(data: bytes, step: int = 4) -> bytes:
    deflate = zlib.compressobj(9, zlib.DEFLATED, -15)
    return bytes((step,)) + deflate.compress(data) + deflate.flush()


@settings(max_examples=40, deadline=None)
@given(
    size_px=st.tuples(st.integers(1, 260), st.integers(1, 200)),
    seed=st.integers(0, 2**32 - 1),
    darkest=st.floats(0.0, 1.2),
)
def test_what_is_read_is_what_was_written(size_px, seed, darkest):
    render = street(size_px, seed)
    frame = lamplit(render, darkest)
    light = sent_light(frame, render)
    assert 1 < len(light) <= MOST_LIGHT_BYTES
    unit = 256 * light[0]
    changes: NDArray[np.int32] = np.rint(solve_light(frame, render) / unit + 1e-9).astype(np.int32)
    found, expected = lit_by(render, light), apply_light(render, changes * unit)
    for ours, theirs in zip(found.planes, expected.planes, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_it_says_most_of_what_another_light_changes():
    render = street(SIZE_PX, 1)
    frame = lamplit(render, 0.4)
    light = sent_light(frame, render)
    assert light[0] == LIGHT_STEPS[0]
    assert error(lit_by(render, light), frame) < 0.1 * error(render, frame)


def test_a_light_of_a_large_picture_is_coarser_or_none():
    size_px = (1920, 1080)
    render = street(size_px, 1)
    light = sent_light(lamplit(render, 0.4), render)
    assert len(light) <= MOST_LIGHT_BYTES
    noise = street(size_px, 2)
    blocks = np.random.default_rng(3).integers(0, 2, (17, 30)).repeat(64, 0).repeat(64, 1)
    torn = I420(np.where(blocks[:1080] == 1, 255 - noise.y, noise.y), noise.u, noise.v)
    assert sent_light(torn, render) == b"" or light[0] > LIGHT_STEPS[0]


COUNT = int(np.prod(light_shape(SIZE_PX)))


@pytest.mark.parametrize(
    ("light", "problem"),
    [
        (b"", "0 bytes"),
        (b"\x04", "1 bytes"),
        (bytes(MOST_LIGHT_BYTES + 1), "1025 bytes"),
        (written(bytes(COUNT), step=5), "step of 5 levels"),
        (b"\x04" + b"\xff" * 9, "not deflated"),
        (written(bytes(COUNT - 1)), f"does not hold {COUNT} numbers"),
        (written(bytes(COUNT + 1)), f"does not hold {COUNT} numbers"),
        (written(bytes(1 << 19)), f"does not hold {COUNT} numbers"),
        (written(bytes(COUNT))[:-1], f"does not hold {COUNT} numbers"),
        (written(bytes(COUNT)) + b"\x00", f"does not hold {COUNT} numbers"),
        (written(b"\x7f" + bytes(COUNT - 1)), "within 2"),
    ],
    ids=[
        "nothing",
        "step",
        "long",
        "odd step",
        "noise",
        "short",
        "over",
        "bomb",
        "cut",
        "tail",
        "far",
    ],
)
def test_what_is_no_light_is_refused(light, problem):
    render = street(SIZE_PX, 1)
    for plane in lit_by(render, written(bytes(COUNT))).planes:
        assert plane.any()
    with pytest.raises(InvalidInput, match=f"light: .*{problem}"):
        lit_by(render, light)
