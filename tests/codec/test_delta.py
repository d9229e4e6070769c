"""Each check of the receiver, in its order, with the reason it gives; and inexact renderers."""

from dataclasses import replace

import numpy as np
import pytest

from codec.pictures import flat, noise, pair, picture, view_of
from codec.sent_streams import exchange
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.references import RENDER_ONLY, Reference
from rfcore.codec.sender.encoder import DeltaEncoder, Encoded, FrameChoice
from rfcore.errors import InvalidInput, PacketRejected, RejectReason
from rfcore.image import I420
from rfcore.views import FieldView

SIZE_PX = (160, 96)


@pytest.fixture(scope="module")
def encoder() -> DeltaEncoder:
    return DeltaEncoder(CodecConfig(*SIZE_PX))


@pytest.fixture(scope="module")
def sent(encoder: DeltaEncoder) -> Encoded:
    state = replace(encoder.start(5), next_sequence=10)
    return encoder.encode(state, *pair(*SIZE_PX), choice=FrameChoice(block_means=True))


def perturbed(view: FieldView, seed: int = 0) -> FieldView:
    """Move every sample of the render by -1, 0 or +1 level."""
    rng = np.random.default_rng(seed)
    y, u, v = (
        np.clip(p.astype(np.int16) + rng.integers(-1, 2, p.shape), 0, 255).astype(np.uint8)
        for p in view.render.planes
    )
    return replace(view, render=I420(y, u, v))


def psnr_y_db(a: I420, b: I420) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.y.astype(float) - b.y) ** 2)))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"epoch": 4, "sequence": 3, "payload": b""}, RejectReason.STALE_EPOCH),
        ({"sequence": 9, "payload": b""}, RejectReason.STALE_SEQUENCE),
        ({"render_digest": bytes(2), "payload": b""}, RejectReason.RENDER_MISMATCH),
        ({"render_digest": bytes(2), "payload": b"\x65"}, RejectReason.RENDER_MISMATCH),
        (
            {
                "render_digest": bytes(2),
                "references": (Reference.PREVIOUS,),
                "base_digest": b"nobody",
            },
            RejectReason.RENDER_MISMATCH,
        ),
        ({"payload": b""}, RejectReason.RECONSTRUCTION_MISMATCH),
        ({"payload": b"\x41"}, RejectReason.MALFORMED_PAYLOAD),
        ({"payload": b"\x41\x9a\x22"}, RejectReason.DECODER_FAILED),
        ({"reconstruction_digest": bytes(6)}, RejectReason.RECONSTRUCTION_MISMATCH),
    ],
)
def test_the_first_check_that_fails_gives_the_reason(encoder, sent, change, reason):
    decoder = DeltaDecoder(encoder.header)
    state = replace(decoder.start(5), next_sequence=10)
    packet = replace(sent.packet, **change)
    _, render = pair(*SIZE_PX)
    with pytest.raises(PacketRejected) as caught:
        decoder.decode(state, packet, render)
    assert caught.value.reason == reason
    good = decoder.decode(state, sent.packet, render)
    assert good.frame.digest() == sent.reconstruction.digest()


@pytest.mark.parametrize("nal_type", [0, 2, 5, 6, 7, 8, 9, 20, 31])
def test_only_slices_of_predicted_pictures_reach_the_decoder(encoder, sent, nal_type):
    decoder = DeltaDecoder(encoder.header)
    payload = bytes([0x60 | nal_type]) + sent.packet.payload[1:]
    packet = replace(sent.packet, payload=payload)
    with pytest.raises(PacketRejected, match=rf"NAL unit type {nal_type} is not a P picture"):
        decoder.decode(decoder.start(5), packet, pair(*SIZE_PX)[1])


@pytest.mark.parametrize("start_code", [b"\0\0\1", b"\0\0\0\1"])
def test_a_second_nal_unit_in_the_payload_is_refused(encoder, sent, start_code):
    decoder = DeltaDecoder(encoder.header)
    payload = sent.packet.payload + start_code + encoder.header.sps
    with pytest.raises(PacketRejected, match="start code") as caught:
        decoder.decode(decoder.start(5), replace(sent.packet, payload=payload), pair(*SIZE_PX)[1])
    assert caught.value.reason == RejectReason.MALFORMED_PAYLOAD


def test_lost_packets_are_counted_and_the_rest_decodes(encoder, sent):
    decoder = DeltaDecoder(encoder.header)
    decoded = decoder.decode(decoder.start(5), sent.packet, pair(*SIZE_PX)[1])
    assert (decoded.lost, decoded.state.next_sequence) == (10, 11)
    with pytest.raises(PacketRejected, match="sequence 10 where 11 or later"):
        decoder.decode(decoded.state, sent.packet, pair(*SIZE_PX)[1])


