"""One header serves every effort and CRF of a size, and receivers take no other."""

import hashlib
from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.bitstream import BitWriter, nal_of_rbsp
from rfcore.codec.h264.config import EFFORTS, PRESETS, CodecConfig, Coder, CoderSettings
from rfcore.codec.h264.header import StreamHeader, check_header, own_header, pps_nal, sps_nal
from rfcore.codec.h264.parameter_sets import (
    PictureParameters,
    SequenceParameters,
    Vui,
    parse_pps,
    parse_sps,
)
from rfcore.codec.h264.pcm_picture import pcm_pps
from rfcore.codec.h264.slices import SliceCoding, encode_slice
from rfcore.codec.sender.encoder import DeltaEncoder
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.views import FieldView

PairMaker = Callable[..., tuple[I420, FieldView]]
OWN, X264 = CodecConfig(300, 168), CodecConfig(300, 168, "x264-medium")


@pytest.fixture(scope="module", params=[OWN, X264], ids=["own", "x264"])
def header(request: pytest.FixtureRequest) -> StreamHeader:
    return DeltaEncoder(request.param).header


@pytest.fixture(scope="module")
def x264_header() -> StreamHeader:
    return DeltaEncoder(X264).header


def test_every_effort_and_crf_has_the_same_parameter_sets() -> None:
    """Golden: receivers in the field accept these bytes and no others."""
    for effort in ("fast", "default", "thorough"):
        for crf in (1.0, 23.0, 51.0):
            made = DeltaEncoder(CodecConfig(300, 168, effort, crf)).header
            assert made.sps.hex() == "6764000dacb28262fdcb35010101a41e10084b"
            assert made.pps.hex() == "68eb8f2c"


def test_the_parameter_sets_of_all_sizes_keep_their_bytes() -> None:
    sizes = [(2, 2), (3, 2), (17, 33), (640, 360), (1280, 720), (1920, 1080), (4096, 2304)]
    headers = [own_header(CodecConfig(*size_px)) for size_px in sizes]
    digest = hashlib.sha256(b"".join(header.sps + header.pps for header in headers))
    assert digest.hexdigest()[:16] == "1c012b87e2297135"


@given(
    level_idc=st.integers(10, 62),
    sizes=st.tuples(st.integers(1, 512), st.integers(1, 512)),
    references=st.integers(0, 16),
    log2_max_frame_num=st.integers(4, 16),
    crop=st.tuples(*[st.integers(0, 7).map(lambda n: 2 * n)] * 4),
    has_vui=st.booleans(),
)
def test_a_sequence_parameter_set_parses_to_what_was_written(
    level_idc: int,
    sizes: tuple[int, int],
    references: int,
    log2_max_frame_num: int,
    crop: tuple[int, int, int, int],
    has_vui: bool,
) -> None:
    sps = SequenceParameters(
        100, 0, level_idc, 0, 1, (8, 8), log2_max_frame_num, 2, references,
        frame_num_gaps_allowed=False, width_mbs=sizes[0], height_mbs=sizes[1],
        frame_mbs_only=True, direct_8x8_inference=True, crop_px=crop,
        vui=Vui(False, (1, 1, 1), 1, 0, references) if has_vui else Vui(),
    )  # fmt: skip
    assert parse_sps(sps_nal(sps)) == sps


@given(
    flags=st.tuples(*[st.booleans()] * 7),
    references=st.tuples(st.integers(1, 32), st.integers(1, 32)),
    quantisers=st.tuples(st.integers(0, 51), st.integers(0, 51)),
    chroma=st.tuples(st.integers(-12, 12), st.integers(-12, 12)),
)
def test_a_picture_parameter_set_parses_to_what_was_written(
    flags: tuple[bool, ...],
    references: tuple[int, int],
    quantisers: tuple[int, int],
    chroma: tuple[int, int],
) -> None:
    pps = PictureParameters(
        0, 0, flags[0], flags[1], references, flags[2], 0, *quantisers, chroma, *flags[3:]
    )
    assert parse_pps(pps_nal(pps)) == pps


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"profile_idc": 77}, "High profile"),
        ({"bit_depths": (10, 10)}, "High profile"),
        ({"poc_type": 0}, "poc_type: 0 is not 2"),
        ({"crop_px": (0, 3, 0, 0)}, "must be even"),
    ],
)
def test_what_the_writer_cannot_say_is_refused(change: dict[str, object], problem: str) -> None:
    sps = parse_sps(own_header(OWN).sps)
    with pytest.raises(InvalidInput, match=problem):
        sps_nal(replace(sps, **change))  # type: ignore[arg-type]


