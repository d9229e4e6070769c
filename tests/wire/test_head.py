"""Frames on the wire: the layout to the bit, what is implied, what each check catches."""

import math
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rfcore.camera import LATTICE, Pose
from rfcore.codec.packet import DeltaPacket
from rfcore.codec.references import Reference
from rfcore.errors import InvalidInput, RejectReason
from rfcore.field import Quality
from rfcore.localise.estimate import LocalisationState
from rfcore.motion import quaternion_from_vector
from rfcore.wire.convert import hello_to_bytes
from rfcore.wire.head import REFERENCE_CODES, FrameReader, FrameRefused, FrameWriter
from rfcore.wire.head_prediction import KEPT_HEADS
from rfcore.wire.v1 import edge_pb2 as pb
from rfcore.wire.values import ClockKind

THREE = (Reference.CORRECTION, Reference.WARP, Reference.RENDER)
START_NS, STEP_NS = 1_700_000_000_000_000_000, 100_000_000
fixtures_are_frozen = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture
def hello(hello):
    front = replace(hello.cameras[0], rate_hz=10.0)
    cameras = (front, replace(front, camera_id="rear"))
    return replace(hello, cameras=cameras, field_ids=("ab" * 32, "cd" * 32))


def posed(index, turn=0.02):
    """A drive that speeds up and turns."""
    away = (0.7 * index + 0.01 * index * index, 400.0 - 0.2 * index, 1.6)
    heading = Pose(away, quaternion_from_vector((0.0, 0.0, turn * index)))
    level = Pose((0.0, 0.0, 0.0), (0.5**0.5, -(0.5**0.5), 0.0, 0.0))
    return heading.compose(level).rounded()


def chain(frame, count=8, **others):
    """Return frames that each need the one before."""
    frames = []
    for index in range(count):
        base = frames[-1].packet.reconstruction_digest if frames else b""
        packet = DeltaPacket(
            3, 41 + index, b"rr", b"", bytes((index,)) * 6, b"slice", THREE if base else (), base
        )
        own = {"capture_time_ns": START_NS + index * STEP_NS, "pose": posed(index)}
        frames.append(replace(frame, **own | others, packet=packet))
    return frames


def written(hello, frames):
    """Return what FrameReader gets of frames that are sent one after the other."""
    writer, last, sent = FrameWriter(hello), {}, []
    for frame in frames:
        sent.append(writer.data(frame, last.get(frame.camera_id)))
        last[frame.camera_id] = frame.address
    return sent


def read(hello, sent):
    reader = FrameReader(hello)
    return [reader.frame(data) for data in sent]


def head_bytes(message):
    return len(pb.StreamRequest(frame=message).SerializeToString()) - len(b"slice")


# --- what comes back


def test_a_chain_survives_the_wire_and_its_heads_are_small(hello, frame):
    frames = chain(frame)
    sent = written(hello, frames)
    assert read(hello, sent) == frames
    assert max(map(head_bytes, sent[2:])) <= 32


@pytest.mark.parametrize(
    "others",
    [
        {},
        {"pose": None},
        {"field_id": "cd" * 32},
        {"quality": Quality(0.5, 1, 16, 0.5)},
        {"quality": Quality(0.1, 3)},
        {"quality": Quality(samples_per_ray=4096)},
        {"instant": 7},
        {"clock": ClockKind.ARRIVAL, "localisation": LocalisationState.TRACKING},
        {"localisation": LocalisationState.LOST},
        {"capture_time_ns": 0},
        {"camera_id": "rear"},
    ],
    ids=str,
)
def test_whatever_is_unusual_survives_and_costs_once(hello, frame, others):
    plain = chain(frame)
    always = [replace(one, **others) for one in plain]
    assert read(hello, written(hello, always)) == always
    if "camera_id" not in others:
        later = [*plain[:4], *always[4:]]
        assert read(hello, written(hello, later)) == later


