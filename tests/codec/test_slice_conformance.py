"""The conformance sweep of the slice coder: FFmpeg decodes its own reconstruction, byte for byte.

Pictures from flat to noise, sizes from 2x2 to 4096x2304 px, every quantiser, one to four
references or none, all efforts, quantiser maps, the deblocking filter on and off, and every mode
forced. A small sweep runs with the tests, the whole one by ``make test-slices``.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rfcore.codec.h264.bitstream import StreamHeader, stream_header
from rfcore.codec.h264.config import REFERENCE_FRAMES, CodecConfig
from rfcore.codec.h264.slice_coder import Effort, MacroblockMode, OwnSlice, SliceCoder
from rfcore.codec.h264.splice import SpliceDecoder
from rfcore.errors import InvalidInput
from rfcore.image import I420

Size = tuple[int, int]
Pictures = list[I420]

SMALL: tuple[Size, ...] = ((2, 2), (16, 16), (35, 33), (100, 52), (16, 80), (178, 98), (322, 182))
LARGE: tuple[Size, ...] = ((640, 360), (1280, 720), (1920, 1080), (4096, 2304), (8192, 1152))
WHOLE_SWEEP_MACROBLOCKS = 1_000_000
MOST_CASES = 1_000
INTRA_MODES = tuple(mode for mode in MacroblockMode if mode >= MacroblockMode.INTRA_16X16)
ANY = -1


@cache
def header_of(size: Size) -> StreamHeader:
    return stream_header(CodecConfig(*size))


@cache
def coder_of(size: Size) -> SliceCoder:
    return SliceCoder(CodecConfig(*size))


def macroblocks(size: Size) -> int:
    return -(-size[0] // 16) * -(-size[1] // 16)


# --- pictures ---


def flat(rng: np.random.Generator, shape: Size) -> NDArray[np.float64]:
    return np.full(shape, rng.choice([0, 16, 128, 235, 255]), np.float64)


def extreme(rng: np.random.Generator, shape: Size) -> NDArray[np.float64]:
    """Black and white in squares of one sample and up: the largest coefficients there are."""
    side = int(rng.choice([1, 2, 3, 4, 8]))
    cells = rng.integers(0, 2, (-(-shape[0] // side), -(-shape[1] // side)))
    squares = np.kron(cells, np.ones((side, side), np.int64))
    return (255 * squares[: shape[0], : shape[1]]).astype(np.float64)


def noise(rng: np.random.Generator, shape: Size) -> NDArray[np.float64]:
    return rng.uniform(0, 256, shape)


def natural(rng: np.random.Generator, shape: Size) -> NDArray[np.float64]:
    """Structure at all scales with edges, and a little noise."""
    plane = np.full(shape, 128.0)
    for scale in (64, 16, 5):
        cells = rng.normal(0, 9 + scale / 3, (-(-shape[0] // scale), -(-shape[1] // scale)))
        plane += np.kron(cells, np.ones((scale, scale)))[: shape[0], : shape[1]]
    return plane + rng.normal(0, 1.5, shape)


PAINTERS = {"flat": flat, "extreme": extreme, "noise": noise, "natural": natural}


def painted(rng: np.random.Generator, kind: str, size: Size) -> I420:
    width, height = size
    shapes = ((height, width), *[((height + 1) // 2, (width + 1) // 2)] * 2)
    planes = (np.clip(PAINTERS[kind](rng, shape), 0, 255) for shape in shapes)
    return I420(*(plane.astype(np.uint8) for plane in planes))


def moved(rng: np.random.Generator, picture: I420) -> I420:
    """The picture from elsewhere: shifted by up to 9 samples, averaged between samples, noisy."""
    across, down = rng.integers(-9, 10, 2)
    planes = []
    for plane in picture.planes:
        shifted = np.roll(plane, (down, across), (0, 1)).astype(np.float64)
        between = (shifted + np.roll(shifted, 1, 1)) / 2 if rng.integers(2) else shifted
        noisy = between + rng.normal(0, rng.choice([0.0, 2.0]), plane.shape)
        planes.append(np.clip(noisy, 0, 255).astype(np.uint8))
    return I420(*planes)


# --- cases ---


@dataclass(frozen=True)
class Case:
    """A slice to code. ``forced``: the mode of all macroblocks, ``None`` for the coder's choice and
    -1 for a mixture."""

    size: Size
    kind: str
    references: int
    qp: int
    effort: Effort
    mapped: bool
    deblocked: bool
    forced: int | None
    seed: int

    def pictures(self) -> Pictures:
        """The frame, then the references; half of these have nothing to do with the frame."""
        rng = np.random.default_rng(self.seed)
        frame = painted(rng, self.kind, self.size)
        related = [moved(rng, frame) for _ in range(self.references)]
        other = painted(rng, str(rng.choice(list(PAINTERS))), self.size)
        return [frame, *(other if rng.integers(2) else r for r in related)]

    def offsets(self) -> NDArray[np.int8] | None:
        rng = np.random.default_rng(self.seed + 1)
        spread = int(rng.choice([2, 12, 52]))
        count = macroblocks(self.size)
        return rng.integers(-spread, spread, count).astype(np.int8) if self.mapped else None

    def modes(self) -> NDArray[np.int8] | None:
        if self.forced is None:
            return None
        count = macroblocks(self.size)
        if self.forced != ANY:
            return np.full(count, self.forced, np.int8)
        rng = np.random.default_rng(self.seed + 2)
        allowed = list(MacroblockMode) if self.references else list(INTRA_MODES)
        return rng.choice([ANY, *allowed], count).astype(np.int8)


def coded(case: Case) -> OwnSlice:
    frame, *references = case.pictures()
    return coder_of(case.size).encode(
        frame,
        references,
        case.qp,
        effort=case.effort,
        deblocked=case.deblocked,
        offsets=case.offsets(),
        forced=case.modes(),
    )


def check(case: Case) -> OwnSlice:
    """Code the case; FFmpeg must decode exactly what the coder reconstructed."""
    _, *references = case.pictures()
    slice_ = coded(case)
    decoder = SpliceDecoder(header_of(case.size))
    decoder.check_payload(slice_.payload, len(references))
    decoder.predict_from(*references)
    shown = decoder.decode(slice_.payload)
    for ours, theirs in zip(slice_.reconstruction.planes, shown.planes, strict=True):
        assert np.array_equal(ours, theirs), case
    return slice_


def random_case(rng: np.random.Generator, size: Size) -> Case:
    references = int(rng.integers(0, REFERENCE_FRAMES + 1))
    modes = list(MacroblockMode) if references else list(INTRA_MODES)
    forced = [None, None, ANY, int(rng.choice(modes))][rng.integers(4)]
    return Case(
        size=size,
        kind=str(rng.choice(list(PAINTERS))),
        references=references,
        qp=int(rng.integers(0, 52)),
        effort=list(Effort)[rng.integers(len(Effort))],
        mapped=bool(rng.integers(2)),
        deblocked=bool(rng.integers(2)),
        forced=forced,
        seed=int(rng.integers(1 << 32)),
    )


def sweep(sizes: tuple[Size, ...], least: int, seed: int) -> Counter[str]:
    """Check random cases of each size, of ``least`` macroblocks ``MOST_CASES`` at most.

    Returns how many macroblocks there were of every mode.
    """
    counts: Counter[str] = Counter()
    for size in sizes:
        rng = np.random.default_rng([seed, *size])
        for case in cases_of(rng, size, least):
            modes = check(case).modes
            counts.update({mode.name: int((modes == mode).sum()) for mode in MacroblockMode})
    return counts


def cases_of(rng: np.random.Generator, size: Size, least: int) -> Iterator[Case]:
    for _ in range(min(MOST_CASES, -(-least // macroblocks(size)))):
        yield random_case(rng, size)


# --- the sweep ---


@pytest.mark.parametrize("mode", MacroblockMode)
def test_every_mode_decodes_to_the_coders_own_reconstruction(mode):
    """Alone and with the coder's own decisions around it, at quantisers from 0 to 51."""
    met = 0
    for seed, qp in enumerate(range(0, 52, 3)):
        references = 0 if mode in INTRA_MODES and seed % 3 == 0 else 1 + seed % REFERENCE_FRAMES
        effort = list(Effort)[seed % 3]
        for forced in (int(mode), ANY):
            slice_ = check(
                Case(
                    (100, 52), "natural", references, qp, effort, seed % 2 > 0, seed % 4 > 1,
                    forced, seed,
                )
            )  # fmt: skip
            met += int((slice_.modes == mode).sum())
    assert met > 200


