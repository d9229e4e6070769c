"""The connection to a server: checked before use, and honest about who does not answer."""

import socket
from dataclasses import replace
from pathlib import Path

import grpc
import pytest
from structlog.testing import capture_logs

from cav_agent.config import AgentConfig
from cav_agent.server_connection import ServerConnection, server_connections
from rfcore.errors import InvalidInput, RfedgeError, UnknownField
from rfcore.wire.address import Address
from rfcore.wire.conventions import RECONNECT_S, VEHICLE
from rfcore.wire.tiles import MAX_TILES
from rfcore.wire.v1 import field_pb2 as pb
from rfcore.wire.v1.field_pb2_grpc import FieldServiceServicer, add_FieldServiceServicer_to_server

CONFIG = AgentConfig("127.0.0.1:50051", Path("drive"))
FIELD = "ab" * 32


class ListedFields(FieldServiceServicer):
    """Lists what it is told to."""

    def __init__(self, listed: pb.ListFieldsResponse) -> None:
        self.listed = listed
        self.asked_as: list[str] = []

    async def ListFields(self, request, context):  # type: ignore[no-untyped-def]  # noqa: N802, ARG002
        self.asked_as.append(dict(context.invocation_metadata())[VEHICLE])
        return self.listed


async def published_by(listed: pb.ListFieldsResponse) -> object:
    """Return what a connection says a server publishes that lists this."""
    server = grpc.aio.server()
    fields = ListedFields(listed)
    add_FieldServiceServicer_to_server(fields, server)
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    try:
        async with ServerConnection(Address("127.0.0.1", port), None, "cav-1") as connection:
            return await connection.published_tiles(10.0)
    finally:
        await server.stop(None)
        assert fields.asked_as == ["cav-1"], "a proxy can place the call by the vehicle"


def tile(name: str) -> pb.Tile:
    area = pb.Area(west_m=0.0, south_m=0.0, east_m=10.0, north_m=10.0)
    return pb.Tile(name=name, field_id=FIELD, version=1, area=area, margin_m=1.0)


def test_the_server_and_its_neighbours_are_connections_in_their_order() -> None:
    config = replace(CONFIG, neighbours=("127.0.0.1:50052", "127.0.0.1:50053"))
    addresses = [str(connection.address) for connection in server_connections(config)]
    assert addresses == ["127.0.0.1:50051", "127.0.0.1:50052", "127.0.0.1:50053"]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"server": "nowhere"}, "server"),
        ({"neighbours": ("127.0.0.1:99999",)}, "neighbours"),
        ({"server": "192.0.2.1:50051"}, "not encrypted; give --allow-insecure"),
    ],
)
def test_an_address_that_cannot_be_used_is_refused_by_its_option(
    change: dict[str, object], named: str
) -> None:
    with pytest.raises(InvalidInput, match=named):
        server_connections(replace(CONFIG, **change))  # type: ignore[arg-type]


async def test_a_channel_is_there_only_while_the_connection_is_open() -> None:
    connection = ServerConnection(Address("127.0.0.1", 1), None, "cav-1")
    with pytest.raises(InvalidInput, match=r"the connection to 127\.0\.0\.1:1 is not open"):
        _ = connection.channel
    async with connection:
        assert isinstance(connection.channel, grpc.aio.Channel)


async def test_a_server_that_is_not_there_is_named_with_the_time_waited() -> None:
    async with ServerConnection(Address("127.0.0.1", 1), None, "cav-1") as connection:
        with pytest.raises(RfedgeError, match=r"no server at 127\.0\.0\.1:1 within 0\.05 s"):
            await connection.require(0.05)
        with pytest.raises(RfedgeError, match=r"no server at 127\.0\.0\.1:1 within 0\.05 s"):
            await connection.published_tiles(0.05)


@pytest.mark.parametrize(
    ("address", "cause"),
    [("127.0.0.1:1", "refused"), ("nowhere.invalid:1", "DNS"), ("silent", "says nothing")],
)
async def test_a_connection_that_fails_is_logged_once_with_its_cause(
    address: str, cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cav_agent.server_connection.ASK_AFTER_S", 0.02)
    monkeypatch.setattr("rfcore.wire.address.HANDSHAKE_TIMEOUT_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as silent, capture_logs() as logs:
        if address == "silent":
            address = f"127.0.0.1:{silent.getsockname()[1]}"
        async with ServerConnection(Address.parse("server", address), None, "cav-1") as connection:
            with pytest.raises(RfedgeError, match=cause):
                await connection.require(1.0)
    (line,) = logs
    assert (line["event"], line["server"]) == ("no connection", address)
    assert cause in line["problem"]
    assert line["again_in_s"] == RECONNECT_S


async def test_a_server_without_tiles_publishes_its_only_field_everywhere() -> None:
    (only,) = await published_by(pb.ListFieldsResponse(field_ids=[FIELD]))  # type: ignore[misc]
    assert (only.name, only.field_id) == ("street", FIELD)
    assert only.distance_m(1e6, -1e6) == 0.0


@pytest.mark.parametrize("ids", [[], [FIELD, "cd" * 32]])
async def test_without_tiles_none_or_several_fields_leave_the_choice_to_the_user(
    ids: list[str],
) -> None:
    with pytest.raises(UnknownField, match="choose with --field"):
        await published_by(pb.ListFieldsResponse(field_ids=ids))


async def test_a_server_that_lists_too_many_tiles_is_refused_with_both_numbers() -> None:
    tiles = [tile(f"tile-{number}") for number in range(MAX_TILES + 1)]
    with pytest.raises(InvalidInput, match=f"lists {MAX_TILES + 1}, above {MAX_TILES}"):
        await published_by(pb.ListFieldsResponse(tiles=tiles))
