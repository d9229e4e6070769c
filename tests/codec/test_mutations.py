"""Nothing is silently wrong: damaged packets are refused, or decode to exactly the right picture.

Packets are damaged as if their check had been computed afresh, so that the later checks have to
catch everything; whole messages with and without a fresh check. One stream has a frame of every
kind; the other is in another light than the field, each frame relit by the one before.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from codec.sent_streams import (
    SentFrame,
    SentStream,
    make_adapting_stream,
    make_stream,
    sent_after_poses,
    sent_frames,
)
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.packet import RECONSTRUCTION_DIGEST_BYTES, DeltaPacket, check_packet
from rfcore.codec.prediction import Prediction
from rfcore.codec.references import RENDER_ONLY, Reference, is_temporal
from rfcore.errors import PacketRejected, RejectReason
from rfcore.wire import head
from rfcore.wire.head import FrameReader, FrameRefused
from rfcore.wire.messages import Hello, PackedFrame

Rng = np.random.Generator
Mutation = Callable[[DeltaPacket, Rng], DeltaPacket]
MAX_CPU_S = 0.05
WHOLE_EVERY = 50
"""So often a whole packet must decode as if nothing had happened."""


@pytest.fixture(scope="module")
def stream() -> SentStream:
    return make_stream()


@pytest.fixture(scope="module")
def adapting() -> SentStream:
    return make_adapting_stream()


def flip_bits(data: bytes, rng: Rng) -> bytes:
    """Flip one to four bits."""
    damaged = bytearray(data)
    for _ in range(int(rng.integers(1, 5)) if damaged else 0):
        damaged[rng.integers(len(damaged))] ^= 1 << int(rng.integers(8))
    return bytes(damaged)


def flip_payload(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    return replace(packet, payload=flip_bits(packet.payload, rng))


def flip_slice_header(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    start = flip_bits(packet.payload[:8], rng)
    return replace(packet, payload=start + packet.payload[8:])


def truncate(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    return replace(packet, payload=packet.payload[: rng.integers(len(packet.payload) + 1)])


def extend(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    return replace(packet, payload=packet.payload + rng.bytes(int(rng.integers(1, 40))))


def overwrite(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    start = int(rng.integers(len(packet.payload) + 1))
    return replace(packet, payload=packet.payload[:start] + rng.bytes(int(rng.integers(1, 200))))


def insert_nal(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    """Put a NAL unit of any type in place of the payload, or after a start code behind it."""
    unit = bytes([0x60 | int(rng.integers(32))]) + rng.bytes(int(rng.integers(1, 40)))
    joined = unit if rng.integers(2) else packet.payload + b"\x00\x00\x01" + unit
    return replace(packet, payload=joined)


def flip_digests(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    names = ["render_digest", "render_block_means", "reconstruction_digest", "base_digest"]
    name = names[rng.integers(len(names))]
    changed: dict[str, Any] = {name: flip_bits(getattr(packet, name), rng)}
    return replace(packet, **changed)


def renumber(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    name = ("epoch", "sequence")[rng.integers(2)]
    changed: dict[str, Any] = {name: getattr(packet, name) ^ (1 << int(rng.integers(63)))}
    return replace(packet, **changed)


def exchange_references(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    count = int(rng.integers(4))
    order = [Reference(int(n)) for n in rng.permutation(4)[:count] + 1]
    needs = packet.learns_light or any(reference is not Reference.RENDER for reference in order)
    return replace(packet, references=tuple(order), base_digest=base_or_made_up(packet, rng, needs))


def base_or_made_up(packet: DeltaPacket, rng: Rng, needed: bool) -> bytes:
    return (packet.base_digest or rng.bytes(RECONSTRUCTION_DIGEST_BYTES)) if needed else b""


def relight(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    """Send another matrix, as large as it may be, or the other way of relighting."""
    matrix = tuple(int(n) for n in rng.integers(-(1 << 15), 1 << 15, 12))
    relit = not rng.integers(3)
    photometric = matrix if not relit and rng.integers(4) else ()
    base = base_or_made_up(packet, rng, relit or is_temporal(packet.references))
    return replace(packet, photometric=photometric, base_digest=base, relit=relit, light=b"")


def switch_relit(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    relit = not packet.relit
    base = base_or_made_up(packet, rng, relit or is_temporal(packet.references))
    return replace(packet, photometric=(), base_digest=base, relit=relit, light=b"")


def damage_light(packet: DeltaPacket, rng: Rng) -> DeltaPacket:
    """Relight the render by a light that is damaged or, where none was sent, made up."""
    light = flip_bits(packet.light, rng) if packet.light else b"\x04" + rng.bytes(60)
    base = base_or_made_up(packet, rng, is_temporal(packet.references))
    return replace(packet, photometric=(), base_digest=base, relit=True, light=light)


def exchange_base(packet: DeltaPacket, rng: Rng, digests: Sequence[bytes]) -> DeltaPacket:
    """Learn the light, and predict, from another frame of the stream."""
    base = digests[int(rng.integers(len(digests)))]
    if packet.needs_base:
        return replace(packet, base_digest=base)
    return replace(packet, photometric=(), base_digest=base, relit=True, light=b"")


def mutations_of(stream: SentStream) -> Mapping[str, Mutation]:
    plain = (
        flip_payload, flip_slice_header, truncate, extend, overwrite, insert_nal, flip_digests,
        renumber, exchange_references, relight, switch_relit, damage_light,
    )  # fmt: skip
    digests = tuple(frame.packet.reconstruction_digest for frame in stream.frames)
    return {
        **{mutation.__name__: mutation for mutation in plain},
        "exchange_base": partial(exchange_base, digests=digests),
    }


def outcome_of(
    decoder: DeltaDecoder,
    frame: SentFrame,
    packet: DeltaPacket,
    prepared: Prediction | None = None,
) -> str:
    """Decode a packet in place of the frame's: "shown", if it is the frame's picture, or the reason
    of the refusal."""
    started_s = time.thread_time()  # decoding has no threads; other ones are none of its
    before = frame.before
    try:
        checked = check_packet(packet, before.epoch, before.next_sequence)
        shown = decoder.decode_checked(before, checked, frame.view, prepared).frame
    except PacketRejected as rejection:
        outcome = str(rejection.reason)
    else:
        outcome = "shown"
        assert shown.digest().startswith(frame.packet.reconstruction_digest), packet
    assert time.thread_time() - started_s < MAX_CPU_S, packet
    return outcome


def damage(stream: SentStream, packets: int, seed: int, names: Sequence[str] = ()) -> Counter[str]:
    """Damage packets at random; return the outcomes."""
    rng = np.random.default_rng(seed)
    decoder = DeltaDecoder(stream.header)
    mutations = mutations_of(stream)
    chosen = [mutations[name] for name in names or mutations]
    outcomes = Counter[str]()
    for number in range(packets):
        frame = stream.frames[rng.integers(len(stream.frames))]
        damaged = chosen[rng.integers(len(chosen))](frame.packet, rng)
        outcomes[outcome_of(decoder, frame, damaged)] += 1
        if number % WHOLE_EVERY == 0:
            assert outcome_of(decoder, frame, frame.packet) == "shown"
    return outcomes


@pytest.mark.parametrize("name", ["stream", "adapting"])
def test_damaged_packets_never_show_a_wrong_picture(name, request):
    assert set(damage(request.getfixturevalue(name), 2_000, seed=1)) >= {
        RejectReason.MALFORMED_PAYLOAD,
        RejectReason.DECODER_FAILED,
        RejectReason.RECONSTRUCTION_MISMATCH,
        RejectReason.RENDER_MISMATCH,
        RejectReason.UNKNOWN_STATE,
    }


def damaged_data(data: bytes, rng: Rng) -> bytes:
    """Flip one bit or up to 8, in the head as often as anywhere; or cut it, or put bytes in."""
    damaged, end = bytearray(data), min(40, len(data)) if rng.integers(2) else len(data)
    kind = int(rng.integers(10))
    if kind == 0:
        return data[: rng.integers(len(data))]
    at = int(rng.integers(end))
    if kind == 1:
        damaged[at:at] = rng.bytes(int(rng.integers(1, 5)))
    for _ in range(1 if kind < 6 else int(rng.integers(1, 9))):
        damaged[rng.integers(end)] ^= 1 << int(rng.integers(8))
    return bytes(damaged)


def damage_messages(
    stream: SentStream, messages: int, seed: int, repaired: bool, monkeypatch: pytest.MonkeyPatch
) -> Counter[str]:
    """Damage whole frames, read them in place of the right ones, and decode what can be read.

    Where another pose, camera or time was read, another render stands for the receiver's.
    """
    hello, sent = sent_frames(stream)
    right = [data for data, _ in sent]
    readers = [reader_after(hello, right[:index]) for index in range(len(right))]
    if repaired:
        monkeypatch.setattr(head, "_require_check", lambda *_: None)
    rng, decoder, outcomes = (
        np.random.default_rng(seed),
        DeltaDecoder(stream.header),
        Counter[str](),
    )
    for _ in range(messages):
        index = int(rng.integers(len(right)))
        data, frame = damaged_data(right[index], rng), stream.frames[index]
        try:
            read = readers[index].frame(data)
        except FrameRefused as refused:
            outcomes[str(refused.reason)] += 1
            continue
        assert repaired or data == right[index]
        readers[index] = reader_after(hello, right[:index])  # it has learnt the damaged frame
        if read.pose != sent[index][1].pose:
            frame = replace(frame, view=stream.frames[index - 1].view)
        outcomes[outcome_of(decoder, frame, read.packet)] += 1
    return outcomes


def prepared_frames(stream: SentStream, decoder: DeltaDecoder) -> list[Prediction]:
    """Return what each frame is predicted from, made before it comes."""
    return [
        decoder.prepared(frame.before, frame.view, frame.packet.base_digest, frame.packet)
        for frame in stream.frames
    ]


def damage_after_poses(
    stream: SentStream, messages: int, seed: int, repaired: bool, monkeypatch: pytest.MonkeyPatch
) -> Counter[str]:
    """Damage poses ahead of frames, frames after them, or both; decode with what was prepared."""
    hello, sent = sent_after_poses(stream)
    if repaired:
        monkeypatch.setattr(head, "_require_check", lambda *_: None)
    rng, decoder, outcomes = (
        np.random.default_rng(seed),
        DeltaDecoder(stream.header),
        Counter[str](),
    )
    prepared = prepared_frames(stream, decoder)
    pairs = [(PackedFrame(ahead, is_ahead=True), data) for ahead, data, _ in sent]
    before = [[data for pair in pairs[:index] for data in pair] for index in range(len(pairs))]
    readers = [reader_after(hello, some) for some in before]
    for _ in range(messages):
        index, which = int(rng.integers(len(sent))), int(rng.integers(1, 4))
        reader, frame = readers[index], stream.frames[index]
        ahead, data, whole = sent[index]
        try:
            reader.ahead(damaged_data(ahead, rng) if which & 1 else ahead)
        except FrameRefused as refused:
            outcomes[f"pose {refused.reason}"] += 1
        try:
            read = reader.frame(damaged_data(data, rng) if which & 2 else data)
        except FrameRefused as refused:
            outcomes[str(refused.reason)] += 1
            reader._sent_ahead[0] = None
            continue
        readers[index] = reader_after(hello, before[index])  # it has learnt the damaged frame
        assert repaired or read == whole
        made: Prediction | None = prepared[index]
        if read.pose != whole.pose:
            frame, made = replace(frame, view=stream.frames[index - 1].view), prepared[index - 1]
        outcomes[outcome_of(decoder, frame, read.packet, made)] += 1
    return outcomes


@pytest.mark.parametrize("name", ["stream", "adapting"])
@pytest.mark.parametrize("repaired", [False, True])
def test_damage_after_poses_never_shows_a_wrong_picture(name, repaired, request, monkeypatch):
    outcomes = damage_after_poses(request.getfixturevalue(name), 1_000, 8, repaired, monkeypatch)
    assert outcomes[RejectReason.UNKNOWN_STATE] > 10, "without its pose"
    if repaired:
        assert outcomes[RejectReason.RENDER_MISMATCH] > 10, "another pose"
        assert outcomes[RejectReason.RECONSTRUCTION_MISMATCH] > 10
    else:
        assert outcomes[f"pose {RejectReason.CRC_MISMATCH}"] > 100
        assert outcomes[RejectReason.CRC_MISMATCH] > 100


@pytest.mark.parametrize("name", ["stream", "adapting"])
def test_what_was_prepared_is_not_made_again(name, request, monkeypatch):
    stream = request.getfixturevalue(name)
    decoder = DeltaDecoder(stream.header)
    prepared = prepared_frames(stream, decoder)
    for make in ("warp_i420", "correct_i420", "relight_i420"):
        monkeypatch.setattr(f"rfcore.codec.prediction.{make}", None)
    for frame, made in zip(stream.frames, prepared, strict=True):
        if frame.packet.needs_base and not frame.packet.photometric:
            assert outcome_of(decoder, frame, frame.packet, made) == "shown"


@pytest.mark.parametrize("name", ["stream", "adapting"])
def test_what_was_prepared_for_another_packet_changes_no_picture(name, request):
    stream = request.getfixturevalue(name)
    decoder = DeltaDecoder(stream.header)
    for frame in stream.frames:
        bases = [past.digest[:RECONSTRUCTION_DIGEST_BYTES] for past in frame.before.kept]
        for base in (b"", b"digest", *bases):
            for like in (None, *(other.packet for other in stream.frames)):
                made = decoder.prepared(frame.before, frame.view, base, like)
                assert outcome_of(decoder, frame, frame.packet, made) == "shown"


def reader_after(hello: Hello, before: Sequence[bytes | PackedFrame]) -> FrameReader:
    reader = FrameReader(hello)
    for data in before:
        reader.read(data if isinstance(data, PackedFrame) else PackedFrame(data))
    return reader


@pytest.mark.parametrize("name", ["stream", "adapting"])
@pytest.mark.parametrize("repaired", [False, True])
def test_damaged_messages_never_show_a_wrong_picture(name, repaired, request, monkeypatch):
    stream = request.getfixturevalue(name)
    outcomes = damage_messages(stream, 1_000, 5, repaired, monkeypatch)
    if repaired:
        assert outcomes[RejectReason.RENDER_MISMATCH] > 10, "another pose"
        assert outcomes[RejectReason.RECONSTRUCTION_MISMATCH] > 10
    else:
        assert outcomes[RejectReason.CRC_MISMATCH] > 500
        assert outcomes["shown"] == 0
    assert outcomes[RejectReason.UNKNOWN_STATE] > 10
    assert outcomes[RejectReason.INVALID_ARGUMENT] > 10


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", ["stream", "adapting"])
@pytest.mark.parametrize("repaired", [False, True])
def test_a_million_damaged_messages_never_show_a_wrong_picture(
    name, repaired, request, monkeypatch
):
    damage_messages(request.getfixturevalue(name), 250_000, 6, repaired, monkeypatch)
    damage_after_poses(request.getfixturevalue(name), 250_000, 9, repaired, monkeypatch)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", ["stream", "adapting"])
def test_a_hundred_thousand_damaged_packets_never_show_a_wrong_picture(name, request):
    damage(request.getfixturevalue(name), 100_000, seed=4)


def test_only_the_digest_sees_some_flipped_bits(stream):
    outcomes = damage(stream, 800, 1, ["flip_payload"])
    assert outcomes[RejectReason.RECONSTRUCTION_MISMATCH] > 10


def test_a_damaged_light_is_refused_or_shows_the_same(adapting):
    """The last bits of a deflated light say nothing: with others there it is the same light."""
    only = replace(adapting, frames=adapting.frames[1:2])
    outcomes = damage(only, 200, 0, ["damage_light"])
    assert outcomes[RejectReason.INVALID_ARGUMENT] > 20, "written wrongly"
    assert outcomes[RejectReason.RECONSTRUCTION_MISMATCH] > 20, "another light"
    assert outcomes["shown"] < 40


def test_the_streams_have_every_kind_of_frame(stream, adapting):
    packets = [frame.packet for frame in stream.frames]
    darker = [frame.packet for frame in adapting.frames]
    for some in (packets, darker):
        assert {reference for packet in some for reference in packet.references} == set(Reference)
    assert any(not packet.references for packet in packets)
    assert any(not packet.payload for packet in packets)
    assert any(packet.photometric for packet in packets)
    assert [packet.relit for packet in darker] == [False] + [True] * (len(darker) - 1)
    assert [bool(packet.light) for packet in darker] == [False, True, *[False] * (len(darker) - 2)]


def test_every_kind_of_damage_changes_something(adapting):
    rng, frame = np.random.default_rng(0), adapting.frames[-1]
    mutations = mutations_of(adapting)
    for name, mutation in mutations.items():
        assert any(mutation(frame.packet, rng) != frame.packet for _ in range(9)), name
    named = {mutations["exchange_base"](frame.packet, rng).base_digest for _ in range(50)}
    held = {past.digest[:RECONSTRUCTION_DIGEST_BYTES] for past in frame.before.kept}
    assert len(named & held) > 1, "only the picture's digest can tell these"


def test_a_picture_that_is_not_the_senders_is_noticed(stream):
    """The digest that was sent is compared with the picture that is shown."""
    first = stream.frames[1]
    other = replace(first.packet, reconstruction_digest=bytes(6))
    poisoned = replace(stream, frames=(replace(first, packet=other),))
    with pytest.raises(AssertionError):
        damage(poisoned, 1, 0)


def test_a_render_relit_by_another_frame_that_is_kept_is_refused(adapting):
    """Only the digest of the picture can tell: the base is there, and the packet is well formed."""
    decoder = DeltaDecoder(adapting.header)
    tried = 0
    for frame in adapting.frames[2:]:
        for past in frame.before.kept[1:]:
            base = past.digest[:RECONSTRUCTION_DIGEST_BYTES]
            for references in (frame.packet.references, RENDER_ONLY):
                packet = replace(frame.packet, base_digest=base, references=references)
                assert outcome_of(decoder, frame, packet) != "shown"
                tried += 1
    assert tried > 10


def test_parts_of_other_packets_are_refused(stream):
    decoder = DeltaDecoder(stream.header)
    packets = [frame.packet for frame in stream.frames]
    for frame in stream.frames:
        for other in packets:
            for name in ("payload", "render_digest", "reconstruction_digest"):
                part: dict[str, Any] = {name: getattr(other, name)}
                mixed = replace(frame.packet, **part)
                if mixed != frame.packet:
                    assert outcome_of(decoder, frame, mixed) != "shown"


@pytest.mark.parametrize("name", ["stream", "adapting"])
def test_a_stream_with_losses_duplicates_swaps_and_damage_shows_only_right_frames(name, request):
    """A good packet is taken if it is in order and the frame it is predicted from was taken."""
    stream: SentStream = request.getfixturevalue(name)
    rng = np.random.default_rng(11)
    mutations = [m for kind, m in mutations_of(stream).items() if kind != "renumber"]
    decoder = DeltaDecoder(stream.header)
    shown = lost = refused = 0
    for _ in range(100):
        state = decoder.start(1)
        order = np.repeat(np.arange(len(stream.frames)), rng.integers(0, 3, len(stream.frames)))
        swapped = rng.random(len(order) - 1) < 0.1 if len(order) else []
        for at in np.flatnonzero(swapped):
            order[[at, at + 1]] = order[[at + 1, at]]
        for index in order:
            frame = stream.frames[index]
            packet, damaged = frame.packet, bool(rng.random() < 0.2)
            if damaged:
                packet = mutations[rng.integers(len(mutations))](packet, rng)
            expected = state.next_sequence
            try:
                decoded = decoder.decode(state, packet, frame.view)
            except PacketRejected:
                is_orphan = packet.needs_base and state.past(packet.base_digest) is None
                assert damaged or index < expected or is_orphan
                refused += 1
                continue
            assert decoded.frame.digest().startswith(frame.packet.reconstruction_digest)
            assert decoded.lost == index - expected
            state, shown, lost = decoded.state, shown + 1, lost + decoded.lost
    assert min(shown, refused) > 100
    assert lost > 20
