"""One bidirectional gRPC call on an HTTP/2 connection of its own, without sockets.

``receive`` takes the bytes that a socket received and returns whole messages; ``data_to_send``
returns the bytes to write. HTTP/2 is the library h2's; this module adds what gRPC puts on top of it
(PROTOCOL-HTTP2 in gRPC's documentation): the request headers, the five bytes before each message,
and the status in the trailers.

The vehicles of a load test share the machine with the server they test, so their own cost counts.
``grpc.aio`` schedules tasks and futures for each message; here a message is one function call.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from urllib.parse import unquote

from rfcore.errors import ProtocolError
from rfcore.extras import needs

with needs("loadtest"):
    import h2.events as h2_events
    from h2.config import H2Configuration
    from h2.connection import H2Connection
    from h2.exceptions import H2Error

MESSAGE_HEAD = struct.Struct(">BI")
"""gRPC's prefix of a message: a compressed flag and the length."""
CALL = 1
"""The first stream that a client may open."""
INTERNAL, UNAVAILABLE, UNKNOWN = 13, 14, 2
"""gRPC's status codes."""


@dataclass(frozen=True)
class Status:
    """gRPC's status code and text with which the server ended the call."""

    code: int
    details: str


class GrpcCall:
    """A bidirectional call of ``method`` (/package.Service/Method); ``status`` once it is over."""

    def __init__(self, authority: str, method: str) -> None:
        self.status: Status | None = None
        self._waiting = bytearray()
        self._message = bytearray()
        config = H2Configuration(client_side=True)
        self._connection = H2Connection(config)
        self._connection.initiate_connection()
        self._connection.send_headers(CALL, _request(authority, method))

    @property
    def is_blocked(self) -> bool:
        """Whether a message waits for the server to read."""
        return bool(self._waiting)

    def send(self, message: bytes) -> None:
        """Take a message; the part that the server has no window for waits."""
        self._waiting += MESSAGE_HEAD.pack(0, len(message))
        self._waiting += message
        self._send_waiting()

    def data_to_send(self) -> bytes:
        """Return, once, the bytes to write to the socket."""
        return self._connection.data_to_send()

    def receive(self, data: bytes) -> list[bytes]:
        """Take the bytes that the socket received; return the messages that are whole now.

        Raises ``ProtocolError`` for bytes that are not HTTP/2 as a gRPC server speaks it.
        """
        try:
            for event in self._connection.receive_data(data):
                self._take(event)
            self._send_waiting()
        except H2Error as error:
            raise ProtocolError(f"HTTP/2: {error}") from error
        return self._whole_messages()

    def _take(self, event: h2_events.Event) -> None:
        match event:
            case h2_events.DataReceived(data=data, flow_controlled_length=length):
                self._message += data
                self._connection.acknowledge_received_data(length, CALL)
            case h2_events.TrailersReceived(headers=headers):
                self._end(headers)
            case h2_events.ResponseReceived(headers=headers, stream_ended=ended) if ended:
                self._end(headers)
            case h2_events.StreamReset(error_code=code) if self.status is None:
                self.status = Status(INTERNAL, f"stream reset, HTTP/2 error {int(code)}")
            case h2_events.ConnectionTerminated(additional_data=said) if self.status is None:
                problem = (said or b"").decode(errors="replace")
                self.status = Status(UNAVAILABLE, f"connection closed by the server: {problem}")

    def _end(self, headers: Iterable[tuple[bytes, bytes]]) -> None:
        given = dict(headers)
        code = int(given.get(b"grpc-status", UNKNOWN))
        self.status = Status(code, unquote(given.get(b"grpc-message", b"").decode("ascii")))

    def _whole_messages(self) -> list[bytes]:
        received, messages, at = self._message, list[bytes](), 0
        while len(received) - at >= MESSAGE_HEAD.size:
            compressed, size = MESSAGE_HEAD.unpack_from(received, at)
            if compressed:
                raise ProtocolError("the server sent a compressed message, which nobody asked for")
            begin, end = at + MESSAGE_HEAD.size, at + MESSAGE_HEAD.size + size
            if len(received) < end:
                break
            messages.append(bytes(received[begin:end]))
            at = end
        del received[:at]
        return messages

    def _send_waiting(self) -> None:
        """Send as much of what waits as the server has room for."""
        connection = self._connection
        while self._waiting and self.status is None:
            room = min(
                connection.local_flow_control_window(CALL), connection.max_outbound_frame_size
            )
            if room <= 0:
                return
            connection.send_data(CALL, bytes(self._waiting[:room]))
            del self._waiting[:room]


def _request(authority: str, method: str) -> list[tuple[str, str]]:
    return [
        (":method", "POST"),
        (":scheme", "http"),
        (":path", method),
        (":authority", authority),
        ("te", "trailers"),
        ("content-type", "application/grpc"),
    ]
