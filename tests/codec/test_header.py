"""One header serves every effort and CRF of a size, and receivers take no other."""

import hashlib
from dataclasses import replace

import pytest

from codec.pictures import pair
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.bitstream import StreamHeader, check_header, stream_header
from rfcore.codec.h264.config import EFFORTS, PRESETS, CodecConfig, Coder, CoderSettings
from rfcore.codec.h264.splice import pcm_pps
from rfcore.codec.sender.encoder import DeltaEncoder
from rfcore.codec.sender.picture_coder import SliceCoding, encode_slice
from rfcore.errors import CodecError, InvalidInput
from rfcore.image import I420

OWN, X264 = CodecConfig(300, 168), CodecConfig(300, 168, "x264-medium")


@pytest.fixture(scope="module", params=[OWN, X264], ids=["own", "x264"])
def header(request: pytest.FixtureRequest) -> StreamHeader:
    return DeltaEncoder(request.param).header


def test_every_effort_and_crf_has_the_same_parameter_sets():
    """Golden: receivers in the field accept these bytes and no others."""
    for effort in ("fast", "default", "thorough"):
        for crf in (1.0, 23.0, 51.0):
            made = DeltaEncoder(CodecConfig(300, 168, effort, crf)).header
            assert made.sps.hex() == "6764000dacb28262fdcb35010101a41e10084b"
            assert made.pps.hex() == "68eb8f2c"


def test_the_parameter_sets_of_all_sizes_keep_their_bytes():
    sizes = [(2, 2), (3, 2), (17, 33), (640, 360), (1280, 720), (1920, 1080), (4096, 2304)]
    headers = [stream_header(CodecConfig(*size_px)) for size_px in sizes]
    digest = hashlib.sha256(b"".join(header.sps + header.pps for header in headers))
    assert digest.hexdigest()[:16] == "1c012b87e2297135"


SIZES = [(2, 2), (17, 33), (300, 168), (640, 360), (1280, 720), (1920, 1080), (4096, 2304)]


@pytest.mark.parametrize("size_px", SIZES)
def test_x264_writes_the_sets_that_are_expected_of_it(size_px):
    """Or ``encode_slice`` raises."""
    grey = I420.filled(size_px)
    assert encode_slice(CodecConfig(*size_px, "x264-ultrafast"), [grey], grey)


@pytest.mark.parametrize("preset", PRESETS)
def test_no_preset_crf_number_of_references_or_threads_changes_the_sets_of_x264(preset):
    frame, view = pair(300, 168)
    for crf, references in zip((1, 17.5, 23, 51), range(4), strict=True):
        config = CodecConfig(300, 168, f"x264-{preset}", crf)
        assert encode_slice(config, [view.render] * references, frame)
    pictures = [pair(300, 168, 2.0)[0], pair(300, 168, 1.0)[1].render, view.render]
    config = CodecConfig(300, 168, f"x264-{preset}", 28)
    alone, shared, again = (
        encode_slice(config, pictures, frame, SliceCoding(threads=threads)) for threads in (1, 2, 2)
    )
    assert shared == again
    assert len(shared) == pytest.approx(len(alone), rel=0.02)


def test_other_sets_than_those_that_are_expected_of_x264_are_refused(monkeypatch):
    monkeypatch.setattr("rfcore.codec.sender.picture_coder.X264_REFERENCE_FRAMES", 4)
    with pytest.raises(CodecError, match="other parameter sets than it was configured for"):
        DeltaEncoder(X264)


def test_a_better_preset_or_crf_changes_the_slice():
    """The zone's analysis settings reach the P picture, and CRF its quantiser."""
    frame, view = pair(300, 168)

    def coded(preset: str, crf: float) -> bytes:
        config = CodecConfig(300, 168, f"x264-{preset}", crf)
        return encode_slice(config, [view.render], frame)

    sizes = [len(coded("medium", crf)) for crf in (18, 23, 28)]
    assert sizes == sorted(sizes, reverse=True)
    assert len({coded(preset, 23) for preset in PRESETS}) >= len(PRESETS) - 1


def test_x264_takes_no_fourth_reference():
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
def test_levels_are_the_lowest_that_annex_a_allows(width_px, height_px, level_idc):
    assert CodecConfig(width_px, height_px).level_idc == level_idc


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"width_px": 320}, "sps"),
        ({"width_px": 302}, "sps"),
        ({"sps": b""}, "sps"),
        ({"pps": b"\x68"}, "pps"),
        ({"pps": pcm_pps()}, "pps"),
    ],
)
def test_a_header_that_our_encoder_would_not_make_is_refused(header, change, name):
    if "width_px" in change:
        change = {"config": replace(header.config, **change)}
    with pytest.raises(InvalidInput, match=rf"stream_header\.{name}: .* where our encoder"):
        DeltaDecoder(replace(header, **change))


def test_the_header_of_one_coder_is_refused_as_that_of_the_other():
    for config, theirs in ((OWN, X264), (X264, OWN)):
        with pytest.raises(InvalidInput, match=r"stream_header\.sps"):
            DeltaDecoder(replace(stream_header(theirs), config=config))


def test_every_flipped_bit_of_a_header_is_refused(header):
    for name in ("sps", "pps"):
        nal = getattr(header, name)
        for bit in range(8 * len(nal)):
            damaged = bytearray(nal)
            damaged[bit // 8] ^= 0x80 >> bit % 8
            with pytest.raises(InvalidInput):
                check_header(replace(header, **{name: bytes(damaged)}))


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
def test_configurations_outside_the_lists_are_refused(change, named):
    good: dict[str, object] = {"width_px": 640, "height_px": 360}
    with pytest.raises(InvalidInput, match=named):
        CodecConfig(**{**good, **change})


@pytest.mark.parametrize("effort", EFFORTS)
def test_an_effort_survives_the_command_line(effort):
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
def test_coder_settings_that_contradict_each_other_are_refused(given, problem):
    with pytest.raises(InvalidInput, match=problem):
        CoderSettings(**given)
