"""Nothing is silently wrong: damaged packets are refused, or decode to exactly the right picture.

Half of the damaged packets get a fresh CRC, so that the later checks have to catch them.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.h264.header import StreamHeader
from rfcore.codec.packet import DeltaPacket
from rfcore.codec.references import RENDER_ONLY
from rfcore.codec.sender.encoder import DeltaEncoder, FrameChoice
from rfcore.errors import PacketRejected, RejectReason
from rfcore.image import I420
from rfcore.views import FieldView

PairMaker = Callable[..., tuple[I420, FieldView]]
Mutation = Callable[[DeltaPacket, np.random.Generator], DeltaPacket]
SIZE_PX = (64, 48)
FRAMES = 6


@dataclass(frozen=True)
class Stream:
    """A short sent stream: views, packets, and what the sender's closed loop saw."""

    header: StreamHeader
    views: list[FieldView]
    packets: list[DeltaPacket]
    digests: list[bytes]


@pytest.fixture(scope="module")
def stream(pair: PairMaker) -> Stream:
    encoder = DeltaEncoder(CodecConfig(*SIZE_PX))
    state = encoder.start(1)
    pictures = [pair(*SIZE_PX, 5.0 * index) for index in range(FRAMES)]
    packets, digests = [], []
    for frame, view in pictures:
        encoded = encoder.encode(state, frame, view, choice=FrameChoice(RENDER_ONLY))
        state = encoded.state
        packets.append(encoded.packet)
        digests.append(encoded.reconstruction.digest())
    return Stream(encoder.header, [view for _, view in pictures], packets, digests)


def flip_bits(data: bytes, rng: np.random.Generator) -> bytes:
    damaged = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        damaged[rng.integers(len(damaged))] ^= 1 << int(rng.integers(8))
    return bytes(damaged)


def flip_payload(packet: DeltaPacket, rng: np.random.Generator) -> DeltaPacket:
    return replace(packet, payload=flip_bits(packet.payload, rng))


def truncate(packet: DeltaPacket, rng: np.random.Generator) -> DeltaPacket:
    return replace(packet, payload=packet.payload[: rng.integers(len(packet.payload))])


def extend(packet: DeltaPacket, rng: np.random.Generator) -> DeltaPacket:
    return replace(packet, payload=packet.payload + rng.bytes(int(rng.integers(1, 40))))


def overwrite(packet: DeltaPacket, rng: np.random.Generator) -> DeltaPacket:
    start = int(rng.integers(len(packet.payload)))
    noise = rng.bytes(int(rng.integers(1, 20)))
    return replace(packet, payload=packet.payload[:start] + noise)


def flip_digests(packet: DeltaPacket, rng: np.random.Generator) -> DeltaPacket:
    name = ("render_digest", "reconstruction_digest")[rng.integers(2)]
    return replace(packet, **{name: flip_bits(getattr(packet, name), rng)})


def renumber(packet: DeltaPacket, rng: np.random.Generator) -> DeltaPacket:
    name = ("epoch", "sequence")[rng.integers(2)]
    return replace(packet, **{name: getattr(packet, name) ^ (1 << int(rng.integers(63)))})


MUTATIONS: dict[str, Mutation] = {
    m.__name__: m for m in (flip_payload, truncate, extend, overwrite, flip_digests, renumber)
}


@pytest.mark.parametrize("repaired", [False, True])
@pytest.mark.parametrize("name", MUTATIONS)
def test_a_damaged_packet_is_refused_or_decodes_exactly(
    stream: Stream, name: str, repaired: bool
) -> None:
    rng = np.random.default_rng(len(name))
    decoder = DeltaDecoder(stream.header)
    state = decoder.start(1)
    outcomes: Counter[str] = Counter()
    for trial in range(800):
        index = int(rng.integers(FRAMES))
        packet = MUTATIONS[name](stream.packets[index], rng)
        try:
            decoded = decoder.decode(
                state, packet.sealed() if repaired else packet, stream.views[index]
            )
            assert decoded.frame.digest() == stream.digests[index]
            outcomes["accepted"] += packet != stream.packets[index]
        except PacketRejected as rejection:
            outcomes[rejection.reason] += 1
        if trial % 7 == 0:
            good = decoder.decode(state, stream.packets[index], stream.views[index])
            assert good.frame.digest() == stream.digests[index], "the next good packet is right"
    if not repaired:
        assert outcomes["accepted"] == 0
        assert set(outcomes) <= {"accepted", "crc_mismatch", "stale_epoch", "stale_sequence"}
    elif name == "flip_payload":
        assert outcomes[RejectReason.RECONSTRUCTION_MISMATCH] > 10, "only the digest saw these"


@pytest.mark.parametrize("repaired", [False, True])
def test_parts_of_other_packets_are_refused(stream: Stream, repaired: bool) -> None:
    decoder = DeltaDecoder(stream.header)
    state = decoder.start(1)
    names = ("payload", "render_digest", "reconstruction_digest")
    for index, packet in enumerate(stream.packets):
        for other in stream.packets[:index] + stream.packets[index + 1 :]:
            for name in names:
                mixed = replace(packet, **{name: getattr(other, name)})
                with pytest.raises(PacketRejected):
                    decoder.decode(
                        state, mixed.sealed() if repaired else mixed, stream.views[index]
                    )


def test_a_stream_with_losses_duplicates_swaps_and_damage_shows_only_right_frames(
    stream: Stream,
) -> None:
    rng = np.random.default_rng(11)
    mutations = list(MUTATIONS.values())
    decoder = DeltaDecoder(stream.header)
    shown = lost = 0
    for _ in range(150):
        state = decoder.start(1)
        order = [i for i in range(FRAMES) for _ in range(int(rng.integers(0, 3)))]
        for a, b in zip(order[::3], order[1::3], strict=False):
            if rng.random() < 0.3:
                order[order.index(a)], order[order.index(b)] = b, a
        for index in order:
            packet = stream.packets[index]
            damaged = rng.random() < 0.3
            if damaged:
                packet = mutations[rng.integers(len(mutations))](packet, rng)
            expected = state.next_sequence
            try:
                decoded = decoder.decode(state, packet, stream.views[index])
            except PacketRejected:
                assert damaged or index < expected, "a good packet in order is always taken"
                continue
            assert decoded.frame.digest() == stream.digests[index]
            assert decoded.lost == index - expected
            state, shown, lost = decoded.state, shown + 1, lost + decoded.lost
    assert shown > 300
    assert lost > 50
