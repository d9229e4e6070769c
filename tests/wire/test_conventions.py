"""Names and numbers that both ends rely on agree with the generated code and with each other."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Any

import grpc
import pytest

from every_error import every_error
from mec_server.peers import status_of
from rfcore.errors import RejectReason, RfedgeError
from rfcore.wire.conventions import (
    CHANNEL_OPTIONS,
    MAX_MESSAGE_BYTES,
    SERVER_OPTIONS,
    STREAM_METHOD,
)
from rfcore.wire.v1 import edge_pb2
from rfcore.wire.values import MAX_PAYLOAD_BYTES


@pytest.mark.parametrize("error", every_error(), ids=lambda e: type(e).__name__)
def test_every_error_has_a_status_and_only_the_root_is_internal_by_default(
    error: RfedgeError,
) -> None:
    status = status_of(error)
    assert status is not grpc.StatusCode.OK
    expected_internal = type(error).__name__ in ("RfedgeError", "CodecError", "TrainingDiverged")
    assert (status is grpc.StatusCode.INTERNAL) == expected_internal


def test_the_stream_method_is_the_one_of_the_proto() -> None:
    service = edge_pb2.DESCRIPTOR.services_by_name["EdgeService"]
    assert f"/{service.full_name}/{service.methods[0].name}" == STREAM_METHOD


def test_every_reject_reason_is_on_the_wire_under_the_same_name() -> None:
    on_wire = {
        name.removeprefix("REJECT_REASON_")
        for name in edge_pb2.RejectReason.DESCRIPTOR.values_by_name
    }
    assert on_wire == {reason.name for reason in RejectReason}


def test_the_largest_payload_fits_a_message_with_its_header() -> None:
    assert MAX_PAYLOAD_BYTES + 1024 < MAX_MESSAGE_BYTES


def test_the_server_permits_the_keepalive_of_the_client_with_margin() -> None:
    client, server = dict(CHANNEL_OPTIONS), dict(SERVER_OPTIONS)
    permitted_ms = server["grpc.http2.min_ping_interval_without_data_ms"]
    assert 2 * permitted_ms <= client["grpc.keepalive_time_ms"]


async def _echo(requests: Any, context: Any) -> AsyncIterator[bytes]:  # noqa: ARG001
    async for request in requests:
        yield request


async def test_a_connection_that_answers_nothing_any_more_is_given_up() -> None:
    is_silent = False

    async def forward(
        reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, answers: bool
    ) -> None:
        while data := await reader.read(65536):
            if not (answers and is_silent):
                writer.write(data)
        writer.close()

    server = grpc.aio.server(options=SERVER_OPTIONS)
    echo = grpc.stream_stream_rpc_method_handler(_echo)
    handler = grpc.method_handlers_generic_handler("test", {"Echo": echo})
    server.add_generic_rpc_handlers((handler,))
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()

    connections = list[asyncio.Task[Any] | None]()

    async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        connections.append(asyncio.current_task())
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", port)
        async with asyncio.TaskGroup() as both:
            both.create_task(forward(reader, far_writer, answers=False))
            both.create_task(forward(far_reader, writer, answers=True))
        for end in (writer, far_writer):
            with suppress(ConnectionError):
                await end.wait_closed()

    proxy = await asyncio.start_server(connected, "127.0.0.1", 0)
    address = f"127.0.0.1:{proxy.sockets[0].getsockname()[1]}"
    async with grpc.aio.insecure_channel(address, options=CHANNEL_OPTIONS) as channel:
        call = channel.stream_stream("/test/Echo")()
        await call.write(b"x")
        assert await call.read() == b"x"
        is_silent = True
        with pytest.raises(grpc.aio.AioRpcError, match="UNAVAILABLE"):
            await asyncio.wait_for(call.read(), 15)
    proxy.close()
    await server.stop(None)
    async with asyncio.timeout(15):
        await asyncio.gather(*filter(None, connections))
