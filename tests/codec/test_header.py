"""One header serves every preset and CRF of a size, and receivers take no other."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.bitstream import BitWriter, nal_of_rbsp
from rfcore.codec.h264.config import PRESETS, CodecConfig
from rfcore.codec.h264.header import StreamHeader, check_header
from rfcore.codec.h264.parameter_sets import parse_pps, parse_sps
from rfcore.codec.h264.pcm_picture import pcm_pps
from rfcore.codec.h264.slices import SliceCoding, encode_slice
from rfcore.codec.sender.encoder import DeltaEncoder
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.views import FieldView

PairMaker = Callable[..., tuple[I420, FieldView]]


@pytest.fixture(scope="module")
def header() -> StreamHeader:
    return DeltaEncoder(CodecConfig(300, 168)).header


@pytest.mark.parametrize("references", [0, 1, 2, 3])
def test_every_preset_crf_and_number_of_references_writes_the_same_parameter_sets(
    header: StreamHeader, pair: PairMaker, references: int
) -> None:
    frame, view = pair(300, 168)
    for preset in PRESETS:
        for crf in (1, 17.5, 23, 28, 51):
            config = CodecConfig(300, 168, preset, crf)
            coded = encode_slice(config, [view.render] * references, frame)
            made = coded.header
            assert (made.sps, made.pps) == (header.sps, header.pps), (preset, crf)
            assert coded.payload


@pytest.mark.parametrize("preset", PRESETS)
def test_threads_and_fast_unsent_references_change_no_parameter_set(
    header: StreamHeader, pair: PairMaker, preset: str
) -> None:
    frame, view = pair(300, 168)
    pictures = [pair(300, 168, 2.0)[0], pair(300, 168, 1.0)[1].render, view.render]
    config = CodecConfig(300, 168, preset, 28)
    alone, shared, again, fast = (
        encode_slice(config, pictures, frame, coding)
        for coding in (
            SliceCoding(),
            SliceCoding(threads=2),
            SliceCoding(threads=2),
            SliceCoding(fast_unsent=True),
        )
    )
    for coded in (alone, shared, fast):
        assert (coded.header.sps, coded.header.pps) == (header.sps, header.pps)
    assert shared == again
    assert len(shared.payload) == pytest.approx(len(alone.payload), rel=0.02)
    assert fast.payload != alone.payload


def test_a_better_preset_or_crf_changes_the_slice(pair: PairMaker) -> None:
    """The zone's analysis settings reach the P picture, and CRF its quantiser."""
    frame, view = pair(300, 168)
    sizes = [
        len(encode_slice(CodecConfig(300, 168, preset, crf), [view.render], frame).payload)
        for preset, crf in (("medium", 18), ("medium", 23), ("medium", 28))
    ]
    assert sizes == sorted(sizes, reverse=True)
    slices = {
        encode_slice(CodecConfig(300, 168, preset, 23), [view.render], frame).payload
        for preset in PRESETS
    }
    assert len(slices) >= len(PRESETS) - 1


@pytest.mark.parametrize(
    ("width_px", "height_px", "level_idc"),
    [
        (2, 2, 10),
        (300, 168, 13),
        (640, 360, 31),
        (720, 404, 31),
        (1280, 720, 32),
        (1920, 1080, 42),
        (4096, 2304, 52),
        (2304, 4096, 52),
        (8192, 2, 51),
    ],
)
def test_levels_are_the_lowest_that_annex_a_allows(
    width_px: int, height_px: int, level_idc: int
) -> None:
    assert CodecConfig(width_px, height_px).level_idc == level_idc