@pytest.mark.parametrize(
    "others",
    [
        {"field_id": "cd" * 32},
        {"quality": Quality(0.5, 1, 16, 0.5)},
        {"clock": ClockKind.ARRIVAL, "localisation": LocalisationState.TRACKING},
    ],
    ids=str,
)
def test_what_stays_as_it_was_costs_nothing(hello, frame, others):
    plain = chain(frame)
    sent = written(hello, [replace(one, **others) for one in plain])
    assert list(map(len, sent[1:])) == list(map(len, written(hello, plain)[1:]))


def test_instants_that_count_cost_nothing(hello, frame):
    plain = chain(frame)
    rig = [replace(one, instant=5 + index) for index, one in enumerate(plain)]
    sent = written(hello, rig)
    assert read(hello, sent) == rig
    assert list(map(len, sent[2:])) == list(map(len, written(hello, plain)[2:]))


@pytest.mark.parametrize(
    "light",
    [
        {"photometric": tuple(range(-(1 << 15), 1 << 15, 5500)), "base_digest": b""},
        {"relit": True},
        {"relit": True, "light": b"\x04" + bytes(1023), "base_digest": b""},
    ],
    ids=["matrix", "learnt", "sent"],
)
def test_every_light_survives_the_wire(hello, frame, light):
    first, second = chain(frame, 2)
    second = replace(second, packet=replace(second.packet, references=(), **light))
    assert read(hello, written(hello, [first, second])) == [first, second]


def test_every_choice_of_references_has_a_code_that_comes_back(hello, frame):
    assert len(set(REFERENCE_CODES)) == len(REFERENCE_CODES) <= 256
    first, second = chain(frame, 2)
    for references in REFERENCE_CODES:
        packet = (
            replace(second.packet, references=references, base_digest=b"")
            if not any(r is not Reference.RENDER for r in references)
            else replace(second.packet, references=references)
        )
        sent = [first, replace(second, packet=packet)]
        assert read(hello, written(hello, sent)) == sent


# --- poses


steps = st.integers(-2_000_000_000, 2_000_000_000)
turns = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1)


@fixtures_are_frozen
@given(
    st.lists(st.tuples(st.tuples(steps, steps, steps), turns, st.integers(0, 10**9)), max_size=6)
)
def test_any_poses_and_times_come_back_to_the_last_bit(hello, frame, path):
    frames = chain(frame, len(path))
    for index, (away, turn, time_us) in enumerate(path):
        norm = math.hypot(*turn)
        pose = Pose(tuple(n / 2000 for n in away), tuple(part / norm for part in turn)).rounded()
        frames[index] = replace(frames[index], pose=pose, capture_time_ns=1000 * time_us)
    assert read(hello, written(hello, frames)) == frames


def test_constant_speed_and_turn_cost_next_to_nothing_at_any_rate(hello, frame):
    rng = np.random.default_rng(1)
    plain = chain(frame, 30)
    smooth = []
    times_s = np.cumsum(0.1 + 0.02 * rng.random(30))
    for one, t in zip(plain, times_s, strict=True):
        away = (10 * t, 3 * t, 1.6)
        pose = Pose(away, quaternion_from_vector((0.1 * t, 0.2 * t, 0.3 * t))).rounded()
        smooth.append(replace(one, pose=pose, capture_time_ns=START_NS + 1000 * round(1e6 * t)))
    sent = written(hello, smooth)
    assert read(hello, sent) == smooth
    assert np.median(list(map(head_bytes, sent[2:]))) <= 27


def test_a_jump_and_standing_still_survive(hello, frame):
    frames = chain(frame, 6)
    frames[3] = replace(frames[3], pose=Pose((-999_999.5, 0.0, 5.0), (0.0, 0.0, 0.0, 1.0)))
    frames[4] = replace(frames[4], pose=frames[3].pose, capture_time_ns=frames[3].capture_time_ns)
    frames[5] = replace(frames[5], pose=None)
    assert read(hello, written(hello, frames)) == frames


def test_a_pose_that_was_not_rounded_is_not_sent(hello, frame):
    with pytest.raises(InvalidInput, match="not on the lattice"):
        FrameWriter(hello).data(replace(frame, pose=Pose((0.0001, 0, 0), (1.0, 0, 0, 0))), None)


# --- losses and names


