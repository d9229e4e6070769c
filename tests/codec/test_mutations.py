"""Nothing is silently wrong: damaged packets are refused, or decode to exactly the right picture.

Half of the damaged packets get a fresh CRC, so that the later checks have to catch them. Two
streams: one predicts from the render alone, so that no packet needs another; one adapts, in other
light than the field's, each frame relit by the one before.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.h264.header import StreamHeader
from rfcore.codec.packet import BASE_DIGEST_BYTES, DeltaPacket
from rfcore.codec.references import RENDER_ONLY, Reference, is_temporal
from rfcore.codec.sender.encoder import DeltaEncoder, FrameChoice
from rfcore.codec.state import DecoderState
from rfcore.errors import PacketRejected, RejectReason
from rfcore.image import I420
from rfcore.views import FieldView

PairMaker = Callable[..., tuple[I420, FieldView]]
EveningMaker = Callable[[I420, float], I420]
Mutation = Callable[[DeltaPacket, np.random.Generator], DeltaPacket]
SIZE_PX = (64, 48)
FRAMES = 6


@dataclass(frozen=True)
class Stream:
    """A short sent stream: views, packets, what the sender's closed loop saw, and the receiver's
    state before each packet."""

    header: StreamHeader
    views: list[FieldView]
    packets: list[DeltaPacket]
    digests: list[bytes]
    before: list[DecoderState]


def sent(pictures: list[tuple[I420, FieldView]], first: FrameChoice, choice: FrameChoice) -> Stream:
    encoder = DeltaEncoder(CodecConfig(*SIZE_PX))
    decoder = DeltaDecoder(encoder.header)
    state, receiving = encoder.start(1), decoder.start(1)
    packets, digests, before = [], [], []
    for frame, view in pictures:
        encoded = encoder.encode(state, frame, view, choice=choice if packets else first)
        state = encoded.state
        packets.append(encoded.packet)
        digests.append(encoded.reconstruction.digest())
        before.append(receiving)
        receiving = decoder.decode(receiving, encoded.packet, view).state
    return Stream(encoder.header, [view for _, view in pictures], packets, digests, before)


@pytest.fixture(scope="module")
def stream(pair: PairMaker) -> Stream:
    pictures = [pair(*SIZE_PX, 5.0 * index) for index in range(FRAMES)]
    return sent(pictures, FrameChoice(RENDER_ONLY), FrameChoice(RENDER_ONLY))


@pytest.fixture(scope="module")
def adapting(pair: PairMaker, evening: EveningMaker) -> Stream:
    pictures = [pair(*SIZE_PX, 5.0 * index) for index in range(FRAMES)]
    darker = [
        (evening(frame, 0.4 + 0.1 * index), view) for index, (frame, view) in enumerate(pictures)
    ]
    choice = FrameChoice((Reference.PREVIOUS, Reference.RENDER), relight=True)
    return sent(darker, FrameChoice(), choice)


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


def switch_relit(packet: DeltaPacket, rng: np.random.Generator) -> DeltaPacket:
    relit = not packet.relit
    base = packet.base_digest or rng.bytes(BASE_DIGEST_BYTES)
    needed = base if relit or is_temporal(packet.references) else b""
    return replace(packet, relit=relit, base_digest=needed)


def flip_base(packet: DeltaPacket, rng: np.random.Generator) -> DeltaPacket:
    return replace(packet, base_digest=flip_bits(packet.base_digest, rng))


MUTATIONS: dict[str, Mutation] = {
    m.__name__: m for m in (flip_payload, truncate, extend, overwrite, flip_digests, renumber)
}


def outcomes_of(stream: Stream, name: str, repaired: bool, trials: int) -> Counter[str]:
    """Damage packets at random; assert that none is shown as another picture than the sender's."""
    rng = np.random.default_rng(len(name))
    decoder = DeltaDecoder(stream.header)
    outcomes: Counter[str] = Counter()
    for trial in range(trials):
        index = int(rng.integers(FRAMES))
        state, view = stream.before[index], stream.views[index]
        if name == "flip_base" and not stream.packets[index].base_digest:
            continue
        packet = MUTATIONS[name](stream.packets[index], rng)
        try:
            decoded = decoder.decode(state, packet.sealed() if repaired else packet, view)
            assert decoded.frame.digest() == stream.digests[index]
            outcomes["accepted"] += packet != stream.packets[index]
        except PacketRejected as rejection:
            outcomes[rejection.reason] += 1
        if trial % 7 == 0:
            good = decoder.decode(state, stream.packets[index], view)
            assert good.frame.digest() == stream.digests[index], "the next good packet is right"
    return outcomes


