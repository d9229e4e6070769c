"""Renders under the light of an earlier frame: what is sent, decoded, refused, and left alone."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from codec.pictures import evening, noise, pair
from codec.sent_streams import exchange
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.photometric import sent_light
from rfcore.codec.references import RENDER_ONLY, Reference
from rfcore.codec.sender.encoder import DeltaEncoder, Encoded, FrameChoice, without_field
from rfcore.errors import InvalidInput, PacketRejected, RejectReason
from rfcore.image import I420
from rfcore.views import FieldView

SIZE_PX = (320, 192)
FRAMES = 4
NEVER = FrameChoice(relight=False)


def encoder_of(size_px: tuple[int, int] = SIZE_PX) -> DeltaEncoder:
    return DeltaEncoder(CodecConfig(*size_px))


def street(index: int) -> tuple[I420, FieldView]:
    """Return what is seen of moment ``index``, and what the field shows: at dusk, against noon."""
    frame, view = pair(*SIZE_PX, 3.0 * index)
    return evening(frame, 1.0), view


def coded(encoder: DeltaEncoder, choice: FrameChoice) -> list[Encoded]:
    return exchange(encoder, map(street, range(FRAMES)), [choice] * FRAMES)


def test_frames_under_another_light_are_relit_and_decode_as_promised():
    encoder = encoder_of()
    relit, plain = (coded(encoder, choice) for choice in (FrameChoice(), NEVER))
    assert [bool(made.packet.light) for made in relit] == [True] + [False] * (FRAMES - 1)
    assert all(made.packet.relit for made in relit)
    assert not any(made.packet.relit for made in plain)
    told, without = (
        sum(len(made.packet.payload) + len(made.packet.light) for made in stream)
        for stream in (relit, plain)
    )
    assert told < 0.9 * without


def test_no_light_is_sent_for_a_field_of_something_else():
    frame, view = street(0)
    encoder = encoder_of()
    elsewhere = replace(view, render=noise(*SIZE_PX, 3))
    assert not encoder.encode(encoder.start(1), frame, elsewhere).packet.light


def test_a_light_is_of_a_relit_frame_and_under_its_crc():
    encoder = encoder_of()
    packet = encoder.encode(encoder.start(1), *street(0)).packet
    with pytest.raises(InvalidInput, match=r"packet\.light"):
        replace(packet, relit=False)
    with pytest.raises(InvalidInput, match=r"packet\.light.*1025 bytes"):
        replace(packet, light=bytes(1025))
    with pytest.raises(InvalidInput, match="light"):
        FrameChoice(light=packet.light)
    decoder = DeltaDecoder(encoder.header)
    darker = sent_light(street(0)[1].render, street(0)[0])
    for light, reason in (
        (darker, RejectReason.RECONSTRUCTION_MISMATCH),
        (b"\x04\x00", RejectReason.INVALID_ARGUMENT),
    ):
        with pytest.raises(PacketRejected) as refused:
            decoder.decode(decoder.start(1), replace(packet, light=light), street(0)[1])
        assert refused.value.reason is reason


def test_the_right_light_costs_nothing():
    encoder = encoder_of()
    states = [encoder.start(1)] * 2
    for index in range(3):
        given = pair(*SIZE_PX, 3.0 * index)
        both = [
            encoder.encode(states[0], *given),
            encoder.encode(states[1], *given, NEVER),
        ]
        assert both[0].packet == both[1].packet
        states = [made.state for made in both]


def test_a_frame_that_may_need_nothing_but_its_render_is_not_relit():
    encoder = encoder_of()
    first = encoder.encode(encoder.start(1), *street(0))
    alone = encoder.encode(first.state, *street(1), FrameChoice(RENDER_ONLY))
    assert not alone.packet.relit
    assert alone.packet.base_digest == b""
    lost = without_field(FrameChoice(relight=True), first.state)
    nothing = FieldView.nothing(street(1)[1].camera.intrinsics)
    assert not encoder.encode(first.state, street(1)[0], nothing, lost).packet.relit


def test_relighting_the_render_alone_still_names_the_frame_it_learns_from():
    choices = [FrameChoice(), FrameChoice(RENDER_ONLY, relight=True)]
    first, second = exchange(encoder_of(), map(street, range(2)), choices)
    assert second.packet.references == RENDER_ONLY
    assert first.reconstruction.digest().startswith(second.packet.base_digest)


def test_a_sender_without_an_earlier_frame_cannot_be_told_to():
    encoder = encoder_of()
    with pytest.raises(InvalidInput, match="no earlier frame"):
        encoder.encode(encoder.start(1), *street(0), FrameChoice(relight=True))
    with pytest.raises(InvalidInput, match="relight"):
        FrameChoice(photometric=(4096,) * 12, relight=True)


def test_a_packet_is_relit_by_a_frame_or_changed_by_numbers():
    packet = coded(encoder_of(), FrameChoice())[1].packet
    with pytest.raises(InvalidInput, match="relit"):
        replace(packet, photometric=(4096, 0, 0, 0, 0, 4096, 0, 0, 0, 0, 4096, 0))
    with pytest.raises(InvalidInput, match="base_digest"):
        replace(packet, references=(Reference.RENDER,), base_digest=b"")


def test_a_receiver_whose_renderer_is_not_exact_refuses():
    encoder = encoder_of()
    first = encoder.encode(encoder.start(1), *street(0), FrameChoice(block_means=True))
    choice = FrameChoice(RENDER_ONLY, relight=True, block_means=True)
    second = encoder.encode(first.state, *street(1), choice)
    decoder = DeltaDecoder(encoder.header, exact=False)
    state = decoder.decode(decoder.start(1), first.packet, street(0)[1]).state
    with pytest.raises(PacketRejected) as refused:
        decoder.decode(state, second.packet, street(1)[1])
    assert refused.value.reason is RejectReason.INVALID_ARGUMENT


# --- light that changes during the drive

SMALL_PX = (160, 96)
CRFS = (22.0, 30.0)
MESSAGE_BYTES = 100
"""Approximate size of a frame's message without its slice."""
WINDOW = 20
OFF = FrameChoice(photometric=(), relight=False)
NOISE = 1.01
"""Bits of ``auto`` over those of ``off`` at equal quality, in any ``WINDOW`` frames."""
Light = Callable[[I420, int], I420]


