"""Both coders behind one interface: one CRF, one quality; ours needs neither x264 nor a decoder."""

from dataclasses import replace

import av
import numpy as np
import pytest

from codec.pictures import pair
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264 import ffmpeg
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.h264.splice import SpliceDecoder
from rfcore.codec.sender.encoder import DeltaEncoder, Encoded
from rfcore.codec.sender.picture_coder import CodedPicture, CodingRequest, picture_coder
from rfcore.errors import CodecError, InvalidInput
from rfcore.image import I420
from rfcore.views import FieldView

SIZE_PX = (320, 192)
EFFORTS = ("fast", "default", "thorough")


def psnr_db(picture: I420, frame: I420) -> float:
    return 10 * np.log10(255**2 / np.mean((picture.y.astype(float) - frame.y) ** 2))


def coded(effort: str, crf: float, pictures: tuple[I420, FieldView]) -> Encoded:
    encoder = DeltaEncoder(CodecConfig(*SIZE_PX, effort, crf))
    return encoder.encode(encoder.start(0), *pictures)


@pytest.mark.parametrize("crf", [20.0, 26.0, 32.0])
def test_a_crf_means_about_the_quality_it_means_to_x264(crf):
    """Within a step of the quantiser, half a decibel; on the sample drives within 0.1 dB, which
    ``QP_OF_CRF`` is from."""
    pictures = pair(*SIZE_PX)
    ours, theirs = (
        psnr_db(coded(effort, crf, pictures).reconstruction, pictures[0])
        for effort in ("default", "x264-medium")
    )
    assert ours == pytest.approx(theirs, abs=0.6)


def test_bits_fall_with_the_crf_in_small_steps():
    pictures = pair(*SIZE_PX)
    sizes = [len(coded("default", crf, pictures).packet.payload) for crf in np.arange(20, 24, 0.25)]
    steps = np.diff(np.log2(sizes))
    assert steps.mean() < -0.02
    assert np.abs(steps).max() < 0.2  # a slice of 2 kB; a whole step of the quantiser is 0.25


@pytest.mark.parametrize("effort", EFFORTS)
def test_what_our_coder_promises_is_what_a_decoder_makes(effort):
    config = CodecConfig(*SIZE_PX, effort)
    checking, plain = DeltaEncoder(config, check_decode=True), DeltaEncoder(config)
    states = [checking.start(0), plain.start(0)]
    for index in range(4):
        made = [
            encoder.encode(state, *pair(*SIZE_PX, 2.0 * index))
            for encoder, state in zip((checking, plain), states, strict=True)
        ]
        states = [encoded.state for encoded in made]
        assert made[0].packet == made[1].packet


def test_a_coder_that_promises_another_picture_is_found_out(monkeypatch):
    encoder = DeltaEncoder(CodecConfig(*SIZE_PX), check_decode=True)
    code = encoder._coder.code

    def wrong(frame: I420, references: list[I420], request: CodingRequest) -> CodedPicture:
        made = code(frame, references, request)
        y = made.reconstruction.y.copy()
        y[5, 5] ^= 1
        return replace(made, reconstruction=replace(made.reconstruction, y=y))

    monkeypatch.setattr(encoder._coder, "code", wrong)
    with pytest.raises(CodecError, match="another picture of the slice than its coder"):
        encoder.encode(encoder.start(0), *pair(*SIZE_PX))


def test_our_coder_decodes_nothing_and_opens_no_encoder(monkeypatch):
    """As in a runtime whose FFmpeg has no x264; the receiver opens a decoder and nothing else."""
    create = av.VideoCodecContext.create

    def without_x264(name: str, mode: str) -> av.CodecContext:
        assert (name, mode) == ("h264", "r")
        return create(name, mode)

    monkeypatch.setattr(ffmpeg.av.VideoCodecContext, "create", without_x264)
    monkeypatch.setattr(SpliceDecoder, "predict_from", lambda *_: pytest.fail("the sender decodes"))
    frame, view = pair(*SIZE_PX)
    encoder = DeltaEncoder(CodecConfig(*SIZE_PX))
    made = encoder.encode(encoder.start(0), frame, view)
    monkeypatch.undo()
    monkeypatch.setattr(ffmpeg.av.VideoCodecContext, "create", without_x264)
    decoder = DeltaDecoder(encoder.header)
    shown = decoder.decode(decoder.start(0), made.packet, view)
    assert shown.frame.digest() == made.reconstruction.digest()
    with pytest.raises(AssertionError):
        DeltaEncoder(CodecConfig(*SIZE_PX, "x264-medium"))


@pytest.mark.parametrize(("effort", "other"), [("fast", "x264-fast"), ("x264-fast", "fast")])
def test_an_effort_of_the_other_coder_is_refused(effort, other):
    frame, view = pair(*SIZE_PX)
    coder = picture_coder(CodecConfig(*SIZE_PX, effort))
    with pytest.raises(InvalidInput, match=f"'{other}' is none of the stream's coder"):
        coder.code(frame, [view.render], CodingRequest(23, other))