@pytest.mark.parametrize("references", [0, 1, 2, 3])
def test_every_preset_crf_and_number_of_references_of_x264_writes_the_same_parameter_sets(
    x264_header: StreamHeader, pair: PairMaker, references: int
) -> None:
    frame, view = pair(300, 168)
    for preset in PRESETS:
        for crf in (1, 17.5, 23, 28, 51):
            config = CodecConfig(300, 168, f"x264-{preset}", crf)
            coded = encode_slice(config, [view.render] * references, frame)
            made = coded.header
            assert (made.sps, made.pps) == (x264_header.sps, x264_header.pps), (preset, crf)
            assert coded.payload


@pytest.mark.parametrize("preset", PRESETS)
def test_threads_change_no_parameter_set_of_x264(
    x264_header: StreamHeader, pair: PairMaker, preset: str
) -> None:
    frame, view = pair(300, 168)
    pictures = [pair(300, 168, 2.0)[0], pair(300, 168, 1.0)[1].render, view.render]
    config = CodecConfig(300, 168, f"x264-{preset}", 28)
    alone, shared, again = (
        encode_slice(config, pictures, frame, SliceCoding(threads=threads)) for threads in (1, 2, 2)
    )
    for coded in (alone, shared):
        assert (coded.header.sps, coded.header.pps) == (x264_header.sps, x264_header.pps)
    assert shared == again
    assert len(shared.payload) == pytest.approx(len(alone.payload), rel=0.02)


def test_a_better_preset_or_crf_changes_the_slice(pair: PairMaker) -> None:
    """The zone's analysis settings reach the P picture, and CRF its quantiser."""
    frame, view = pair(300, 168)

    def coded(preset: str, crf: float) -> bytes:
        config = CodecConfig(300, 168, f"x264-{preset}", crf)
        return encode_slice(config, [view.render], frame).payload

    sizes = [len(coded("medium", crf)) for crf in (18, 23, 28)]
    assert sizes == sorted(sizes, reverse=True)
    assert len({coded(preset, 23) for preset in PRESETS}) >= len(PRESETS) - 1


def test_x264_takes_no_fourth_reference(pair: PairMaker) -> None:
    frame, view = pair(300, 168)
    with pytest.raises(InvalidInput, match="4 are more than the 3 of x264"):
        encode_slice(X264, [view.render] * 4, frame)


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
    config = CodecConfig(*size_px, effort="fast")
    sps = check_header(DeltaEncoder(config).header)
    assert sps.size_px == config.coded_size_px
    assert (sps.level_idc, sps.profile_idc) == (config.level_idc, 100)
    assert sps.vui.primaries_transfer_matrix == (1, 1, 1)
    assert (sps.vui.full_range, sps.vui.chroma_location) == (False, 1)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"width_px": 320}, "stream_header.sps.width_mbs: 19 where our encoder"),
        ({"width_px": 302}, "stream_header.sps.crop_px"),
        ({"sps": b""}, "unusable parameter set"),
        ({"pps": b"\x68"}, "unusable parameter set"),
        ({"pps": pcm_pps()}, r"stream_header.pps.pps_id: 1 where our encoder writes 0"),
    ],
)
def test_a_header_that_our_encoder_would_not_make_is_refused(
    header: StreamHeader, change: dict[str, object], problem: str
) -> None:
    if "width_px" in change:
        change = {"config": replace(header.config, **change)}  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match=problem):
        DeltaDecoder(replace(header, **change))  # type: ignore[arg-type]


def test_the_header_of_one_coder_is_refused_as_that_of_the_other(x264_header: StreamHeader) -> None:
    for config, theirs in ((OWN, x264_header), (X264, own_header(OWN))):
        with pytest.raises(InvalidInput, match=r"stream_header.sps.max_num_ref_frames: [34] where"):
            DeltaDecoder(replace(theirs, config=config))


def test_every_flipped_bit_of_a_header_is_refused_or_harmless(header: StreamHeader) -> None:
    """Harmless, in x264's: the aspect of nothing, the clock rate, limits on motion vectors (annex
    E). In ours nothing is."""
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
    assert accepted < 110 if header.config.coder is Coder.X264 else accepted == 0


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
        ({"effort": "placebo"}, "codec.effort: 'placebo' is none of fast"),
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


@pytest.mark.parametrize("effort", EFFORTS)
def test_an_effort_survives_the_command_line(effort: str) -> None:
    settings = CoderSettings.of(effort)
    assert settings.name == effort
    assert ("--effort" in settings.arguments) == (settings.coder is Coder.OWN)


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"preset": "medium"}, "preset: 'medium': --coder own has no --preset but --effort"),
        ({"coder": Coder.X264, "effort": "fast"}, "effort: 'fast': --coder x264 has no --effort"),
        ({"effort": "medium"}, "effort: 'medium' is none of fast, default, thorough"),
        ({"coder": Coder.X264, "preset": "placebo"}, "preset: 'placebo' is none of ultrafast"),
    ],
)
def test_coder_settings_that_contradict_each_other_are_refused(
    given: dict[str, object], problem: str
) -> None:
    with pytest.raises(InvalidInput, match=problem):
        CoderSettings(**given)  # type: ignore[arg-type]


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
