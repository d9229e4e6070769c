"""The bytes of a prerecorded vehicle's call are what gRPC's own server understands, and back."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable

import grpc
import pytest
from h2.config import H2Configuration
from h2.connection import H2Connection
from hypothesis import given
from hypothesis import strategies as st

from rfcore.errors import ProtocolError
from rfcore.wire.conventions import SERVER_OPTIONS
from rfedge.loadtest.grpc_call import CALL, GrpcCall, Status

METHOD = "/test.Echo/Stream"
Context = grpc.aio.ServicerContext
Handler = Callable[[AsyncIterator[bytes], Context], Awaitable[None]]


async def exchange(handler: Handler, messages: list[bytes], answers: int) -> tuple[GrpcCall, list]:
    """Send ``messages`` to a gRPC server; return the call and what came, until it is enough."""
    server = grpc.aio.server(options=SERVER_OPTIONS)
    method = {"Stream": grpc.stream_stream_rpc_method_handler(handler)}
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler("test.Echo", method),))
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    call, received = GrpcCall("127.0.0.1", METHOD), list[bytes]()
    for message in messages:
        call.send(message)
    async with asyncio.timeout(20):
        while call.status is None and (len(received) < answers or not answers):
            writer.write(call.data_to_send())
            received += call.receive(await reader.read(1 << 16))
    writer.close()
    await server.stop(0)
    return call, received


async def echo(requests: AsyncIterator[bytes], context: Context) -> None:
    async for request in requests:
        await context.write(request)


async def test_messages_larger_than_every_window_come_back_whole():
    messages = [bytes([i]) * size for i, size in enumerate((0, 1, 4096, 16_384, 300_000, 200_000))]
    call, received = await exchange(echo, messages, len(messages))
    assert received == messages
    assert (call.status, call.is_blocked) == (None, False)


@pytest.mark.parametrize(
    ("code", "details"),
    [
        (grpc.StatusCode.RESOURCE_EXHAUSTED, "capacity: 3 vehicles; 100 % taken, come again"),
        (grpc.StatusCode.NOT_FOUND, ""),
    ],
)
async def test_the_servers_status_and_its_text_arrive(code, details):
    async def refuse(requests: AsyncIterator[bytes], context: Context) -> None:
        async for request in requests:
            await context.write(request)
            await context.abort(code, details, (("retry-after-ms", "5000"),))

    call, received = await exchange(refuse, [b"hello"], 0)
    assert received == [b"hello"]
    assert call.status == Status(code.value[0], details)


def server_of(call: GrpcCall) -> H2Connection:
    """Return the server's end of the call's connection, which has answered with its headers."""
    server = H2Connection(H2Configuration(client_side=False))
    server.initiate_connection()
    server.receive_data(call.data_to_send())
    server.send_headers(CALL, ((":status", "200"), ("content-type", "application/grpc")))
    return server


@given(st.lists(st.binary(max_size=50), max_size=5), st.lists(st.integers(1, 40), max_size=40))
def test_it_does_not_matter_how_the_socket_cuts_the_bytes(messages, cuts):
    call, received = GrpcCall("a", METHOD), list[bytes]()
    server = server_of(call)
    for message in messages:
        server.send_data(CALL, b"\0" + len(message).to_bytes(4, "big") + message)
    data = server.data_to_send()
    for cut in cuts:
        part, data = data[:cut], data[cut:]
        received += call.receive(part)
    assert received + call.receive(data) == messages


def test_what_the_server_has_no_window_for_waits():
    call = GrpcCall("a", METHOD)
    server = server_of(call)
    call.send(bytes(70_000))
    assert call.is_blocked
    server.receive_data(call.data_to_send())
    server.acknowledge_received_data(65_535, CALL)
    call.receive(server.data_to_send())
    assert not call.is_blocked


def test_a_compressed_message_is_refused():
    call = GrpcCall("a", METHOD)
    server = server_of(call)
    server.send_data(CALL, b"\1" + (1).to_bytes(4, "big") + b"x")
    with pytest.raises(ProtocolError, match="compressed"):
        call.receive(server.data_to_send())


def test_a_server_that_goes_away_or_resets_the_stream_ends_the_call():
    away, reset = GrpcCall("a", METHOD), GrpcCall("a", METHOD)
    leaving, resetting = server_of(away), server_of(reset)
    leaving.close_connection(additional_data=b"maintenance")
    away.receive(leaving.data_to_send())
    assert away.status == Status(14, "connection closed by the server: maintenance")
    resetting.reset_stream(CALL, 8)
    reset.receive(resetting.data_to_send())
    assert reset.status == Status(13, "stream reset, HTTP/2 error 8")
    for call in (away, reset):
        call.send(b"too late")


def test_what_is_not_http2_is_refused():
    data_of_a_stream_that_nobody_opened = bytes([0, 0, 1, 0, 0, 0, 0, 0, 3]) + b"x"
    with pytest.raises(ProtocolError, match="HTTP/2"):
        GrpcCall("a", METHOD).receive(data_of_a_stream_that_nobody_opened)
