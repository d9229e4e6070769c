"""The bytes of a prerecorded vehicle's call are what gRPC's own server understands, and back."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable

import grpc
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.errors import ProtocolError
from rfcore.wire.conventions import SERVER_OPTIONS
from rfedge.loadtest.grpc_call import GrpcCall, Status

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


async def test_messages_larger_than_every_window_come_back_whole() -> None:
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
async def test_the_servers_status_and_its_text_arrive(code: grpc.StatusCode, details: str) -> None:
    async def refuse(requests: AsyncIterator[bytes], context: Context) -> None:
        async for request in requests:
            await context.write(request)
            await context.abort(code, details, (("retry-after-ms", "5000"),))

    call, received = await exchange(refuse, [b"hello"], 0)
    assert received == [b"hello"]
    assert call.status == Status(code.value[0], details)


def server_bytes(*messages: bytes) -> bytes:
    """What a server writes for messages: SETTINGS, then each in a DATA frame."""
    settings = bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])
    frames = (
        len(body).to_bytes(3, "big") + bytes([0, 0, 0, 0, 0, 1]) + body
        for body in (b"\0" + len(m).to_bytes(4, "big") + m for m in messages)
    )
    return settings + b"".join(frames)


@given(st.lists(st.binary(max_size=50), max_size=5), st.lists(st.integers(1, 40), max_size=40))
def test_it_does_not_matter_how_the_socket_cuts_the_bytes(
    messages: list[bytes], cuts: list[int]
) -> None:
    data, call, received = server_bytes(*messages), GrpcCall("a", METHOD), list[bytes]()
    for cut in cuts:
        part, data = data[:cut], data[cut:]
        received += call.receive(part)
    assert received + call.receive(data) == messages


def test_what_the_server_has_no_window_for_waits() -> None:
    call = GrpcCall("a", METHOD)
    call.data_to_send()
    call.send(bytes(70_000))
    assert call.is_blocked
    sent = len(call.data_to_send())
    widen = b"".join(
        bytes([0, 0, 4, 8, 0]) + stream.to_bytes(4, "big") + (10_000).to_bytes(4, "big")
        for stream in (0, 1)
    )
    call.receive(widen)
    assert not call.is_blocked
    rest = len(call.data_to_send())
    heads = 5 * 9  # 65535 bytes take four frames of at most 16384, the rest another
    assert sent + rest == 5 + 70_000 + heads


def test_a_compressed_message_is_refused() -> None:
    body = b"\1" + (1).to_bytes(4, "big") + b"x"
    frame = len(body).to_bytes(3, "big") + bytes([0, 0, 0, 0, 0, 1]) + body
    with pytest.raises(ProtocolError, match="compressed"):
        GrpcCall("a", METHOD).receive(frame)
