"""Messages from server to vehicle: protobuf to the values of ``rfcore.wire.messages`` and back.

A server is not trusted either: what cannot be one of its messages raises ``ProtocolError``.

An Ack, of which there is one a frame, is packed, most significant bit first. A *number* is 6 bits,
the width w, and w bits. Both ends keep the last Ack and Credit of each camera of the stream.

| bits | what |
|---|---|
| 5 | camera: its place in Hello |
| 1 | 1: the sequence after the one acknowledged last, of its epoch; 0: epoch and sequence follow, \
two numbers |
| 2 | credit: 0 none; 1 one frame more than before; 2 a number: frames in all |
| 6, 6 times that width | times: queue, ahead, render, splice, decode, total, in steps of 10 us |
| 0 to 7 | zeros up to a byte |
| 48 | digest of the server's picture, as long as the frame's |

Bytes of a message as they were when all fields were protobuf ones (of a camera named "front"), and
as they are:

| message | before | usual | worst |
|---|---|---|---|
| Ack and Credit | 59 | 18 | 46 |
| Ack | 47 | 18 | 38 |
| Credit alone: at the start, after a Nack, and for a camera that is not answered | 12 | 4 | 12 |
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from google.protobuf.message import DecodeError

from rfcore.errors import InvalidInput, ProtocolError, RejectReason
from rfcore.wire.bits import BitReader, BitWriter, ByteReader
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


STEP_NS = 10_000
"""Times of an Ack are told in steps of this."""
_TIMES = ("queue_ns", "ahead_ns", "render_ns", "splice_ns", "decode_ns", "total_ns")
_UNCHANGED, _ONE_MORE, _NUMBER = range(3)


@dataclass
class _LastAnswer:
    """The address acknowledged last, and the frames granted, of one camera."""

    epoch: int = 0
    sequence: int = -1
    frames: int = 0


class AnswerWriter:
    """Serialises the messages of a server on one stream, whose Hello names ``cameras``."""

    def __init__(self, cameras: Iterable[str] = ()) -> None:
        self._cameras = {camera_id: (n, _LastAnswer()) for n, camera_id in enumerate(cameras)}

    def messages(self, messages: Sequence[ServerMessage]) -> list[bytes]:
        """Return messages as bytes, in order; a Credit travels with the Ack of its camera."""
        acked = {m.address.camera_id for m in messages if isinstance(m, Ack)}
        frames = {
            m.camera_id: m.frames
            for m in messages
            if isinstance(m, Credit) and m.camera_id in acked
        }
        return [
            self._response(message, frames).SerializeToString()
            for message in messages
            if not (isinstance(message, Credit) and message.camera_id in acked)
        ]

    def _response(self, message: ServerMessage, frames: dict[str, int]) -> pb.StreamResponse:
        match message:
            case Welcome(session_id, exact, rate_hz):
                welcome = pb.Welcome(session_id=session_id, exact=exact, rate_hz=rate_hz)
                return pb.StreamResponse(welcome=welcome)
            case Ack():
                granted = frames.pop(message.address.camera_id, None)
                return pb.StreamResponse(ack=self._ack(message, granted))
            case Nack():
                return pb.StreamResponse(nack=_nack_to_wire(message))
            case FieldNotice(field_ids):
                return pb.StreamResponse(field_notice=pb.FieldNotice(field_ids=field_ids))
            case DrainNotice():
                return pb.StreamResponse(drain_notice=pb.DrainNotice())
            case StreetNotice():
                return pb.StreamResponse(street_notice=notice_to_wire(message))
            case Credit(camera_id, granted):
                camera, last = self._cameras[camera_id]
                last.frames = granted
                return pb.StreamResponse(credit=pb.Credit(camera=camera, frames=granted))

    def _ack(self, ack: Ack, granted: int | None) -> bytes:
        camera, last = self._cameras[ack.address.camera_id]
        epoch, sequence, bits = ack.address.epoch, ack.address.sequence, BitWriter()
        bits.put(camera, 5)
        follows = (epoch, sequence) == (last.epoch, last.sequence + 1)
        bits.put(follows, 1)
        if not follows:
            bits.number(epoch)
            bits.number(sequence)
        last.epoch, last.sequence = epoch, sequence
        if granted is None:
            bits.put(_UNCHANGED, 2)
        elif granted == last.frames + 1:
            bits.put(_ONE_MORE, 2)
        else:
            bits.put(_NUMBER, 2)
            bits.number(granted)
        if granted is not None:
            last.frames = granted
        steps = (round(getattr(ack.times, name) / STEP_NS) for name in _TIMES)
        bits.signed_values(tuple(steps), signed=False)
        return bits.to_bytes() + ack.reconstruction_digest


class AnswerReader:
    """Reads the messages of a server on one stream, whose Hello names ``cameras``."""

    def __init__(self, cameras: Iterable[str] = ()) -> None:
        self._cameras = [(camera_id, _LastAnswer()) for camera_id in cameras]

    def messages(self, data: bytes) -> list[ServerMessage]:
        """Parse what a server sent at once: a message, or an Ack and the Credit after it.

        A message that only a newer server knows is ignored: the list is then empty, and the caller
        counts it. Raises ``ProtocolError`` if the bytes are no message, or one with impossible
        values.
        """
        response = pb.StreamResponse()
        try:
            response.ParseFromString(data)
        except DecodeError as error:
            raise ProtocolError(
                f"{len(data)} bytes from the server are no StreamResponse"
            ) from error
        match response.WhichOneof("message"):
            case "welcome":
                return [_welcome_from_wire(response.welcome)]
            case "ack":
                try:
                    return self._ack(response.ack)
                except InvalidInput as error:
                    raise ProtocolError(f"the server sent an impossible Ack: {error}") from error
            case "nack":
                return [_nack_from_wire(response.nack)]
            case "field_notice":
                return [FieldNotice(tuple(response.field_notice.field_ids))]
            case "drain_notice":
                return [DrainNotice()]
            case "street_notice":
                notice = notice_from_wire(response.street_notice)
                return [] if notice is None else [notice]
            case "credit":
                camera_id, last = self._camera(response.credit.camera)
                last.frames = response.credit.frames
                return [Credit(camera_id, last.frames)]
        return []

    def _camera(self, camera: int) -> tuple[str, _LastAnswer]:
        if camera >= len(self._cameras):
            raise ProtocolError(f"the server answers camera {camera} of {len(self._cameras)}")
        return self._cameras[camera]

    def _ack(self, data: bytes) -> list[ServerMessage]:
        bits = BitReader(data)
        camera_id, last = self._camera(bits.take(5))
        if bits.take(1):
            last.sequence += 1
        else:
            last.epoch, last.sequence = bits.number(), bits.number()
        credit = bits.take(2)
        if credit:
            last.frames = last.frames + 1 if credit == _ONE_MORE else bits.number()
        width = bits.take(6)
        times = StageTimes(**{name: STEP_NS * bits.take(width) for name in _TIMES})
        bits.skip_to_byte()
        digest = ByteReader(data, bits.bits_taken // 8).rest()
        address = FrameAddress(camera_id, last.epoch, last.sequence)
        ack = Ack(address, times, digest)
        return [ack, Credit(camera_id, last.frames)] if credit else [ack]


def _welcome_from_wire(welcome: pb.Welcome) -> Welcome:
    if not 0 <= welcome.rate_hz <= MAX_RATE_HZ:
        raise ProtocolError(f"the server granted {welcome.rate_hz} Hz; 0..{MAX_RATE_HZ:g} can be")
    return Welcome(welcome.session_id, welcome.exact, welcome.rate_hz)


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
