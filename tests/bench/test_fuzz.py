"""Damaged packets of every kind of frame are refused, or show exactly the right picture.

A million of them: ``python -m rfedge.bench.fuzz --packets 1000000``, with ``--adapting`` under
another light than the field's.
"""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.references import Reference
from rfcore.errors import CodecError, PacketRejected, RejectReason
from rfedge.bench.fuzz import FuzzStream, fuzz, make_adapting_stream, make_stream, mutations_of


@pytest.fixture(scope="module")
def stream() -> FuzzStream:
    return make_stream()


@pytest.fixture(scope="module")
def adapting() -> FuzzStream:
    return make_adapting_stream()


def test_damaged_packets_never_show_a_wrong_picture(stream: FuzzStream) -> None:
    outcomes = fuzz(stream, 2_000, seed=1)
    caught = {
        RejectReason.CRC_MISMATCH,
        RejectReason.MALFORMED_PAYLOAD,
        RejectReason.DECODER_FAILED,
        RejectReason.RECONSTRUCTION_MISMATCH,
        RejectReason.RENDER_MISMATCH,
        RejectReason.UNKNOWN_STATE,
    }
    assert {str(reason) for reason in caught} <= set(outcomes)


@pytest.mark.slow
def test_ten_thousand_damaged_packets_never_show_a_wrong_picture(stream: FuzzStream) -> None:
    fuzz(stream, 10_000, seed=2)


def test_damaged_packets_of_adapting_streams_never_show_a_wrong_picture(
    adapting: FuzzStream,
) -> None:
    outcomes = fuzz(adapting, 4_000, seed=3)
    caught = {
        RejectReason.RECONSTRUCTION_MISMATCH,
        RejectReason.UNKNOWN_STATE,
        RejectReason.MALFORMED_PAYLOAD,
    }
    assert {str(reason) for reason in caught} <= set(outcomes)


@pytest.mark.slow
@pytest.mark.nightly
def test_a_hundred_thousand_damaged_packets_of_adapting_streams_never_show_a_wrong_picture(
    adapting: FuzzStream,
) -> None:
    fuzz(adapting, 100_000, seed=4)


def test_an_adapting_stream_relights_every_frame_that_has_one_before_it(
    adapting: FuzzStream,
) -> None:
    packets = [frame.packet for frame in adapting.frames]
    assert [packet.relit for packet in packets] == [False] + [True] * (len(packets) - 1)
    assert [bool(packet.light) for packet in packets] == [False, True] + [False] * (
        len(packets) - 2
    )
    assert {reference for packet in packets for reference in packet.references} == set(Reference)


def test_damage_relights_by_other_frames_and_not_at_all(adapting: FuzzStream) -> None:
    """Of what the receiver still holds, so that only the picture's digest can tell."""
    rng = np.random.default_rng(0)
    frame = adapting.frames[-1]
    mutations = mutations_of(adapting)
    assert not mutations["switch_relit"](frame.packet, rng).relit
    named = {mutations["exchange_base"](frame.packet, rng).base_digest for _ in range(50)}
    held = {past.digest[: len(frame.packet.base_digest)] for past in frame.before.kept}
    assert len(named & held) > 1


def test_a_damaged_light_is_refused_or_shows_the_same(adapting: FuzzStream) -> None:
    """The last bits of a deflated light say nothing: with others there it is the same light."""
    rng, frame = np.random.default_rng(0), adapting.frames[1]
    decoder, outcomes = DeltaDecoder(adapting.header), Counter[str]()
    for _ in range(200):
        damaged = mutations_of(adapting)["damage_light"](frame.packet, rng).sealed()
        try:
            shown = decoder.decode(frame.before, damaged, frame.view).frame
        except PacketRejected as refused:
            outcomes[str(refused.reason)] += 1
        else:
            assert shown.digest() == frame.packet.reconstruction_digest
            outcomes["shown"] += 1
    assert outcomes[RejectReason.INVALID_ARGUMENT] > 20, "written wrongly"
    assert outcomes[RejectReason.RECONSTRUCTION_MISMATCH] > 20, "another light"
    assert outcomes["shown"] < 40


def test_the_stream_has_every_kind_of_frame(stream: FuzzStream) -> None:
    packets = [frame.packet for frame in stream.frames]
    used = {reference for packet in packets for reference in packet.references}
    assert used == set(Reference)
    assert any(not packet.references for packet in packets)
    assert any(not packet.payload for packet in packets)
    assert any(packet.photometric for packet in packets)


def test_every_kind_of_damage_changes_something(stream: FuzzStream) -> None:
    rng = np.random.default_rng(0)
    packet = stream.frames[3].packet
    for name, mutation in mutations_of(stream).items():
        assert any(mutation(packet, rng) != packet for _ in range(5)), name


def test_a_picture_that_is_not_the_senders_is_noticed(stream: FuzzStream) -> None:
    """The harness itself: what it compares with is the digest that was sent."""
    first = stream.frames[1]
    other = replace(first.packet, reconstruction_digest=bytes(16))
    poisoned = replace(stream, frames=(replace(first, packet=other),))
    with pytest.raises(CodecError, match="whole packet was refused"):
        fuzz(poisoned, 1)