def gained(picture: I420, gain: NDArray[np.float64] | float) -> I420:
    """Return a picture whose luma is exposed otherwise, everywhere or column by column."""
    y = (picture.y - 16.0) * gain + 16
    return I420(np.clip(np.rint(y), 1, 235).astype(np.uint8), picture.u, picture.v)


def passing_cloud(picture: I420, index: int) -> I420:
    """A shadow's edge enters at frame 20, another one leaves at frame 70; 30 frames take each."""
    x = np.linspace(0, 1, picture.size_px[0])
    entered, left = (
        1 / (1 + np.exp(12 * (x - ((index - start) / 30 * 1.8 - 0.4)))) for start in (20, 70)
    )
    return gained(picture, 1 - 0.4 * (entered - left)[None, :])


def hunting(picture: I420, index: int) -> I420:
    """Exposure swings by 15 % around the right one, once in 14 frames."""
    return gained(picture, 1 + 0.15 * math.sin(2 * math.pi * index / 14))


def tunnel(picture: I420, index: int) -> I420:
    """From frame 20 to 80 it is dark, and the exposure answers late, in and out."""
    inside = 0.25 + 0.35 * (1 - math.exp(-(index - 20) / 8))
    behind = 1 + 0.8 * math.exp(-(index - 80) / 4)
    return gained(picture, 1.0 if index < 20 else inside if index < 80 else behind)


@dataclass(frozen=True)
class Sweep:
    """A drive whose light changes.

    ``passings``: how often it passes the threshold from which on a change is looked for. Decisions
    flap if they change more often than that and the two times that noise at a passing may add.
    """

    light: Light | None
    frames: int
    passings: int
    most_percent: float
    """Bits of the whole drive at equal quality, of those of ``off``."""