@pytest.mark.parametrize("repaired", [False, True])
@pytest.mark.parametrize("name", MUTATIONS)
def test_a_damaged_packet_is_refused_or_decodes_exactly(
    stream: Stream, name: str, repaired: bool
) -> None:
    outcomes = outcomes_of(stream, name, repaired, trials=800)
    if not repaired:
        assert outcomes["accepted"] == 0
        assert set(outcomes) <= {"accepted", "crc_mismatch", "stale_epoch", "stale_sequence"}
    elif name == "flip_payload":
        assert outcomes[RejectReason.RECONSTRUCTION_MISMATCH] > 10, "only the digest saw these"


@pytest.mark.parametrize("repaired", [False, True])
@pytest.mark.parametrize("name", MUTATIONS)
def test_a_damaged_packet_of_an_adapting_stream_is_refused_or_decodes_exactly(
    adapting: Stream, name: str, repaired: bool
) -> None:
    outcomes = outcomes_of(adapting, name, repaired, trials=300)
    if not repaired:
        assert outcomes["accepted"] == 0
        assert set(outcomes) <= {"accepted", "crc_mismatch", "stale_epoch", "stale_sequence"}
    elif name == "switch_relit":
        assert outcomes[RejectReason.RECONSTRUCTION_MISMATCH] > 200, "only the digest saw these"
    elif name == "flip_base":
        assert set(outcomes) == {RejectReason.UNKNOWN_STATE}


@pytest.mark.parametrize("repaired", [False, True])
def test_a_render_relit_by_another_frame_that_is_kept_is_refused(
    adapting: Stream, repaired: bool
) -> None:
    """Only the digest of the picture can tell: the base is there, and the packet is well formed."""
    decoder = DeltaDecoder(adapting.header)
    tried = 0
    for index in range(2, FRAMES):
        state = adapting.before[index]
        for past in state.kept[1:]:
            base = past.digest[:BASE_DIGEST_BYTES]
            for references in (adapting.packets[index].references, RENDER_ONLY):
                packet = replace(adapting.packets[index], base_digest=base, references=references)
                with pytest.raises(PacketRejected) as refused:
                    decoder.decode(
                        state, packet.sealed() if repaired else packet, adapting.views[index]
                    )
                assert repaired == (refused.value.reason is not RejectReason.CRC_MISMATCH)
                tried += 1
    assert tried > 10


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


def test_an_adapting_stream_with_losses_and_damage_shows_only_right_frames(
    adapting: Stream,
) -> None:
    """A packet is taken if the frame it is relit by was; nothing else is ever shown."""
    rng = np.random.default_rng(12)
    mutations = [m for name, m in MUTATIONS.items() if name not in ("flip_base", "renumber")]
    decoder = DeltaDecoder(adapting.header)
    shown = refused = 0
    for _ in range(100):
        state = decoder.start(1)
        for index in np.flatnonzero(rng.random(FRAMES) < 0.9):
            packet = adapting.packets[index]
            damaged = rng.random() < 0.2
            if damaged:
                packet = mutations[rng.integers(len(mutations))](packet, rng).sealed()
            try:
                decoded = decoder.decode(state, packet, adapting.views[index])
            except PacketRejected:
                held = {past.digest[:BASE_DIGEST_BYTES] for past in state.kept}
                is_orphan = bool(packet.base_digest) and packet.base_digest not in held
                assert damaged or is_orphan, "a packet whose base is held is always taken"
                refused += 1
                continue
            assert decoded.frame.digest() == adapting.digests[index]
            state, shown = decoded.state, shown + 1
    assert min(shown, refused) > 50


def test_a_stream_with_losses_duplicates_swaps_and_damage_shows_only_right_frames(
    stream: Stream,
) -> None:
    rng = np.random.default_rng(11)
    mutations = [mutation for name, mutation in MUTATIONS.items() if name != "flip_base"]
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
