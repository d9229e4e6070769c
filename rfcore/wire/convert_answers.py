"""Server to vehicle: between protobuf and the values of ``rfcore.wire.messages``, both ways.

A server is not trusted either: what cannot be one of its messages raises ``ProtocolError``.
"""

from __future__ import annotations

from google.protobuf.message import DecodeError

from rfcore.errors import ProtocolError, RejectReason
from rfcore.wire.messages import (
    Ack,
    Credit,
    FieldNotice,
    FrameAddress,
    Nack,
    ServerMessage,
    StageTimes,
    Welcome,
)
from rfcore.wire.v1 import edge_pb2 as pb

__all__ = ["server_message_from_bytes", "server_message_to_bytes"]

REASONS = {reason: pb.RejectReason.Value(f"REJECT_REASON_{reason.name}") for reason in RejectReason}
REASONS_BACK = {number: reason for reason, number in REASONS.items()}


def server_message_from_bytes(data: bytes) -> ServerMessage:
    """Parse what a server sent; raise ``ProtocolError`` if it is not one of its messages."""
    response = pb.StreamResponse()
    try:
        response.ParseFromString(data)
    except DecodeError as error:
        raise ProtocolError(f"{len(data)} bytes from the server are no StreamResponse") from error
    match response.WhichOneof("message"):
        case "welcome":
            return Welcome(response.welcome.session_id, response.welcome.exact)
        case "ack":
            return _ack_from_wire(response.ack)
        case "nack":
            return _nack_from_wire(response.nack)
        case "field_notice":
            return FieldNotice(tuple(response.field_notice.field_ids))
        case "credit":
            return Credit(response.credit.camera_id, response.credit.frames)
    raise ProtocolError("the server sent a message this vehicle does not know; update it")


def server_message_to_bytes(message: ServerMessage) -> bytes:
    """Serialise a server's message."""
    match message:
        case Welcome(session_id, exact):
            response = pb.StreamResponse(welcome=pb.Welcome(session_id=session_id, exact=exact))
        case Ack():
            response = pb.StreamResponse(ack=_ack_to_wire(message))
        case Nack():
            response = pb.StreamResponse(nack=_nack_to_wire(message))
        case FieldNotice(field_ids):
            response = pb.StreamResponse(field_notice=pb.FieldNotice(field_ids=field_ids))
        case Credit(camera_id, frames):
            response = pb.StreamResponse(credit=pb.Credit(camera_id=camera_id, frames=frames))
    return response.SerializeToString()


def _ack_from_wire(ack: pb.Ack) -> Ack:
    t = ack.times
    return Ack(
        FrameAddress(ack.camera_id, ack.epoch, ack.sequence),
        StageTimes(t.queue_ns, t.render_ns, t.splice_ns, t.decode_ns, t.total_ns),
        ack.reconstruction_digest,
    )


def _ack_to_wire(ack: Ack) -> pb.Ack:
    t = ack.times
    return pb.Ack(
        camera_id=ack.address.camera_id,
        epoch=ack.address.epoch,
        sequence=ack.address.sequence,
        times=pb.StageTimes(
            queue_ns=t.queue_ns,
            render_ns=t.render_ns,
            splice_ns=t.splice_ns,
            decode_ns=t.decode_ns,
            total_ns=t.total_ns,
        ),
        reconstruction_digest=ack.reconstruction_digest,
    )


def _nack_from_wire(nack: pb.Nack) -> Nack:
    reason = REASONS_BACK.get(nack.reason)
    if reason is None:
        raise ProtocolError(f"the server gave reject reason {nack.reason}, unknown here")
    return Nack(
        FrameAddress(nack.camera_id, nack.epoch, nack.sequence),
        reason,
        nack.problem,
        nack.count,
        nack.last_good_sequence if nack.HasField("last_good_sequence") else None,
        nack.current_epoch,
    )


def _nack_to_wire(nack: Nack) -> pb.Nack:
    return pb.Nack(
        camera_id=nack.address.camera_id,
        epoch=nack.address.epoch,
        sequence=nack.address.sequence,
        count=nack.count,
        reason=REASONS[nack.reason],
        problem=nack.problem,
        last_good_sequence=nack.last_good_sequence,
        current_epoch=nack.current_epoch,
    )