SWEEPS = {
    "the light fades": Sweep(None, 300, 1, 50),
    "a cloud passes": Sweep(passing_cloud, 120, 2, 65),
    "exposure hunts": Sweep(hunting, 84, 24, 60),
    "a tunnel": Sweep(tunnel, 110, 4, 40),
}


@dataclass(frozen=True)
class CodedSweep:
    """Bytes and squared errors [CRFs, frames]; which frames were relit, at the lower CRF."""

    size_bytes: NDArray[np.float64]
    errors: NDArray[np.float64]
    relit: NDArray[np.bool_]

    def log_bytes(self, frames: slice, psnr_db: float) -> float:
        sizes, qualities = self.size_bytes[:, frames].mean(axis=1), self.psnr_db(frames)
        order = np.argsort(qualities)
        return float(np.interp(psnr_db, qualities[order], np.log(sizes[order])))

    def psnr_db(self, frames: slice) -> NDArray[np.float64]:
        return 10 * np.log10(255.0**2 / self.errors[:, frames].mean(axis=1))


def swept(moments: Sequence[tuple[I420, FieldView]], choice: FrameChoice) -> CodedSweep:
    sizes, errors = np.zeros((2, len(CRFS), len(moments)))
    relit = np.zeros(len(moments), bool)
    for row, crf in enumerate(CRFS):
        encoder = DeltaEncoder(CodecConfig(*SMALL_PX, crf=crf))
        state = encoder.start(1)
        for index, (frame, view) in enumerate(moments):
            made = encoder.encode(state, frame, view, choice)
            state = made.state
            sizes[row, index] = MESSAGE_BYTES + len(made.packet.payload)
            errors[row, index] = np.mean((frame.y.astype(float) - made.reconstruction.y) ** 2)
            if row == 0:
                relit[index] = made.packet.relit
    return CodedSweep(sizes, errors, relit)


def bits_ratio(auto: CodedSweep, off: CodedSweep, frames: slice) -> float:
    """Return bits of ``auto`` over those of ``off`` at a quality that both reach."""
    both = [one.psnr_db(frames) for one in (auto, off)]
    middle = (max(q.min() for q in both) + min(q.max() for q in both)) / 2
    return math.exp(auto.log_bytes(frames, middle) - off.log_bytes(frames, middle))


@pytest.mark.parametrize("name", SWEEPS)
def test_light_that_changes_never_costs_more_than_off_and_no_decision_flaps(name):
    sweep = SWEEPS[name]
    light = sweep.light or (lambda picture, index: evening(picture, index / sweep.frames))
    given = [pair(*SMALL_PX, 1.5 * index) for index in range(sweep.frames)]
    moments = [(light(frame, index), view) for index, (frame, view) in enumerate(given)]
    auto, off = (swept(moments, choice) for choice in (FrameChoice(), OFF))
    for start in range(0, sweep.frames - WINDOW + 1, WINDOW // 2):
        assert bits_ratio(auto, off, slice(start, start + WINDOW)) < NOISE, start
    assert 100 * bits_ratio(auto, off, slice(None)) < sweep.most_percent
    assert np.count_nonzero(np.diff(auto.relit)) <= sweep.passings + 2
    assert auto.relit.any()
    assert not auto.relit.all()


def test_a_lost_frame_costs_one_packet_while_the_light_fades():
    """Every fifth frame is lost; the sender goes on from the last one that arrived."""
    encoder = DeltaEncoder(CodecConfig(*SMALL_PX))
    decoder = DeltaDecoder(encoder.header)
    state, receiving = encoder.start(1), decoder.start(1)
    relit = 0
    for index in range(40):
        frame, view = pair(*SMALL_PX, 1.5 * index)
        made = encoder.encode(state, evening(frame, 0.2 + index / 60), view)
        if index % 5 == 4:
            state = replace(made.state, past=state.past)
            continue
        decoded = decoder.decode(receiving, made.packet, view)
        assert decoded.lost == (1 if index % 5 == 0 and index else 0)
        assert decoded.frame.digest() == made.reconstruction.digest()
        relit += made.packet.relit
        state, receiving = made.state, decoded.state
    assert relit == 31, "all that arrived but the first"