@pytest.mark.parametrize("size_px", [(2, 2), (3, 2), (17, 33), (301, 169), (1920, 1080), (8192, 2)])
def test_the_header_says_size_level_and_colours(size_px: tuple[int, int]) -> None:
    config = CodecConfig(*size_px, preset="ultrafast")
    sps = check_header(DeltaEncoder(config).header)
    assert sps.size_px == config.coded_size_px
    assert (sps.level_idc, sps.profile_idc) == (config.level_idc, 100)
    assert sps.vui.primaries_transfer_matrix == (1, 1, 1)
    assert (sps.vui.full_range, sps.vui.chroma_location) == (False, 1)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"config": CodecConfig(320, 168)}, "stream_header.sps.width_mbs: 19 where our encoder"),
        ({"config": CodecConfig(302, 168)}, "stream_header.sps.crop_px"),
        ({"sps": b""}, "unusable parameter set"),
        ({"pps": b"\x68"}, "unusable parameter set"),
        ({"pps": pcm_pps()}, r"stream_header.pps.pps_id: 1 where our encoder writes 0"),
    ],
)
def test_a_header_that_our_encoder_would_not_make_is_refused(
    header: StreamHeader, change: dict[str, object], problem: str
) -> None:
    with pytest.raises(InvalidInput, match=problem):
        DeltaDecoder(replace(header, **change))  # type: ignore[arg-type]


def test_every_flipped_bit_of_a_header_is_refused_or_harmless(header: StreamHeader) -> None:
    """Harmless: the aspect of nothing, the clock rate, limits on motion vectors (annex E)."""
    accepted = 0
    for name in ("sps", "pps"):
        nal = getattr(header, name)
        for bit in range(8, 8 * len(nal)):
            damaged = bytearray(nal)
            damaged[bit // 8] ^= 0x80 >> bit % 8
            try:
                sps = check_header(replace(header, **{name: bytes(damaged)}))
            except InvalidInput:
                continue
            accepted += 1
            assert (sps.size_px, sps.max_num_ref_frames) == ((300, 168), 3)
    assert accepted < 110


def test_profiles_levels_and_references_of_others_are_refused(header: StreamHeader) -> None:
    for position, value, name in ((1, 77, "profile"), (3, 52, "level_idc: 52")):
        sps = bytearray(header.sps)
        sps[position] = value
        with pytest.raises(InvalidInput, match=name if value == 52 else "stream_header"):
            DeltaDecoder(replace(header, sps=bytes(sps)))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"width_px": 1}, "codec.width_px: 1 px is outside 2..8192"),
        ({"height_px": 8193}, "codec.height_px: 8193 px"),
        ({"width_px": 4112, "height_px": 2304}, "more than the 36864 of H.264 level 5.2"),
        ({"preset": "placebo"}, "codec.preset: 'placebo' is none of ultrafast"),
        ({"crf": 0.5}, "codec.crf: 0.5 is outside 1..51"),
        ({"crf": float("nan")}, "codec.crf: nan"),
        ({"crf": 52}, "codec.crf: 52"),
    ],
)
def test_configurations_outside_the_lists_are_refused(
    change: dict[str, object], named: str
) -> None:
    good: dict[str, object] = {"width_px": 640, "height_px": 360}
    with pytest.raises(InvalidInput, match=named):
        CodecConfig(**{**good, **change})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("bits", "problem"),
    [
        (BitWriter().ue(0).ue(0).u(2, 0).ue(1).stop(), "slice groups"),
        (BitWriter().ue(0).stop(), "bits wanted"),
    ],
)
def test_picture_parameter_sets_of_other_kinds_are_refused(bits: BitWriter, problem: str) -> None:
    with pytest.raises(InvalidInput, match=problem):
        check_header(
            StreamHeader(
                CodecConfig(300, 168),
                DeltaEncoder(CodecConfig(300, 168)).header.sps,
                nal_of_rbsp(0x68, bits.to_bytes()),
            )
        )


def test_x264s_sets_parse_to_their_known_fields() -> None:
    """Golden: what x264 wrote for 300x168, medium, ref 3, stitchable, level 3.1."""
    sps = parse_sps(bytes.fromhex("6764001facb20262fdcb35010101a5000003000100000300328f183248"))
    assert (sps.width_mbs, sps.height_mbs, sps.crop_px) == (19, 11, (0, 4, 0, 8))
    assert (sps.level_idc, sps.poc_type, sps.max_num_ref_frames) == (31, 2, 3)
    assert (sps.vui.reorder_frames, sps.vui.buffered_frames) == (0, 3)
    pps = parse_pps(bytes.fromhex("68ebccb22c"))
    assert (pps.cabac, pps.transform_8x8, pps.chroma_qp_offsets) == (True, True, (-2, -2))