def test_one_lost_frame_among_predicted_poses_costs_one_packet(hello, frame):
    """The frame that names a lost one is refused; the sender goes back to the last known one."""
    frames = chain(frame, 6)
    writer, reader = FrameWriter(hello), FrameReader(hello)
    for one, before in zip(frames[:3], [None, *frames[:2]], strict=True):
        reader.frame(writer.data(one, None if before is None else before.address))
    writer.data(frames[3], frames[2].address)  # lost
    with pytest.raises(FrameRefused) as caught:
        reader.frame(writer.data(frames[4], frames[3].address))
    assert caught.value.reason is RejectReason.UNKNOWN_STATE
    assert caught.value.address == frames[4].address
    again = replace(frames[5].packet, epoch=4, sequence=0)
    again = replace(again, base_digest=frames[2].packet.reconstruction_digest)
    healed = replace(frames[5], packet=again)
    sent = writer.data(healed, frames[2].address)
    assert reader.frame(sent) == healed
    assert head_bytes(sent) <= 40


def test_frames_that_are_long_gone_are_not_named(hello, frame):
    frames = chain(frame, KEPT_HEADS + 2)
    writer = FrameWriter(hello)
    for one, before in zip(frames, [None, *frames[:-1]], strict=True):
        writer.data(one, None if before is None else before.address)
    late = replace(frame, packet=replace(frame.packet, sequence=99))
    alone = FrameWriter(hello).data(late, None)
    assert writer.data(late, frames[1].address) == alone
    assert writer.data(late, frames[3].address) != alone


def test_another_base_than_the_anchor_is_not_sent(hello, frame):
    first, second = chain(frame, 2)
    writer = FrameWriter(hello)
    writer.data(first, None)
    with pytest.raises(InvalidInput, match=r"frame\.base_digest"):
        writer.data(second, None)


def test_a_replayed_frame_is_the_same_frame_and_changes_nothing(hello, frame):
    frames = chain(frame, 4)
    sent, reader = written(hello, frames), FrameReader(hello)
    assert [reader.frame(data) for data in (*sent[:3], sent[1], sent[3])] == [
        *frames[:3],
        frames[1],
        frames[3],
    ]


# --- poses ahead


def sent_ahead(hello, frames):
    """Return the messages of frames, each after its pose; poses come before frames."""
    writer, last, sent = FrameWriter(hello), None, []
    for frame in frames:
        message = writer.ahead(frame.ahead, last)
        sent.append((pb.StreamRequest.FromString(message).pose_ahead, writer.data(frame, last)))
        last = frame.address
    return sent


def test_frames_after_their_poses_are_the_same_and_the_poses_are_small(hello, frame):
    frames = [replace(one, instant=3 + index) for index, one in enumerate(chain(frame))]
    sent, reader = sent_ahead(hello, frames), FrameReader(hello)
    for one, (ahead, data), whole in zip(frames, sent, written(hello, frames), strict=True):
        said = reader.ahead(ahead)
        assert replace(said, base_digest=b"") == one.ahead
        assert said.base_digest == one.packet.base_digest
        assert reader.frame(data) == one
        assert len(data) + len(ahead) <= len(whole) + 5
    assert max(len(ahead) for ahead, _ in sent[2:]) <= 16


@pytest.mark.parametrize("change", [{"pose": posed(9)}, {"capture_time_ns": 5000}, {"instant": 9}])
def test_a_frame_that_differs_from_its_pose_ahead_says_all_itself(hello, frame, change):
    first, second = chain(frame, 2)
    writer, reader = FrameWriter(hello), FrameReader(hello)
    reader.frame(writer.data(first, None))
    message = writer.ahead(replace(second.ahead, **change), first.address)
    reader.ahead(pb.StreamRequest.FromString(message).pose_ahead)
    sent = writer.data(second, first.address)
    assert reader.frame(sent) == second
    assert sent == written(hello, [first, second])[1]


