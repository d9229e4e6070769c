"""Messages from server to vehicle: protobuf to the values of ``rfcore.wire.messages`` and back.

A server is not trusted either: what cannot be one of its messages raises ``ProtocolError``.
"""

from __future__ import annotations

from collections.abc import Iterable

from google.protobuf.message import DecodeError

from rfcore.errors import ProtocolError, RejectReason
from rfcore.wire.messages import (
    Ack,
    Credit,
    DrainNotice,
    FieldNotice,
    FrameAddress,
    Nack,
    ServerMessage,
    StageTimes,
    Welcome,
)
from rfcore.wire.notices import StreetNotice, notice_from_wire, notice_to_wire
from rfcore.wire.v1 import edge_pb2 as pb
from rfcore.wire.values import MAX_RATE_HZ

REASONS = {reason: pb.RejectReason.Value(f"REJECT_REASON_{reason.name}") for reason in RejectReason}
REASONS_BACK = {number: reason for reason, number in REASONS.items()}


def server_messages_from_bytes(data: bytes) -> list[ServerMessage]:
    """Parse what a server sent at once: a message, or an answer and the Credit after it.

    A message that only a newer server knows is ignored: the list is then empty, and the caller
    counts it. Raises ``ProtocolError`` if the bytes are no message, or one with impossible values.
    """
    response = pb.StreamResponse()
    try:
        response.ParseFromString(data)
    except DecodeError as error:
        raise ProtocolError(f"{len(data)} bytes from the server are no StreamResponse") from error
    messages: list[ServerMessage] = []
    match response.WhichOneof("message"):
        case "welcome":
            messages.append(_welcome_from_wire(response.welcome))
        case "ack":
            messages.append(_ack_from_wire(response.ack))
        case "nack":
            messages.append(_nack_from_wire(response.nack))
        case "field_notice":
            messages.append(FieldNotice(tuple(response.field_notice.field_ids)))
        case "drain_notice":
            messages.append(DrainNotice())
        case "street_notice":
            notice = notice_from_wire(response.street_notice)
            messages += [] if notice is None else [notice]
    if response.HasField("credit"):
        messages.append(Credit(response.credit.camera_id, response.credit.frames))
    return messages


def server_messages_to_bytes(messages: Iterable[ServerMessage]) -> list[bytes]:
    """Serialise a server's messages in order; a Credit travels with the message before it."""
    responses: list[pb.StreamResponse] = []
    for message in messages:
        if not isinstance(message, Credit):
            responses.append(_response(message))
            continue
        if not responses or responses[-1].HasField("credit"):
            responses.append(pb.StreamResponse())
        responses[-1].credit.camera_id = message.camera_id
        responses[-1].credit.frames = message.frames
    return [response.SerializeToString() for response in responses]


def _response(
    message: Welcome | Ack | Nack | FieldNotice | DrainNotice | StreetNotice,
) -> pb.StreamResponse:
    match message:
        case Welcome(session_id, exact, rate_hz):
            welcome = pb.Welcome(session_id=session_id, exact=exact, rate_hz=rate_hz)
            return pb.StreamResponse(welcome=welcome)
        case Ack():
            response = pb.StreamResponse()
            _put_ack(response.ack, message)
            return response
        case Nack():
            return pb.StreamResponse(nack=_nack_to_wire(message))
        case FieldNotice(field_ids):
            return pb.StreamResponse(field_notice=pb.FieldNotice(field_ids=field_ids))
        case DrainNotice():
            return pb.StreamResponse(drain_notice=pb.DrainNotice())
        case StreetNotice():
            return pb.StreamResponse(street_notice=notice_to_wire(message))


def _welcome_from_wire(welcome: pb.Welcome) -> Welcome:
    if not 0 <= welcome.rate_hz <= MAX_RATE_HZ:
        raise ProtocolError(f"the server granted {welcome.rate_hz} Hz; 0..{MAX_RATE_HZ:g} can be")
    return Welcome(welcome.session_id, welcome.exact, welcome.rate_hz)


def _ack_from_wire(ack: pb.Ack) -> Ack:
    t = ack.times
    return Ack(
        FrameAddress(ack.camera_id, ack.epoch, ack.sequence),
        StageTimes(t.queue_ns, t.render_ns, t.splice_ns, t.decode_ns, t.total_ns),
        ack.reconstruction_digest,
    )


def _put_ack(wire: pb.Ack, ack: Ack) -> None:
    """Fill an empty message in place: there is one a frame, and copying in takes longer."""
    wire.camera_id = ack.address.camera_id
    wire.epoch = ack.address.epoch
    wire.sequence = ack.address.sequence
    wire.reconstruction_digest = ack.reconstruction_digest
    times, t = wire.times, ack.times
    times.queue_ns = t.queue_ns
    times.render_ns = t.render_ns
    times.splice_ns = t.splice_ns
    times.decode_ns = t.decode_ns
    times.total_ns = t.total_ns


def _nack_from_wire(nack: pb.Nack) -> Nack:
    return Nack(
        FrameAddress(nack.camera_id, nack.epoch, nack.sequence),
        REASONS_BACK.get(nack.reason, RejectReason.UNSPECIFIED),
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
