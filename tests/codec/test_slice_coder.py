"""The slice coder: decoders agree with it, and it writes the same bytes everywhere.

FFmpeg is the oracle: what it decodes is the coder's own reconstruction, sample for sample, with the
deblocking filter on or off.
"""

import hashlib
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rfcore.codec.h264.bitstream import join_nals, stream_header
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.h264.ffmpeg import H264Decoder
from rfcore.codec.h264.slice_coder import (
    LAMBDA_FACTOR,
    Effort,
    MacroblockMode,
    OwnSlice,
    SliceCoder,
)
from rfcore.codec.h264.splice import SpliceDecoder
from rfcore.errors import BackendUnavailable, InvalidInput
from rfcore.image import I420
from rfcore.native.backend import available_isas

Size = tuple[int, int]

ODD, NARROW, WIDE, TALL = (35, 33), (16, 48), (100, 52), (150, 200)
KINDS = ("near", "noise", "unrelated", "zoomed")


@cache
def coder_of(size: Size, isa: str | None = None) -> SliceCoder:
    return SliceCoder(CodecConfig(*size), isa=isa)


def macroblocks(size: Size) -> int:
    return -(-size[0] // 16) * -(-size[1] // 16)


def from_planes(size: Size, plane: Callable[[int, int], NDArray[np.float64]]) -> I420:
    width, height = size
    shapes = ((height, width), *[((height + 1) // 2, (width + 1) // 2)] * 2)
    return I420(*(np.clip(plane(*shape), 0, 255).astype(np.uint8) for shape in shapes))


def noise(rng: np.random.Generator, size: Size) -> I420:
    return from_planes(size, lambda height, width: rng.uniform(0, 256, (height, width)))


def waves(rng: np.random.Generator, size: Size) -> I420:
    def wave(height: int, width: int) -> NDArray[np.float64]:
        y, x = np.mgrid[:height, :width]
        across = 60 * np.sin(x / rng.uniform(2, 20) + rng.uniform(0, 6))
        down = 50 * np.cos(y / rng.uniform(2, 20))
        plane: NDArray[np.float64] = 128 + across + down + rng.normal(0, 4, (height, width))
        return plane

    return from_planes(size, wave)


def zoomed(size: Size, scale: float) -> I420:
    """Waves seen from nearer by: vectors differ a little from block to block."""

    def wave(height: int, width: int) -> NDArray[np.float64]:
        y, x = np.mgrid[:height, :width] * (2 * size[1] / height * scale)
        plane: NDArray[np.float64] = 128 + 50 * np.sin(x / 9) * np.cos(y / 11) + 40 * np.sin(x / 5)
        return plane

    return from_planes(size, wave)


def moved(rng: np.random.Generator, picture: I420, shift: int, sigma: float) -> I420:
    planes = []
    for plane in picture.planes:
        rolled = np.roll(plane, (shift, shift // 2), (0, 1))
        noisy = rolled + rng.normal(0, sigma, plane.shape)
        planes.append(np.clip(noisy, 0, 255).astype(np.uint8))
    return I420(*planes)


def scene(kind: str, size: Size, references: int, seed: int) -> tuple[I420, list[I420]]:
    """A frame and its references: shifted copies, noise throughout, other structures, or the same
    at other scales."""
    rng = np.random.default_rng(seed)
    if kind == "noise":
        return noise(rng, size), [noise(rng, size) for _ in range(references)]
    if kind == "zoomed":
        return zoomed(size, 1.0), [zoomed(size, 1.06 + 0.05 * k) for k in range(references)]
    frame = waves(rng, size)
    if kind == "near":
        return frame, [moved(rng, frame, k, 2.0 + k) for k in range(references)]
    return frame, [waves(rng, size) for _ in range(references)]


def decoded(size: Size, coded: OwnSlice, references: Sequence[I420]) -> I420:
    """Return the picture that the product's receiver decodes, with its check of payloads."""
    decoder = SpliceDecoder(stream_header(CodecConfig(*size)))
    decoder.check_payload(coded.payload, len(references))
    decoder.predict_from(*references)
    return decoder.decode(coded.payload)


def largest_difference(a: I420, b: I420) -> int:
    pairs = zip(a.planes, b.planes, strict=True)
    return max(int(np.abs(p.astype(int) - q).max()) for p, q in pairs)


def test_the_largest_steps_of_the_quantiser_between_macroblocks_decode():
    frame, references = scene("near", WIDE, 2, 5)
    offsets = np.resize(np.array([-128, 127, 0, 127], np.int8), macroblocks(WIDE))
    coded = coder_of(WIDE).encode(frame, references, 26, offsets=offsets)
    assert largest_difference(decoded(WIDE, coded, references), coded.reconstruction) == 0


def test_a_widest_picture_decodes():
    """The rows of half samples have room for 8192 samples and their border."""
    size = (8192, 16)
    frame, references = scene("near", size, 1, 6)
    coded = coder_of(size).encode(frame, references, 30, effort=Effort.FAST)
    assert largest_difference(decoded(size, coded, references), coded.reconstruction) == 0


def test_the_deblocking_filter_changes_a_coarsely_coded_picture():
    frame, references = scene("unrelated", WIDE, 1, 7)
    on, off = (
        coder_of(WIDE).encode(frame, references, 40, deblocked=deblocked)
        for deblocked in (True, False)
    )
    assert 0 < largest_difference(on.reconstruction, off.reconstruction) < 60


def test_a_frame_equal_to_its_reference_is_skipped_throughout():
    frame = moved(np.random.default_rng(0), scene("near", WIDE, 0, 8)[0], 0, 0.0)
    coded = coder_of(WIDE).encode(frame, [frame], 26, deblocked=False)
    assert len(coded.payload) < 16
    assert largest_difference(coded.reconstruction, frame) == 0


def test_a_slice_predicts_from_whichever_reference_is_right():
    frame, _ = scene("near", WIDE, 0, 9)
    others = [noise(np.random.default_rng(seed), WIDE) for seed in range(2)]
    sizes = [
        len(coder_of(WIDE).encode(frame, pictures, 26).payload)
        for pictures in ([*others, frame], [others[0], frame, others[1]], [frame, *others])
    ]
    assert max(sizes) < 80


@pytest.mark.parametrize("effort", Effort)
def test_a_smooth_frame_is_not_left_as_noisy_as_its_reference(effort):
    """The noise is below the quantiser's dead zone, so inter prediction has nothing to code."""
    width, height = size = (160, 96)
    grey = np.full((height // 2, width // 2), 128, np.uint8)
    luma = (80 + np.add.outer(np.arange(height) // 2, np.arange(width) // 4)).astype(np.uint8)
    noisy = luma + np.random.default_rng(3).integers(-5, 6, luma.shape)
    frame, reference = I420(luma, grey, grey), I420(noisy.astype(np.uint8), grey, grey)
    coded = coder_of(size).encode(frame, [reference], 34, effort=effort)
    assert len(coded.payload) < 60
    assert luma_error(coded.reconstruction, frame) < luma_error(reference, frame) / 3


def luma_error(a: I420, b: I420) -> float:
    return float(((a.y.astype(np.float64) - b.y) ** 2).sum())


def test_a_lower_quantiser_is_nearer_to_the_frame_and_takes_more_bytes():
    frame, references = scene("unrelated", WIDE, 1, 10)
    coded = [coder_of(WIDE).encode(frame, references, qp) for qp in (14, 24, 34, 44)]
    errors = [float(np.square(c.reconstruction.y.astype(float) - frame.y).mean()) for c in coded]
    assert errors == sorted(errors)
    lengths = [len(c.payload) for c in coded]
    assert lengths == sorted(lengths, reverse=True)


def test_a_frame_codes_to_the_same_bytes_whatever_was_coded_before():
    frame, references = scene("near", WIDE, 2, 13)
    coder = SliceCoder(CodecConfig(*WIDE))
    first = coder.encode(frame, references, 24).payload
    coder.encode(*scene("noise", WIDE, 3, 14), 4)
    assert coder.encode(frame, references, 24).payload == first


def test_the_frame_and_references_may_be_parts_of_larger_pictures():
    frame, (reference,) = scene("near", WIDE, 1, 15)

    def inside(picture: I420) -> I420:
        return I420(*(np.pad(plane, 7)[7:-7, 7:-7] for plane in picture.planes))

    expected = coder_of(WIDE).encode(frame, [reference], 24).payload
    assert coder_of(WIDE).encode(inside(frame), [inside(reference)], 24).payload == expected


@pytest.mark.parametrize("isa", available_isas())
@pytest.mark.parametrize("effort", Effort)
def test_every_instruction_set_writes_the_same_bytes(effort, isa):
    for seed, (kind, qp) in enumerate(zip(KINDS[:3], (22, 2, 34), strict=True)):
        frame, references = scene(kind, WIDE, 3 - seed, seed)
        expected = coder_of(WIDE).encode(frame, references, qp, effort=effort)
        got = coder_of(WIDE, isa).encode(frame, references, qp, effort=effort)
        assert got.payload == expected.payload
        assert largest_difference(got.reconstruction, expected.reconstruction) == 0


@pytest.mark.parametrize("threads", [2, 3, 16])
@pytest.mark.parametrize("effort", Effort)
def test_any_number_of_threads_writes_the_same_bytes(effort, threads):
    coder = SliceCoder(CodecConfig(*TALL), threads=threads)
    for seed, (kind, qp) in enumerate(zip(KINDS, (22, 2, 34, 30), strict=True)):
        frame, references = scene(kind, TALL, 3 - seed, seed)
        expected = coder_of(TALL).encode(frame, references, qp, effort=effort)
        got = coder.encode(frame, references, qp, effort=effort)
        assert got.payload == expected.payload
        assert largest_difference(got.reconstruction, expected.reconstruction) == 0


GOLDEN = {
    (Effort.FAST, 3, 22): "f817ad2501c40ddd",
    (Effort.DEFAULT, 3, 22): "9a09dde456525f1a",
    (Effort.THOROUGH, 3, 22): "2a8cd36bab98eff0",
    (Effort.DEFAULT, 1, 34): "4d67bea7635c6389",
    (Effort.DEFAULT, 0, 30): "8feb7a3b31174a26",
    (Effort.DEFAULT, 4, 26): "0fbb6139281e5fa4",
}
"""First digits of the SHA-256 of slices, by effort, references and quantiser. They
change with every decision of the coder; print them with this file's ``digest``."""


def blocks(rng: np.random.Generator, size: Size, shift: int, seed: int) -> I420:
    """Grey blocks with noise, made of integers alone: the same picture on every machine."""
    width, height = size
    grey_levels = np.random.default_rng(seed).integers(40, 200, (24, 40))
    grid = np.kron(grey_levels, np.ones((7, 7), np.int64))
    planes = []
    for step in (1, 2, 2):
        across = (4 + shift) * 2 // step
        part = grid[: height // step, across : across + width // step]
        soft = (part + np.roll(part, 1, 0) + np.roll(part, 1, 1)) // 3
        planes.append((soft + rng.integers(-3, 4, soft.shape)).astype(np.uint8))
    return I420(*planes)


def halves(a: I420, b: I420) -> I420:
    """The mean of two pictures: what neither explains alone."""
    pairs = zip(a.planes, b.planes, strict=True)
    return I420(*(((p.astype(np.uint16) + q) // 2).astype(np.uint8) for p, q in pairs))


def digest(effort: Effort, references: int, qp: int) -> str:
    size = (160, 96)
    rng = np.random.default_rng(4)
    frame = halves(blocks(rng, size, 3, 3), blocks(rng, size, 0, 4))
    pictures = [
        halves(blocks(rng, size, 2 * k, 3), blocks(rng, size, 1 - k, 4 + k))
        for k in range(references)
    ]
    coder = SliceCoder(CodecConfig(*size))
    payload = coder.encode(frame, pictures, qp, effort=effort).payload
    return hashlib.sha256(payload).hexdigest()[:16]


@pytest.mark.parametrize(("effort", "references", "qp"), GOLDEN)
def test_slices_keep_their_bytes(effort, references, qp):
    assert digest(effort, references, qp) == GOLDEN[effort, references, qp]


def ramp(size: Size, lifted: int) -> I420:
    """Brighter by 1 from row to row, with a pattern: a vertical shift of so many rows, that every
    step of a search comes nearer to, and that nothing else is as good as."""
    width, height = size
    pattern = np.random.default_rng(5).integers(-4, 5, (height + 72, width))
    rows = 60 + lifted + np.arange(height)[:, None] + pattern[lifted : lifted + height]
    rows = rows.astype(np.uint8)
    half = np.ascontiguousarray(rows[::2, ::2])
    return I420(rows, half, half)


def vertical_vectors(size: Size, coded: OwnSlice, references: Sequence[I420]) -> NDArray[np.int32]:
    """The vertical components of a slice's vectors as FFmpeg reads them, in quarter samples."""
    splice = SpliceDecoder(stream_header(CodecConfig(*size)))
    decoder = splice._decoder
    assert isinstance(decoder, H264Decoder)
    decoder._context.options = {"flags2": "+export_mvs"}
    splice.predict_from(*references)
    picture = decoder._frame(join_nals([coded.payload]))
    fields = cast(Any, picture.side_data).get("MOTION_VECTORS").to_ndarray()
    assert (fields["motion_scale"] == 4).all()
    vertical: NDArray[np.int32] = fields["motion_y"]
    return vertical


@pytest.mark.parametrize("shift", [72, -72])
@pytest.mark.parametrize(
    ("size", "level_idc", "least", "most"),
    [((64, 112), 10, -256, 255), ((256, 112), 12, -512, 511)],
)
def test_vectors_stay_within_the_levels_vertical_range(size, level_idc, least, most, shift):
    """MaxVmvR of table A-1: -64..63.75 samples at level 1, where 72 would fit best; a larger
    picture's level has room for them."""
    config = CodecConfig(*size)
    assert config.level_idc == level_idc
    frame, reference = ramp(size, max(-shift, 0)), ramp(size, max(shift, 0))
    coded = SliceCoder(config).encode(
        frame,
        [reference],
        26,
        effort=Effort.THOROUGH,
        forced=np.full(config.macroblocks, MacroblockMode.INTER_16X16, np.int8),
    )
    vectors = vertical_vectors(size, coded, [reference])
    assert least <= vectors.min() <= vectors.max() <= most
    farthest = int(np.abs(vectors).max())
    assert farthest > 250 if level_idc == 10 else farthest == 4 * 72


def cost_of_moved(effort: Effort, qp: int) -> float:
    """D + lambda R of the luma of three frames against noisy pictures moved by parts of samples."""
    size, total = (160, 96), 0.0
    rng = np.random.default_rng(6)
    fine = cv2.GaussianBlur(rng.uniform(0, 255, (4 * 112, 4 * 176)).astype(np.float32), (0, 0), 6)
    fine = 128 + 6 * (fine - fine.mean())

    def seen(x: int, y: int) -> I420:
        """The scene from a quarter of a sample further right or down for each of x and y."""
        luma = fine[y : y + 4 * 96 : 4, x : x + 4 * 160 : 4] + rng.normal(0, 2, (96, 160))
        return I420(luma.clip(1, 255).astype(np.uint8), *halves_of_grey)

    halves_of_grey = (np.full((48, 80), 128, np.uint8), np.full((48, 80), 128, np.uint8))
    coder = SliceCoder(CodecConfig(*size))
    for move in (3, 6, 11):
        frame = seen(move, move // 2)
        coded = coder.encode(frame, [seen(0, 5), seen(4, 0)], qp, effort=effort)
        error = coded.reconstruction.y.astype(np.float64) - frame.y
        bits = 8 * len(coded.payload)
        total += float((error**2).sum()) + LAMBDA_FACTOR * 2 ** ((qp - 12) / 3) * bits
    return total


def test_more_effort_finds_what_costs_less():
    fast, default, thorough = (
        np.prod([cost_of_moved(effort, qp) for qp in (20, 24, 28)]) for effort in Effort
    )
    assert thorough < default < fast


@pytest.mark.parametrize("qp", [-1, 61])
def test_a_quantiser_outside_the_standard_is_refused(qp):
    frame, references = scene("near", ODD, 1, 0)
    with pytest.raises(InvalidInput, match=f"{qp} is outside 0..60"):
        coder_of(ODD).encode(frame, references, qp)


def test_more_references_than_the_stream_allows_are_refused():
    frame, references = scene("near", ODD, 5, 0)
    with pytest.raises(InvalidInput, match="5 are more than the stream's 4"):
        coder_of(ODD).encode(frame, references, 26)


@pytest.mark.parametrize("wrong", ["frame", "reference"])
def test_pictures_of_another_size_are_refused(wrong):
    frame, references = scene("near", ODD, 1, 0)
    other, _ = scene("near", WIDE, 0, 0)
    pictures = (other, references) if wrong == "frame" else (frame, [other])
    with pytest.raises(InvalidInput, match=rf"{wrong}.*\(100, 52\) px"):
        coder_of(ODD).encode(*pictures, 26)


@pytest.mark.parametrize(
    "offsets", [np.zeros(5, np.int8), np.zeros(6, np.int16), np.zeros((2, 3), np.int8)]
)
def test_offsets_that_do_not_fit_the_macroblocks_are_refused(offsets):
    frame, references = scene("near", (48, 32), 1, 0)
    with pytest.raises(InvalidInput, match=r"where int8 \(6,\) is expected"):
        coder_of((48, 32)).encode(frame, references, 26, offsets=offsets)


def test_an_instruction_set_that_is_not_there_is_refused():
    with pytest.raises(BackendUnavailable, match="'abacus'"):
        SliceCoder(CodecConfig(*ODD), isa="abacus")