def test_a_frame_without_its_pose_ahead_is_refused_and_so_is_its_replay(hello, frame):
    frames = chain(frame, 3)
    sent, reader = sent_ahead(hello, frames), FrameReader(hello)
    reader.ahead(sent[0][0])
    reader.frame(sent[0][1])
    for lost, index in ((sent[1][1], 1), (sent[0][1], 0)):
        with pytest.raises(FrameRefused, match="sent ahead of it did not arrive") as caught:
            reader.frame(lost)
        assert caught.value.reason is RejectReason.UNKNOWN_STATE
        assert caught.value.address.camera_id == "front"
        assert index or caught.value.address.sequence % 256 == frames[0].packet.sequence
        assert not index or caught.value.address == frames[1].address
    reader.ahead(sent[1][0])
    assert reader.frame(sent[1][1]) == frames[1]


def test_a_pose_ahead_is_taken_once_and_none_after_its_frame(hello, frame):
    frames = chain(frame, 3)
    sent, reader = sent_ahead(hello, frames), FrameReader(hello)
    reader.ahead(sent[0][0])
    for again in range(2):
        with pytest.raises(FrameRefused) as caught:
            reader.ahead(sent[0][0])
        assert caught.value.reason is RejectReason.STALE_SEQUENCE
        if not again:
            reader.frame(sent[0][1])


def test_a_pose_ahead_whose_frame_never_comes_gives_way_to_the_next(hello, frame):
    frames = chain(frame, 4)
    writer, reader = FrameWriter(hello), FrameReader(hello)
    reader.frame(writer.data(frames[0], None))
    for one in frames[1:3]:
        message = writer.ahead(one.ahead, frames[0].address)
        reader.ahead(pb.StreamRequest.FromString(message).pose_ahead)
    alone = replace(frames[2], packet=replace(frames[2].packet, references=(), base_digest=b""))
    assert reader.frame(writer.data(alone, frames[0].address)) == alone


def test_one_lost_frame_among_poses_ahead_costs_one_packet(hello, frame):
    """The pose that names the lost frame is refused, so is its frame; the next names another."""
    frames = chain(frame, 5)
    sent, reader = sent_ahead(hello, frames), FrameReader(hello)
    for ahead, data in sent[:2]:
        reader.ahead(ahead)
        reader.frame(data)
    reader.ahead(sent[2][0])  # its frame is lost
    for read, data in ((reader.ahead, sent[3][0]), (reader.frame, sent[3][1])):
        with pytest.raises(FrameRefused) as caught:
            read(data)
        assert caught.value.reason is RejectReason.UNKNOWN_STATE
        assert caught.value.address == frames[3].address
    base = frames[1].packet.reconstruction_digest
    again = replace(frames[4].packet, epoch=4, sequence=0, base_digest=base)
    healed = replace(frames[4], packet=again)
    writer = FrameWriter(hello)
    for one, before in zip(frames[:2], [None, frames[0]], strict=True):
        writer.data(one, before and before.address)
    message = writer.ahead(healed.ahead, frames[1].address)
    reader.ahead(pb.StreamRequest.FromString(message).pose_ahead)
    assert reader.frame(writer.data(healed, frames[1].address)) == healed


