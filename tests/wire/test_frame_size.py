"""What a frame's message costs beside its slice, field by field: at 32 dB 40 bytes are 1 %."""

from dataclasses import replace

from rfcore.camera import Pose
from rfcore.codec.packet import DeltaPacket
from rfcore.codec.references import Reference
from rfcore.wire.convert import client_message_to_bytes
from rfcore.wire.messages import Frame
from rfcore.wire.v1 import edge_pb2 as pb

SLICE_BYTES = 4_500
THREE = (Reference.CORRECTION, Reference.WARP, Reference.RENDER)
TURN = Pose((412.34, -87.65, 1.43), (0.5, 0.5, -0.5, 0.5))

BUDGET_BYTES = {
    "envelope": 3,
    "camera_id": 7,
    "epoch": 2,
    "sequence": 3,
    "capture_time_ns": 9,
    "pose_f32": 30,
    "references": 5,
    "render_digest": 18,
    "reconstruction_digest": 18,
    "payload": 3,
    "crc32": 5,
    "base_digest": 6,
}
LONG_FORM_BYTES = {"pose": 65, "field_id_prefix": 10, "render_block_means": 66, "base_digest": 18}
"""What the same took with a float64 pose, a field id, block means and a whole digest."""


def frame_of(pose: Pose) -> Frame:
    packet = DeltaPacket(
        epoch=3,
        sequence=10_000,
        render_digest=b"r" * 16,
        render_block_means=b"",
        reconstruction_digest=b"d" * 16,
        payload=bytes(SLICE_BYTES),
        crc32=1,
        references=THREE,
        base_digest=b"need",
    )
    return Frame("front", 1_700_000_000_000_000_000, pose, b"", packet)


def budget_bytes(frame: Frame) -> dict[str, int]:
    """Return the bytes of each field with its tag and length, the slice itself not counted."""
    data = client_message_to_bytes(frame)
    sent = pb.StreamRequest.FromString(data).frame
    spent = {}
    for descriptor, _ in sent.ListFields():
        alone = pb.Frame.FromString(sent.SerializeToString())
        alone.ClearField(descriptor.name)
        spent[descriptor.name] = sent.ByteSize() - alone.ByteSize()
    spent["payload"] -= len(frame.packet.payload)
    return {"envelope": len(data) - sent.ByteSize()} | spent


def test_a_frame_of_an_exact_stream_has_this_budget() -> None:
    budget = budget_bytes(frame_of(TURN.rounded()))
    print(f"{sum(budget.values())} bytes beside the slice: {budget}")
    assert budget == BUDGET_BYTES
    assert sum(budget.values()) == 109


def test_the_long_form_costs_more_than_twice_as_much() -> None:
    short = frame_of(TURN)
    packet = replace(short.packet, render_block_means=b"c" * 64, base_digest=b"n" * 16)
    budget = budget_bytes(replace(short, field_id_prefix=b"f" * 8, packet=packet))
    assert budget.items() >= LONG_FORM_BYTES.items()
    assert sum(budget.values()) == 232


def test_light_costs_three_bytes_and_what_is_sent_of_it() -> None:
    frame = frame_of(TURN.rounded())
    earlier = replace(frame.packet, relit=True)
    assert budget_bytes(replace(frame, packet=earlier)) == BUDGET_BYTES | {"relit": 3}
    sent = budget_bytes(replace(frame, packet=replace(earlier, light=bytes(509))))
    assert (sent["relit"], sent["light"]) == (3, 4 + 509)
    matrix = replace(frame.packet, photometric=(-(1 << 15),) * 12)
    assert budget_bytes(replace(frame, packet=matrix))["photometric"] == 2 + 12 * 3
