"""References in every mode and order; states that are named, kept, lost and returned to."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest

from codec.pictures import pair
from codec.sent_streams import exchange
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.references import INTRA, KEPT_FRAMES, RENDER_ONLY, EncoderState, Reference
from rfcore.codec.sender.encoder import DeltaEncoder, Encoded, FrameChoice
from rfcore.errors import InvalidInput, PacketRejected, RejectReason
from rfcore.image import I420
from rfcore.views import FieldView

SIZE_PX = (160, 96)
WALL_M = 10.0
TEMPORAL = [
    order
    for count in (1, 2, 3)
    for order in itertools.permutations(Reference, count)
    if order != RENDER_ONLY
]


@dataclass(frozen=True)
class Moment:
    """One frame of a drive along a wall: what the camera sees, and the field at its pose."""

    frame: I420
    view: FieldView


def moment(index: int, size_px: tuple[int, int] = SIZE_PX) -> Moment:
    """The camera moves so that the picture shifts by 2 px a frame: f x / z of a wall."""
    width, height = size_px
    frame, still = pair(width, height, 2.0 * index)
    k = Intrinsics(width, height, width, width, width / 2, height / 2)
    pose = Pose((2.0 * index * WALL_M / width, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    depth = np.full((height, width), WALL_M, np.float32)
    return Moment(frame, FieldView(Camera(k, pose), still.render, depth))


def send(
    encoder: DeltaEncoder, state: EncoderState, now: Moment, choice: FrameChoice | None = None
) -> Encoded:
    return encoder.encode(state, now.frame, now.view, choice or FrameChoice())


@pytest.fixture(scope="module")
def encoder() -> DeltaEncoder:
    return DeltaEncoder(CodecConfig(*SIZE_PX))


@pytest.fixture
def moments() -> list[Moment]:
    return [moment(index) for index in range(8)]


@pytest.mark.parametrize("references", [INTRA, RENDER_ONLY, *TEMPORAL])
def test_every_mode_and_order_reconstructs_exactly(encoder, moments, references):
    pictures = [(now.frame, now.view) for now in moments[:2]]
    _, second = exchange(encoder, pictures, [FrameChoice(), FrameChoice(references)])
    assert second.packet.references == references


@pytest.mark.parametrize(
    "size_px", [(2, 2), (3, 5), (16, 16), (18, 34), (101, 67), (300, 168), (641, 359)]
)
def test_three_references_work_at_any_size(size_px):
    three = FrameChoice((Reference.WARP, Reference.PREVIOUS, Reference.RENDER))
    pictures = [(now.frame, now.view) for now in (moment(i, size_px) for i in range(3))]
    encoder = DeltaEncoder(CodecConfig(*size_px, effort="fast"))
    exchange(encoder, pictures, [FrameChoice(), three, three])


@pytest.mark.slow
def test_three_references_work_at_the_largest_size():
    test_three_references_work_at_any_size((4096, 2304))


@pytest.mark.parametrize("reference", list(Reference))
def test_a_pose_only_packet_shows_the_reference_as_it_is(encoder, moments, reference):
    pictures = [(now.frame, now.view) for now in moments[:2]]
    choices = [FrameChoice(), FrameChoice((reference,), pose_only=True)]
    _, bare = exchange(encoder, pictures, choices)
    assert bare.packet.payload == b""
    if reference is Reference.RENDER:
        assert np.array_equal(bare.reconstruction.y, moments[1].view.render.y)


def test_the_states_of_a_stream_form_a_chain(encoder, moments):
    state, made = encoder.start(0), b""
    for now in moments[:4]:
        sent = send(encoder, state, now)
        assert sent.packet.base_digest == made
        made, state = sent.packet.reconstruction_digest, sent.state


def test_earlier_frames_save_bytes_where_the_field_knows_nothing(encoder, moments):
    """The cars are not in the render, but they were in the frame before."""
    first = send(encoder, encoder.start(0), moments[0])
    alone = send(encoder, first.state, moments[1], FrameChoice(RENDER_ONLY))
    both = send(encoder, first.state, moments[1], FrameChoice((Reference.WARP, Reference.RENDER)))
    assert len(both.packet.payload) < 0.8 * len(alone.packet.payload)


def test_a_frame_whose_base_was_lost_is_refused_and_rolling_back_heals_it(encoder, moments):
    decoder = DeltaDecoder(encoder.header)
    first = send(encoder, encoder.start(0), moments[0])
    lost = send(encoder, first.state, moments[1])
    late = send(encoder, lost.state, moments[2])
    got = decoder.decode(decoder.start(0), first.packet, moments[0].view)
    with pytest.raises(PacketRejected, match="none of the 1 kept here") as caught:
        decoder.decode(got.state, late.packet, moments[2].view)
    assert caught.value.reason == RejectReason.UNKNOWN_STATE
    back = replace(encoder.start(1), past=first.state.past)
    again = send(encoder, back, moments[3])
    assert again.packet.base_digest == first.packet.reconstruction_digest
    healed = decoder.decode(got.state, again.packet, moments[3].view)
    assert healed.frame.digest() == again.reconstruction.digest()


def test_the_receiver_keeps_a_bounded_number_of_frames(encoder, moments):
    decoder = DeltaDecoder(encoder.header)
    sending, receiving = encoder.start(0), decoder.start(0)
    first = None
    for now in moments[: KEPT_FRAMES + 1]:
        sent = send(encoder, sending, now)
        first = first or sent
        got = decoder.decode(receiving, sent.packet, now.view)
        sending, receiving = sent.state, got.state
    assert len(receiving.kept) == KEPT_FRAMES
    assert receiving.past(first.packet.reconstruction_digest) is None
    assert receiving.past(sent.packet.reconstruction_digest) is receiving.kept[0]


def test_between_inexact_renderers_only_the_render_is_taken(encoder, moments):
    decoder = DeltaDecoder(encoder.header, exact=False)
    first = send(encoder, encoder.start(0), moments[0])
    got = decoder.decode(decoder.start(0), first.packet, moments[0].view)
    second = send(encoder, first.state, moments[1])
    with pytest.raises(PacketRejected, match="only the render") as caught:
        decoder.decode(got.state, second.packet, moments[1].view)
    assert caught.value.reason == RejectReason.INVALID_ARGUMENT


@pytest.mark.parametrize("reference", [Reference.PREVIOUS, Reference.WARP, Reference.CORRECTION])
def test_the_first_frame_has_no_earlier_one_to_predict_from(encoder, moments, reference):
    with pytest.raises(InvalidInput, match="no earlier frame to predict from"):
        send(encoder, encoder.start(0), moments[0], FrameChoice((reference,)))


@pytest.mark.parametrize("reference", [Reference.WARP, Reference.CORRECTION])
def test_where_the_field_has_no_depth_what_is_carried_is_the_render(encoder, moments, reference):
    flat = [replace(now, view=replace(now.view, depth=0 * now.view.depth)) for now in moments]
    first = send(encoder, encoder.start(0), flat[0])
    bare = send(encoder, first.state, flat[1], FrameChoice((reference,), pose_only=True))
    for made, rendered in zip(bare.reconstruction.planes, flat[1].view.render.planes, strict=True):
        assert np.array_equal(made, rendered)


def test_a_kept_frame_drops_the_opacity_that_nobody_asks_for(encoder, moments):
    now = moments[0]
    opaque = replace(now.view, opacity=np.ones_like(now.view.depth))
    past = send(encoder, encoder.start(0), replace(now, view=opaque)).state.past
    assert past.view.opacity is None
    with pytest.raises(InvalidInput, match="opacity: was dropped"):
        _ = past.view.confidence


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"references": (Reference.RENDER, Reference.RENDER)}, "at most 4 different"),
        ({"references": (*Reference, Reference.RENDER)}, "at most 4 different"),
        ({"pose_only": True}, "exactly one"),
        ({"pose_only": True, "references": INTRA}, "exactly one"),
        ({"crf": 60.0}, "crf: 60"),
    ],
)
def test_choices_that_cannot_be_are_refused(change, named):
    with pytest.raises(InvalidInput, match=named):
        FrameChoice(**change)


def test_the_quality_of_a_frame_is_the_callers(encoder, moments):
    sizes = [
        len(send(encoder, encoder.start(0), moments[0], FrameChoice(crf=crf)).packet.payload)
        for crf in (18, 23, 30, 40)
    ]
    assert sizes == sorted(sizes, reverse=True)
    assert len(set(sizes)) == 4