def test_every_single_flip_of_a_pose_ahead_is_refused(hello, frame):
    sent = sent_ahead(hello, chain(frame, 3))
    ahead = sent[2][0]
    for bit in range(8 * len(ahead)):
        damaged = bytearray(ahead)
        damaged[bit // 8] ^= 128 >> bit % 8
        reader = FrameReader(hello)
        for before in sent[:2]:
            reader.ahead(before[0])
            reader.frame(before[1])
        with pytest.raises(FrameRefused):
            reader.ahead(bytes(damaged))
        with pytest.raises(FrameRefused):
            reader.ahead(ahead[: bit // 8])
        with pytest.raises(FrameRefused):
            reader.ahead(ahead + b"\0")
        assert reader.ahead(ahead).sequence == 43, "the damaged one left no trace"


def test_every_single_flip_of_a_frame_after_its_pose_is_refused(hello, frame):
    frames = chain(frame, 3)
    sent = sent_ahead(hello, frames)
    for bit in range(8 * len(sent[2][1])):
        damaged = bytearray(sent[2][1])
        damaged[bit // 8] ^= 128 >> bit % 8
        reader = FrameReader(hello)
        for ahead, data in sent[:2]:
            reader.ahead(ahead)
            reader.frame(data)
        reader.ahead(sent[2][0])
        with pytest.raises(FrameRefused):
            reader.frame(bytes(damaged))
        assert reader.frame(sent[2][1]) == frames[2], "the damaged one left no trace"


def test_a_pose_ahead_of_a_frame_that_was_coded_is_refused(hello, frame):
    with pytest.raises(FrameRefused, match=r"pose_ahead\.flags: 4"):
        FrameReader(hello).ahead(forged(hello, frame))


# --- refusals


def number(value):
    width = value.bit_length()
    return f"{width:06b}" + (f"{value:0{width}b}" if width else "")


def signed(value):
    return 2 * value if value >= 0 else -2 * value - 1


def triple(values):
    mapped = list(map(signed, values))
    width = max(mapped).bit_length()
    return f"{width:06b}" + "".join(f"{m:0{width}b}" if width else "" for m in mapped)


def forged(hello, frame, **parts):
    """Return a frame without an anchor, as its layout says, with ``parts`` in place of its own."""
    x, y, z, *quaternion = LATTICE.steps(frame.pose)
    largest = next(n for n, part in enumerate(quaternion) if abs(part) == 1 << 15)
    others = [part for n, part in enumerate(quaternion) if n != largest]
    layout = {
        "camera": f"{0:05b}",
        "anchor": "00",
        "epoch": number(frame.packet.epoch),
        "sequence": number(frame.packet.sequence),
        "flags": f"{4:08b}",
        "time": number(signed(frame.capture_time_ns // 1000)),
        "quality": "",
        "largest": f"{largest:02b}",
        "metres": triple((x, y, z)),
        "turn": triple(others),
        "references": f"{1:08b}",
    }
    bits = "".join((layout | parts).values())
    head = int(bits.ljust(-(-len(bits) // 8) * 8, "0"), 2).to_bytes(-(-len(bits) // 8), "big")
    packet = frame.packet
    behind = packet.render_digest + packet.reconstruction_digest + packet.render_block_means
    values = [0, packet.epoch, packet.sequence, frame.capture_time_ns // 1000, *[0] * 7, 4, 0]
    checked = struct.pack(">BIQQBBBBHQBBH7qB", *values, x, y, z, *quaternion, 1)
    check = zlib.crc32(hello_to_bytes(hello) + checked + behind + packet.payload)
    return head + check.to_bytes(4, "big") + behind + packet.payload


def test_the_layout_is_the_documented_one(hello, frame):
    sent = replace(frame, packet=replace(frame.packet, references=(Reference.RENDER,)))
    assert FrameWriter(hello).data(sent, None) == forged(hello, frame)


@pytest.mark.parametrize(
    ("parts", "named"),
    [
        ({"camera": "00010"}, "frame.camera: 2 where Hello has 0..1"),
        ({"epoch": number(1 << 32)}, "frame.epoch: 4294967296"),
        ({"sequence": number((1 << 63) - 1), "epoch": number(1 << 62)}, "frame.epoch"),
        ({"time": number(signed(-1))}, "frame.capture_time_ns"),
        ({"time": number(signed(1 << 60))}, "frame.capture_time_ns"),
        ({"flags": f"{132:08b}", "time": number(0) + f"{2:06b}"}, "frame.field: 2"),
        ({"flags": f"{68:08b}", "quality": "000101" + "0" * 13}, "quality.sh_degree: 4"),
        ({"flags": f"{68:08b}", "quality": "000000" + "1" * 13}, "quality.samples_per_ray"),
        ({"metres": triple((2_000_000_001, 0, 0))}, "frame.pose.x in steps: 2000000001"),
        ({"turn": triple((0, 0, (1 << 15) + 1))}, "frame.pose.rotation in steps: 32769"),
        ({"largest": "11", "turn": triple((1 << 15, 0, 0))}, "frame.pose.rotation in steps"),
        ({"references": f"{65:08b}"}, "frame.references: 65"),
        ({"references": f"{2:08b}"}, "frame.references: need an earlier frame"),
        ({"flags": f"{20:08b}", "quality": "1100"}, "frame.clock: 3"),
        ({"references": f"{1:08b}" + "0" * 11, "flags": f"{7:08b}"}, "frame.light: 0"),
    ],
)
def test_a_bad_value_is_refused_by_name(hello, frame, parts, named):
    with pytest.raises(FrameRefused, match=named) as caught:
        FrameReader(hello).frame(forged(hello, frame, **parts))
    assert caught.value.reason is RejectReason.INVALID_ARGUMENT
    assert caught.value.address.camera_id == ("" if "camera" in parts else "front")


def test_a_frame_that_ends_within_its_head_is_refused(hello, frame):
    sent = written(hello, chain(frame, 3))
    for end in range(len(sent[2]) - len(b"slice")):
        reader = FrameReader(hello)
        for data in sent[:2]:
            reader.frame(data)
        with pytest.raises(FrameRefused):
            reader.frame(sent[2][:end])


def test_a_payload_that_is_too_long_is_refused(hello, frame):
    long = replace(frame, packet=replace(frame.packet, payload=bytes(1_000_001)))
    with pytest.raises(FrameRefused, match="payload bytes: 1000001"):
        FrameReader(hello).frame(FrameWriter(hello).data(long, None))


def test_a_camera_or_field_that_hello_does_not_name_is_not_sent(hello, frame):
    for wrong in ({"camera_id": "left"}, {"field_id": "ef" * 32}):
        with pytest.raises(InvalidInput, match=f"frame.{next(iter(wrong))}"):
            FrameWriter(hello).data(replace(frame, **wrong), None)


def test_a_frame_under_another_hello_is_refused(hello, frame):
    """A camera, a rig's extrinsics or a field that arrived otherwise spoil every frame."""
    sent = FrameWriter(hello).data(frame, None)
    other = replace(hello, field_ids=hello.field_ids[::-1])
    with pytest.raises(FrameRefused) as caught:
        FrameReader(other).frame(sent)
    assert caught.value.reason is RejectReason.CRC_MISMATCH


# --- damage


@pytest.mark.parametrize(
    "last",
    [
        {},
        {"render_block_means": bytes(range(64)), "payload": bytes(range(100))},
        {"relit": True, "light": bytes(range(40)), "payload": bytes(range(100))},
        {"photometric": tuple(range(12))},
    ],
    ids=["plain", "means", "light", "matrix"],
)
def test_every_single_flip_of_a_predicted_frame_is_refused(hello, frame, last):
    """Time, pose and camera are as covered as the slice, and where one part ends."""
    frames = chain(frame, 4)
    frames[3] = replace(frames[3], packet=replace(frames[3].packet, **last))
    sent = written(hello, frames)
    for bit in range(8 * len(sent[3])):
        damaged = bytearray(sent[3])
        damaged[bit // 8] ^= 128 >> bit % 8
        reader = FrameReader(hello)
        for data in sent[:3]:
            reader.frame(data)
        with pytest.raises(FrameRefused):
            reader.frame(bytes(damaged))
        assert reader.frame(sent[3]) == frames[3], "the damaged one left no trace"


def test_a_frame_predicted_from_another_frame_is_refused(hello, frame):
    """The address is right and the head has no error: only the implied values differ."""
    frames = chain(frame, 3)
    sent = written(hello, frames)
    moved = replace(frames[1], pose=posed(5))
    reader = FrameReader(hello)
    for data in written(hello, [frames[0], moved]):
        reader.frame(data)
    with pytest.raises(FrameRefused) as caught:
        reader.frame(sent[2])
    assert caught.value.reason is RejectReason.CRC_MISMATCH


def test_frames_of_cameras_do_not_depend_on_each_other(hello, frame):
    front, rear = chain(frame, 4), chain(frame, 4, camera_id="rear")
    both = [one for pair in zip(front, rear, strict=True) for one in pair]
    sent = written(hello, both)
    assert read(hello, sent) == both
    assert sent[::2] == written(hello, front)