def test_an_inexact_receiver_takes_rounding_and_loses_little(encoder, sent):
    """+-1 level of the render is noise of variance 2/3; where the P slice corrects nothing it adds
    to the error. At 255**2 / (2/3) that is 49.9 dB, so a frame of q dB keeps at least
    -10 log10(10**(-q/10) + 10**(-4.99)) before motion compensation, which only averages."""
    frame, render = pair(*SIZE_PX)
    decoder = DeltaDecoder(encoder.header, exact=False)
    decoded = decoder.decode(decoder.start(5), sent.packet, perturbed(render))
    exact_db = psnr_y_db(sent.reconstruction, frame)
    floor_db = -10 * np.log10(10 ** (-exact_db / 10) + 10**-4.99)
    assert floor_db - 0.3 < psnr_y_db(decoded.frame, frame) < exact_db + 0.3


def test_an_exact_receiver_refuses_rounding_and_says_what_it_is(encoder, sent):
    decoder = DeltaDecoder(encoder.header)
    with pytest.raises(PacketRejected, match="rounding-sized") as caught:
        decoder.decode(decoder.start(5), sent.packet, perturbed(pair(*SIZE_PX)[1]))
    assert caught.value.reason == RejectReason.RENDER_MISMATCH


@pytest.mark.parametrize(
    ("exact", "named"),
    [(True, "another pose, field or camera"), (False, "the sender must send them")],
)
def test_without_block_means_any_difference_of_the_renders_is_refused(encoder, exact, named):
    frame, render = pair(*SIZE_PX)
    sent = encoder.encode(encoder.start(0), frame, render)
    assert sent.packet.render_block_means == b""
    decoder = DeltaDecoder(encoder.header, exact=exact)
    with pytest.raises(PacketRejected, match=f"no block means to say by how much: .*{named}") as no:
        decoder.decode(decoder.start(0), sent.packet, perturbed(render))
    assert no.value.reason == RejectReason.RENDER_MISMATCH
    shown = decoder.decode(decoder.start(0), sent.packet, render)
    assert shown.frame.digest() == sent.reconstruction.digest()


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("wrong", ["4 px off", "16 px off", "black", "noise"])
def test_a_render_of_another_pose_or_field_is_refused(encoder, sent, exact, wrong):
    render = {
        "4 px off": lambda: picture(*SIZE_PX, 4.0),
        "16 px off": lambda: picture(*SIZE_PX, 16.0),
        "black": lambda: flat(*SIZE_PX, 16),
        "noise": lambda: noise(*SIZE_PX, 1),
    }[wrong]()
    decoder = DeltaDecoder(encoder.header, exact=exact)
    with pytest.raises(PacketRejected, match="another pose, field or camera") as caught:
        decoder.decode(decoder.start(5), sent.packet, view_of(render))
    assert caught.value.reason == RejectReason.RENDER_MISMATCH


def test_an_inexact_receiver_still_checks_what_it_can(encoder, sent):
    decoder = DeltaDecoder(encoder.header, exact=False)
    packet = replace(sent.packet, reconstruction_digest=bytes(6))
    with pytest.raises(PacketRejected, match="another picture than the sender's"):
        decoder.decode(decoder.start(5), packet, pair(*SIZE_PX)[1])


def test_pictures_of_another_size_are_the_callers_mistake(encoder, sent):
    frame, view = pair(*SIZE_PX)
    small_frame, small = pair(32, 32)
    with pytest.raises(InvalidInput, match=r"frame: \(32, 32\) px where the stream has"):
        encoder.encode(encoder.start(0), small_frame, view)
    with pytest.raises(InvalidInput, match="render: "):
        encoder.encode(encoder.start(0), frame, small)
    decoder = DeltaDecoder(encoder.header)
    with pytest.raises(InvalidInput, match="render: "):
        decoder.decode(decoder.start(5), sent.packet, small)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"epoch": -1}, "packet.epoch: -1"),
        ({"sequence": 1 << 64}, "packet.sequence"),
        ({"render_digest": b"long"}, "packet.render_digest: 4 bytes where 2"),
        ({"render_block_means": b"c"}, "packet.render_block_means: 1 bytes where 0 or 64"),
        ({"reconstruction_digest": bytes(17)}, "packet.reconstruction_digest: 17 bytes"),
    ],
)
def test_packets_that_cannot_be_are_refused_by_field(sent, change, named):
    with pytest.raises(InvalidInput, match=named):
        replace(sent.packet, **change)


@pytest.mark.parametrize(
    "efforts",
    [
        ("fast", "default", None, "thorough"),
        ("x264-ultrafast", "x264-medium", None, "x264-veryslow"),
    ],
)
def test_frames_of_one_stream_may_have_any_effort(efforts):
    own = efforts[0] == "fast"
    encoder = DeltaEncoder(CodecConfig(*SIZE_PX, effort="default" if own else "x264-veryfast"))
    choices = [FrameChoice(effort=effort, references=RENDER_ONLY) for effort in efforts]
    made = exchange(encoder, [pair(*SIZE_PX)] * len(efforts), choices)
    payloads = {encoded.packet.payload for encoded in made}
    assert len(payloads) == 4 - own, "the effort reaches the encoder"


def test_an_effort_of_no_coder_is_refused():
    with pytest.raises(InvalidInput, match="effort: 'placebo' is none of"):
        FrameChoice(effort="placebo")