def test_ffmpeg_decodes_the_coders_own_reconstruction():
    counts = sweep(SMALL, 200, 1)
    assert sum(counts.values()) >= 200 * len(SMALL)
    assert min(counts.values()) > 0, counts


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.timeout(3600)
def test_the_whole_sweep_agrees(capsys):
    counts = sweep(SMALL, WHOLE_SWEEP_MACROBLOCKS // 20, 2)
    counts += sweep(LARGE, WHOLE_SWEEP_MACROBLOCKS // 5, 3)
    with capsys.disabled():
        print(f"\n{sum(counts.values())} macroblocks agree: {dict(counts)}")
    assert sum(counts.values()) >= WHOLE_SWEEP_MACROBLOCKS
    assert min(counts.values()) > WHOLE_SWEEP_MACROBLOCKS // 100, counts


# --- any picture ---

CASES = st.builds(
    Case,
    size=st.sampled_from(((2, 2), (3, 17), (35, 33), (16, 48), (66, 18))),
    kind=st.sampled_from(sorted(PAINTERS)),
    references=st.integers(1, REFERENCE_FRAMES),
    qp=st.integers(0, 51),
    effort=st.sampled_from(Effort),
    mapped=st.booleans(),
    deblocked=st.booleans(),
    forced=st.none() | st.just(ANY) | st.sampled_from([int(mode) for mode in MacroblockMode]),
    seed=st.integers(0, 1 << 32),
) | st.builds(
    Case,
    size=st.sampled_from(((2, 2), (35, 33), (66, 18))),
    kind=st.sampled_from(sorted(PAINTERS)),
    references=st.just(0),
    qp=st.integers(0, 51),
    effort=st.sampled_from(Effort),
    mapped=st.booleans(),
    deblocked=st.booleans(),
    forced=st.none() | st.just(ANY) | st.sampled_from([int(mode) for mode in INTRA_MODES]),
    seed=st.integers(0, 1 << 32),
)


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(case=CASES)
def test_no_picture_makes_a_slice_that_ffmpeg_rejects(case):
    check(case)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.timeout(3600)
@settings(
    max_examples=20_000,
    suppress_health_check=[HealthCheck.too_slow],
    deadline=None,
    phases=(Phase.explicit, Phase.generate, Phase.shrink),
)
@given(case=CASES)
def test_no_picture_of_a_long_run_makes_a_slice_that_ffmpeg_rejects(case):
    check(case)


# --- limits of the standard ---


def test_a_macroblock_of_noise_at_the_lowest_quantiser_is_coded_as_its_samples():
    case = Case((64, 64), "noise", 1, 0, Effort.DEFAULT, False, True, None, 5)
    slice_ = check(case)
    assert (slice_.modes == MacroblockMode.PCM).all()
    assert len(slice_.payload) < 16 * 388 + 16
    assert np.array_equal(slice_.reconstruction.y, case.pictures()[0].y)


@pytest.mark.parametrize("mode", [MacroblockMode.INTER_16X16, MacroblockMode.INTRA_4X4])
def test_a_forced_macroblock_above_3200_bits_is_coded_as_its_samples(mode):
    """No macroblock may take more (A.3.1), whatever a test forces."""
    fine = check(Case((64, 64), "noise", 1, 34, Effort.FAST, False, True, int(mode), 6))
    assert (fine.modes == mode).all()
    large = check(Case((64, 64), "noise", 1, 0, Effort.FAST, False, True, int(mode), 6))
    assert (large.modes == MacroblockMode.PCM).all()


def test_a_mode_that_slices_without_references_lack_is_refused():
    case = Case((16, 16), "flat", 0, 20, Effort.FAST, False, True, MacroblockMode.INTER_8X8, 1)
    with pytest.raises(InvalidInput, match="4 is no mode of I slices"):
        coded(case)
