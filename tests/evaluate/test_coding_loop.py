"""The loop of whoever codes a clip in one process: order, states, losses and promises."""

from dataclasses import replace

import numpy as np
import pytest

from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.references import RENDER_ONLY
from rfcore.codec.sender.encoder import DeltaEncoder, FrameChoice
from rfcore.errors import CodecError, PacketRejected
from rfcore.field import load_field, render_field_view
from rfcore.image import I420
from rfedge.evaluate.clips import read_drive
from rfedge.offline import (
    FrameInput,
    decode_frames,
    decode_promised,
    encode_frames,
)

CONFIG = CodecConfig(96, 64, effort="fast", crf=28.0)


@pytest.fixture(scope="module")
def inputs(thumbnail):
    drive, field = read_drive(thumbnail.drive), load_field(thumbnail.field)
    pairs = zip(drive.frames, drive.cameras, strict=True)
    return [FrameInput(frame, render_field_view(field, camera)) for frame, camera in pairs]


@pytest.fixture
def encoder():
    return DeltaEncoder(CONFIG)


@pytest.fixture
def decoder(encoder):
    return DeltaDecoder(encoder.header)


def digests(pictures):
    return [None if picture is None else picture.digest() for picture in pictures]


def test_frames_are_numbered_and_need_the_one_before(encoder, inputs):
    packets = [frame.encoded.packet for frame in encode_frames(encoder, inputs)]
    assert [packet.sequence for packet in packets] == list(range(len(inputs)))
    assert packets[0].base_digest != packets[1].base_digest


def test_an_input_is_asked_for_when_its_frame_is_coded(encoder, inputs):
    asked = []

    def lazily():
        for index, given in enumerate(inputs):
            asked.append(index)
            yield given

    coded = encode_frames(encoder, lazily())
    assert asked == []
    next(coded)
    assert asked == [0]


def test_frame_by_frame_and_clip_by_clip_give_the_same(encoder, decoder, inputs):
    """Whether a frame is decoded before the next is coded changes neither bytes nor pictures."""
    whole = list(encode_frames(encoder, inputs))
    one_by_one = list(decode_promised(decoder, encode_frames(DeltaEncoder(CONFIG), inputs)))
    at_once = list(decode_promised(DeltaDecoder(encoder.header), whole))
    assert [f.encoded.packet for f, _ in one_by_one] == [f.encoded.packet for f in whole]
    assert digests(p for _, p in one_by_one) == digests(p for _, p in at_once)


def test_a_frame_is_decoded_before_the_next_one_is_coded(encoder, decoder, inputs):
    asked = []

    def lazily():
        for index, given in enumerate(inputs):
            asked.append(index)
            yield given

    for count, _ in enumerate(decode_promised(decoder, encode_frames(encoder, lazily())), 1):
        assert asked == list(range(count))


def test_the_receiver_shows_what_the_sender_holds(encoder, decoder, inputs):
    for frame, picture in decode_promised(decoder, encode_frames(encoder, inputs)):
        assert picture.digest() == frame.encoded.reconstruction.digest()


def test_another_picture_than_was_promised_is_an_error_that_names_the_frame(
    encoder, decoder, inputs
):
    coded = list(encode_frames(encoder, inputs))
    black = I420(*(np.full_like(plane, 16) for plane in inputs[0].frame.planes))
    coded[2] = replace(coded[2], encoded=replace(coded[2].encoded, reconstruction=black))
    with pytest.raises(CodecError, match="frame 2 decodes to another picture"):
        list(decode_promised(decoder, coded))


def test_a_lost_frame_shows_nothing_and_ends_what_needs_it(encoder, decoder, inputs):
    arrivals = [frame.arrival for frame in encode_frames(encoder, inputs)]
    arrivals[1] = None
    shown = list(decode_frames(decoder, arrivals, skip_rejected=True))
    assert [picture is not None for picture in shown] == [True, False, False, False, False]
    with pytest.raises(PacketRejected):
        list(decode_frames(DeltaDecoder(encoder.header), arrivals))


def test_a_lost_frame_that_nobody_needs_is_the_only_one_missing(encoder, decoder, inputs):
    alone = [replace(given, choice=FrameChoice(references=RENDER_ONLY)) for given in inputs]
    coded = list(encode_frames(encoder, alone))
    arrivals = [frame.arrival for frame in coded]
    arrivals[1] = None
    shown = digests(decode_frames(decoder, arrivals))
    promised = [frame.encoded.reconstruction.digest() for frame in coded]
    assert shown == [promised[0], None, *promised[2:]]


def test_the_choice_of_each_frame_is_its_own(encoder, inputs):
    choices = [FrameChoice(references=RENDER_ONLY), FrameChoice()]
    given = [replace(each, choice=choices[k % 2]) for k, each in enumerate(inputs)]
    used = [frame.encoded.packet.references for frame in encode_frames(encoder, given)]
    assert used[::2] == [RENDER_ONLY] * 3
    assert all(references != RENDER_ONLY for references in used[1::2])
