"""Renders under the light of an earlier frame: what is sent, decoded, refused, and left alone."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.packet import DeltaPacket
from rfcore.codec.references import RENDER_ONLY, Reference
from rfcore.codec.sender.encoder import DeltaEncoder, Encoded, FrameChoice, without_field
from rfcore.errors import InvalidInput, PacketRejected, RejectReason
from rfcore.image import I420
from rfcore.views import FieldView

PairMaker = Callable[..., tuple[I420, FieldView]]
EveningMaker = Callable[[I420, float], I420]
Street = Callable[[int], tuple[I420, FieldView]]
SIZE_PX = (320, 192)
FRAMES = 4
NEVER = FrameChoice(relight=False)


def encoder_of(size_px: tuple[int, int] = SIZE_PX) -> DeltaEncoder:
    return DeltaEncoder(CodecConfig(*size_px))


@pytest.fixture(scope="module")
def street(pair: PairMaker, evening: EveningMaker) -> Street:
    """Say what is seen of moment ``index``, and what the field shows: at dusk, against noon."""

    def at(index: int) -> tuple[I420, FieldView]:
        frame, view = pair(*SIZE_PX, 3.0 * index)
        return evening(frame, 1.0), view

    return at


def coded(encoder: DeltaEncoder, street: Street, choice: FrameChoice) -> list[Encoded]:
    state, made = encoder.start(1), []
    for index in range(FRAMES):
        made.append(encoder.encode(state, *street(index), choice))
        state = made[-1].state
    return made


def test_frames_under_another_light_are_relit_and_decode_as_promised(street: Street) -> None:
    encoder = encoder_of()
    relit, plain = (coded(encoder, street, choice) for choice in (FrameChoice(), NEVER))
    assert [made.packet.relit for made in relit] == [False] + [True] * (FRAMES - 1)
    assert not any(made.packet.relit for made in plain)
    for made, without in zip(relit[1:], plain[1:], strict=True):
        assert len(made.packet.payload) < 0.9 * len(without.packet.payload)
    decoder = DeltaDecoder(encoder.header)
    state = decoder.start(1)
    for index, made in enumerate(relit):
        decoded = decoder.decode(state, made.packet, street(index)[1])
        assert decoded.frame.digest() == made.reconstruction.digest()
        state = decoded.state


def test_the_right_light_costs_nothing(pair: PairMaker) -> None:
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


def test_a_lost_frame_costs_one_packet(street: Street) -> None:
    """The sender goes on from the frame that is known to have arrived."""
    encoder = encoder_of()
    first = encoder.encode(encoder.start(1), *street(0))
    lost = encoder.encode(first.state, *street(1))
    base = replace(lost.state, past=first.state.past)
    third = encoder.encode(base, *street(2))
    assert third.packet.relit
    decoder = DeltaDecoder(encoder.header)
    state = decoder.decode(decoder.start(1), first.packet, street(0)[1]).state
    decoded = decoder.decode(state, third.packet, street(2)[1])
    assert decoded.frame.digest() == third.reconstruction.digest()
    with pytest.raises(PacketRejected) as refused:
        decoder.decode(decoder.start(1), lost.packet, street(1)[1])
    assert refused.value.reason is RejectReason.UNKNOWN_STATE


def test_a_frame_that_may_need_nothing_but_its_render_is_not_relit(street: Street) -> None:
    encoder = encoder_of()
    first = encoder.encode(encoder.start(1), *street(0))
    alone = encoder.encode(first.state, *street(1), FrameChoice(RENDER_ONLY))
    assert not alone.packet.relit
    assert alone.packet.base_digest == b""
    lost = without_field(FrameChoice(relight=True), first.state)
    nothing = FieldView.nothing(street(1)[1].camera.intrinsics)
    assert not encoder.encode(first.state, street(1)[0], nothing, lost).packet.relit


def test_relighting_the_render_alone_still_names_the_frame_it_learns_from(street: Street) -> None:
    encoder = encoder_of()
    first = encoder.encode(encoder.start(1), *street(0))
    choice = FrameChoice(RENDER_ONLY, relight=True)
    second = encoder.encode(first.state, *street(1), choice)
    assert second.packet.references == RENDER_ONLY
    assert first.reconstruction.digest().startswith(second.packet.base_digest)
    decoder = DeltaDecoder(encoder.header)
    state = decoder.decode(decoder.start(1), first.packet, street(0)[1]).state
    decoded = decoder.decode(state, second.packet, street(1)[1])
    assert decoded.frame.digest() == second.reconstruction.digest()


def test_a_sender_without_an_earlier_frame_cannot_be_told_to(street: Street) -> None:
    encoder = encoder_of()
    with pytest.raises(InvalidInput, match="no earlier frame"):
        encoder.encode(encoder.start(1), *street(0), FrameChoice(relight=True))
    with pytest.raises(InvalidInput, match="relight"):
        FrameChoice(photometric=(4096,) * 12, relight=True)


def relit_packet(street: Street) -> DeltaPacket:
    return coded(encoder_of(), street, FrameChoice())[1].packet


def test_a_packet_is_relit_by_a_frame_or_changed_by_numbers(street: Street) -> None:
    packet = relit_packet(street)
    with pytest.raises(InvalidInput, match="relit"):
        replace(packet, photometric=(4096, 0, 0, 0, 0, 4096, 0, 0, 0, 0, 4096, 0))
    with pytest.raises(InvalidInput, match="base_digest"):
        replace(packet, references=(Reference.RENDER,), base_digest=b"")


def test_whether_a_packet_is_relit_is_under_its_crc(street: Street) -> None:
    encoder = encoder_of()
    made = coded(encoder, street, FrameChoice())
    decoder = DeltaDecoder(encoder.header)
    state = decoder.decode(decoder.start(1), made[0].packet, street(0)[1]).state
    for packet, reason in (
        (replace(made[1].packet, relit=False), RejectReason.CRC_MISMATCH),
        (replace(made[1].packet, relit=False).sealed(), RejectReason.RECONSTRUCTION_MISMATCH),
    ):
        with pytest.raises(PacketRejected) as refused:
            decoder.decode(state, packet, street(1)[1])
        assert refused.value.reason is reason


def test_a_receiver_whose_renderer_is_not_exact_refuses(street: Street) -> None:
    encoder = encoder_of()
    first = encoder.encode(encoder.start(1), *street(0), FrameChoice(block_means=True))
    choice = FrameChoice(RENDER_ONLY, relight=True, block_means=True)
    second = encoder.encode(first.state, *street(1), choice)
    decoder = DeltaDecoder(encoder.header, exact=False)
    state = decoder.decode(decoder.start(1), first.packet, street(0)[1]).state
    with pytest.raises(PacketRejected) as refused:
        decoder.decode(state, second.packet, street(1)[1])
    assert refused.value.reason is RejectReason.INVALID_ARGUMENT
