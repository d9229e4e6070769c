"""Both ends hold the same picture, at every size, for every frame, whatever the content."""

from itertools import product

import numpy as np
import pytest

from codec.pictures import flat, noise, pair, picture, view_of
from codec.sent_streams import exchange
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.bitstream import join_nals
from rfcore.codec.h264.config import CodecConfig, effort_of_preset
from rfcore.codec.h264.ffmpeg import H264Decoder, PictureKind, encode_pictures
from rfcore.codec.sender.encoder import DeltaEncoder
from rfcore.codec.sender.picture_coder import slice_options
from rfcore.errors import InvalidInput
from rfcore.image import I420

SIZES = [(2, 2), (3, 5), (16, 16), (18, 34), (300, 168), (301, 169), (720, 404), (2, 1000)]


def psnr_y_db(a: I420, b: I420) -> float:
    error = a.y.astype(float) - b.y
    return float(10 * np.log10(255**2 / np.mean(error**2)))


@pytest.mark.parametrize(("width_px", "height_px"), SIZES)
def test_the_receiver_gets_the_senders_reconstruction_on_every_frame(width_px, height_px):
    encoder = DeltaEncoder(CodecConfig(width_px, height_px))
    exchange(encoder, (pair(width_px, height_px, 3.0 * index) for index in range(4)))


@pytest.mark.parametrize(
    ("width_px", "height_px"), [(1920, 1080), pytest.param(4096, 2304, marks=pytest.mark.slow)]
)
def test_large_pictures_splice(width_px, height_px):
    frame, render = pair(width_px, height_px)
    encoder = DeltaEncoder(CodecConfig(width_px, height_px, effort="fast"))
    (encoded,) = exchange(encoder, [(frame, render)])
    assert psnr_y_db(encoded.reconstruction, frame) > psnr_y_db(render.render, frame) + 3


CONTENTS = ["street", "black", "white", "zero", "full", "noise"]


@pytest.mark.parametrize(
    ("crf", "effort"), [(1.0, "fast"), (51.0, "default"), (1.0, "x264-veryfast")]
)
@pytest.mark.parametrize(("seen", "rendered"), list(product(CONTENTS, CONTENTS)))
def test_any_frame_against_any_render_splices_at_extreme_quantisers(seen, rendered, crf, effort):
    make = {
        "street": lambda seed: picture(66, 50, seed),
        "black": lambda _: flat(66, 50, 16),
        "white": lambda _: flat(66, 50, 235),
        "zero": lambda _: flat(66, 50, 0),
        "full": lambda _: flat(66, 50, 255),
        "noise": lambda seed: noise(66, 50, seed),
    }
    frame, render = make[seen](1), view_of(make[rendered](2))
    (encoded,) = exchange(DeltaEncoder(CodecConfig(66, 50, effort, crf)), [(frame, render)])
    if crf == 1.0:
        assert np.abs(encoded.reconstruction.y.astype(int) - frame.y).mean() < 2


@pytest.mark.parametrize("crf", [18, 23, 28])
@pytest.mark.parametrize("preset", ["veryfast", "medium"])
def test_the_splice_loses_less_than_a_tenth_of_a_decibel_to_what_x264_meant(preset, crf):
    """It may gain: where nothing changed the splice shows the render itself, x264 a coded one."""
    frame, render = pair(320, 192)
    config = CodecConfig(320, 192, effort_of_preset(preset), crf)
    encoder = DeltaEncoder(config)
    encoded = encoder.encode(encoder.start(0), frame, render)
    units = encode_pictures(
        slice_options(config), [(render.render, PictureKind.I), (frame, PictureKind.P)]
    )
    assert join_nals([encoded.packet.payload]) == units[1]
    decoder = H264Decoder(config.coded_size_px)
    decoder.decode(units[0])
    meant = decoder.decode(units[1])
    assert psnr_y_db(encoded.reconstruction, frame) > psnr_y_db(meant, frame) - 0.1


def test_the_same_frames_give_the_same_packets():
    def run() -> list[object]:
        encoder = DeltaEncoder(CodecConfig(160, 90))
        made = exchange(encoder, (pair(160, 90, index) for index in range(3)))
        return [encoder.header, *(encoded.packet for encoded in made)]

    assert run() == run()


def test_any_receiver_takes_the_packets_of_an_encoder_of_two_threads():
    encoder = DeltaEncoder(CodecConfig(160, 90), threads=2)
    exchange(encoder, (pair(160, 90, index) for index in range(3)))
    with pytest.raises(InvalidInput, match="threads: 0"):
        DeltaEncoder(CodecConfig(160, 90), threads=0)


def test_a_packet_does_not_depend_on_the_frames_before_it():
    encoder = DeltaEncoder(CodecConfig(160, 90))
    state = encoder.start(1)
    first = encoder.encode(state, *pair(160, 90, 1)).packet
    encoder.encode(state, *pair(160, 90, 9))
    assert encoder.encode(state, *pair(160, 90, 1)).packet == first


def test_stage_times_come_from_the_clock_given():
    ticks = iter(range(0, 1000, 10))
    encoder = DeltaEncoder(CodecConfig(32, 32), clock_ns=lambda: next(ticks))
    frame, render = pair(32, 32)
    encoded = encoder.encode(encoder.start(0), frame, render)
    decoder = DeltaDecoder(encoder.header, clock_ns=lambda: next(ticks))
    decoded = decoder.decode(decoder.start(0), encoded.packet, render)
    assert encoded.stage_ns == {"references": 10, "encode": 10, "closed_loop": 10}
    assert decoded.stage_ns == {"references": 10, "splice": 10, "decode": 10}
