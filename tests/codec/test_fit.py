"""No slice above its limit: the machine by itself on models of a rate, and our coder on noise."""

import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from codec.pictures import noise, view_of
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.sender.encoder import DeltaEncoder, FrameChoice
from rfcore.codec.sender.picture_coder import CodedPicture
from rfcore.codec.sender.rate import MAX_TRIES, code_to_fit
from rfcore.errors import InvalidInput

SIZE_PX = (160, 96)


def halving(first_bytes: int, crf_to_halve: float) -> Callable[[float], CodedPicture]:
    return lambda crf: CodedPicture(
        bytes(max(1, round(first_bytes * 2 ** ((23 - crf) / crf_to_halve))))
    )


@given(
    first_bytes=st.integers(1, 200_000),
    crf_to_halve=st.floats(3, 40),
    limit_bytes=st.integers(1, 50_000),
    crf=st.floats(1, 51),
)
def test_whatever_the_rate_it_fits_if_the_highest_crf_does(
    first_bytes, crf_to_halve, limit_bytes, crf
):
    code = halving(first_bytes, crf_to_halve)
    made = code_to_fit(code, crf, limit_bytes)
    assert made.tries <= MAX_TRIES
    assert made.coded == code(made.crf)
    assert crf <= made.crf <= 51
    assert (len(made.coded.payload) <= limit_bytes) or made.crf == 51
    if len(code(crf).payload) <= limit_bytes:
        assert (made.crf, made.tries) == (crf, 1)


@given(first_bytes=st.integers(20_000, 200_000), crf_to_halve=st.floats(6, 20))
def test_a_steady_rate_takes_three_codings_and_wastes_a_tenth(first_bytes, crf_to_halve):
    """The second step knows the slope; it aims at 0.95, and the least step, 1 CRF, may
    take 11 % more where 6 halve."""
    limit_bytes = first_bytes // 2
    made = code_to_fit(halving(first_bytes, crf_to_halve), 23, limit_bytes)
    assert made.tries <= 3
    assert 0.94 * 2 ** (-1 / 6) < len(made.coded.payload) / limit_bytes <= 1
    assert made.crf <= 23 + crf_to_halve * (1 + math.log2(1 / 0.95)) + 1.01


@pytest.mark.parametrize("share", [0.9, 0.5, 0.3])
def test_noise_is_coded_again_until_it_fits_and_decodes(share):
    frame, render = noise(*SIZE_PX, 1), view_of(noise(*SIZE_PX, 2))
    encoder = DeltaEncoder(CodecConfig(*SIZE_PX))
    free = encoder.encode(encoder.start(0), frame, render)
    limit_bytes = int(share * len(free.packet.payload))
    made = encoder.encode(
        encoder.start(0), frame, render, choice=FrameChoice(limit_bytes=limit_bytes)
    )
    assert free.tries == 1
    assert 1 < made.tries <= MAX_TRIES
    assert len(made.packet.payload) <= limit_bytes
    decoder = DeltaDecoder(encoder.header)
    shown = decoder.decode(decoder.start(0), made.packet, render)
    assert shown.frame.digest() == made.reconstruction.digest()


def test_what_no_crf_makes_fit_comes_back_too_long():
    frame, view = noise(*SIZE_PX, 1), view_of(noise(*SIZE_PX, 2))
    encoder = DeltaEncoder(CodecConfig(*SIZE_PX, effort="fast"))
    choice = FrameChoice(limit_bytes=1)
    made = encoder.encode(encoder.start(0), frame, view, choice=choice)
    assert len(made.packet.payload) > 1
    at_the_highest = encoder.encode(
        encoder.start(0),
        frame,
        view,
        choice=FrameChoice(
            made.packet.references,
            crf=51,
            photometric=made.packet.photometric,
            relight=made.packet.relit,
            light=made.packet.light,
        ),
    )
    assert made.packet.payload == at_the_highest.packet.payload


def test_a_limit_below_one_byte_is_refused():
    with pytest.raises(InvalidInput, match="limit_bytes: 0"):
        FrameChoice(limit_bytes=0)
