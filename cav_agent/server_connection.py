"""The vehicle's connection to one server: address, channel, and the tiles that it publishes.

Every stream and every fetch of a field goes over this channel. A wait that fails says why: a
refused certificate is not mistaken for a server that is away.
"""

from __future__ import annotations

import asyncio
import time
from types import TracebackType
from typing import Self

import grpc
import structlog

from cav_agent.config import AgentConfig
from rfcore.errors import AccessDenied, InvalidInput, RfedgeError, UnknownField
from rfcore.wire.address import ASK_AFTER_S, Address, check_handshake
from rfcore.wire.conventions import CHANNEL_OPTIONS, RECONNECT_S, VEHICLE
from rfcore.wire.tiles import MAX_TILES, Tile, tile_of
from rfcore.wire.tls import TlsFiles
from rfcore.wire.v1 import field_pb2 as pb
from rfcore.wire.v1.field_pb2_grpc import FieldServiceStub
from rfcore.wire.values import check_field_id
from rfcore.wire.waits import WaitLog, log_wait, waiting

log = structlog.get_logger()

REFUSED = (grpc.StatusCode.PERMISSION_DENIED, grpc.StatusCode.UNAUTHENTICATED)

LIST_S = 10.0
"""Longest time for a connected server to list its tiles."""

WHOLE_STREET = "street"
"""Name of the only tile of a server that publishes none."""


class ServerConnection:
    """A server's address and, inside ``async with``, the channel to it.

    ``fields_changed`` is set when the server notifies a stream that it publishes other fields.
    ``metadata``, the vehicle's name, goes with calls for lists and archives, so that a proxy can
    place them where it places the vehicle's streams.
    """

    def __init__(self, address: Address, tls: TlsFiles | None, vehicle_id: str) -> None:
        self.address = address
        self.metadata = ((VEHICLE, vehicle_id),)
        self.fields_changed = asyncio.Event()
        self._tls = tls
        self._channel: grpc.aio.Channel | None = None
        self._problem = ""
        self._failures = WaitLog(self._say_failure, first_s=0.0)

    async def __aenter__(self) -> Self:
        self._channel = self._open()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._channel is not None:
            await self._channel.close()

    @property
    def channel(self) -> grpc.aio.Channel:
        """The channel, encrypted if there are certificates."""
        if self._channel is None:
            raise InvalidInput("channel", f"the connection to {self.address} is not open")
        return self._channel

    def _open(self) -> grpc.aio.Channel:
        if self._tls is None:
            return grpc.aio.insecure_channel(str(self.address), options=CHANNEL_OPTIONS)
        credentials = self._tls.channel_credentials()
        return grpc.aio.secure_channel(str(self.address), credentials, options=CHANNEL_OPTIONS)

    async def wait_until_ready(self, within_s: float | None) -> None:
        """Wait until the channel is connected, for ever if ``within_s`` is None.

        What keeps it from connecting is logged. Raises ``AccessDenied`` if the ends refuse each
        other, else ``TimeoutError``.
        """
        try:
            async with asyncio.timeout(within_s):
                await self._ready()
        except TimeoutError:
            await self._ask()
            raise

    async def require(self, within_s: float | None) -> grpc.aio.Channel:
        """Return the channel once it is connected; raise ``RfedgeError`` if that takes longer."""
        try:
            await self.wait_until_ready(within_s)
        except TimeoutError as error:
            raise self._no_server(within_s or 0.0) from error
        return self.channel

    async def published_tiles(self, within_s: float | None) -> tuple[Tile, ...]:
        """Return the tiles the server publishes; without tiles, its only field, everywhere.

        Raises ``UnknownField`` for several fields without tiles, ``InvalidInput`` for a wrong tile,
        ``AccessDenied`` when the certificate does not permit it,
        ``RfedgeError`` when no answer comes within ``within_s``.
        """
        stub = FieldServiceStub(await self.require(within_s))
        limit_s = LIST_S if within_s is None else within_s
        what = f"the list of fields of {self.address}"
        try:
            with waiting(what, log_wait):
                async with asyncio.timeout(limit_s):
                    listed = await stub.ListFields(
                        pb.ListFieldsRequest(), metadata=self.metadata, wait_for_ready=True
                    )
        except TimeoutError as error:
            raise self._no_server(limit_s) from error
        except grpc.aio.AioRpcError as error:
            if error.code() in REFUSED:
                raise AccessDenied(f"{self.address}: {error.details()}") from error
            raise RfedgeError(f"the server does not list its fields: {error.details()}") from error
        return _tiles_of(listed)

    def _no_server(self, within_s: float) -> RfedgeError:
        cause = f": {self._problem}" if self._problem else ""
        return RfedgeError(f"no server at {self.address} within {within_s:g} s{cause}")

    async def _ready(self) -> None:
        ready = asyncio.ensure_future(self.channel.channel_ready())
        try:
            while not (await asyncio.wait({ready}, timeout=ASK_AFTER_S))[0]:
                await self._ask()
            ready.result()
        finally:
            ready.cancel()
            await asyncio.gather(ready, return_exceptions=True)
        if self._problem:
            log.info("server reached", server=str(self.address))
        self._note("")

    async def _ask(self) -> None:
        """Find out, and log, why there is no connection; raise ``AccessDenied`` for a refusal."""
        self._note(await asyncio.to_thread(check_handshake, self.address, self._tls))

    def _note(self, problem: str) -> None:
        self._problem = problem
        self._failures.note(problem, time.monotonic())

    def _say_failure(self, problem: str, since_s: float) -> None:
        log.warning(
            "no connection",
            server=str(self.address),
            problem=problem,
            since_s=round(since_s, 1),
            again_in_s=RECONNECT_S,
        )


def server_connections(config: AgentConfig) -> tuple[ServerConnection, ...]:
    """Return the server of ``config`` and its neighbours; raise ``InvalidInput`` for an address
    that cannot be, or a remote one without encryption."""
    named = [("server", config.server), *(("neighbours", text) for text in config.neighbours)]
    return tuple(_server_connection(name, text, config) for name, text in named)


def _server_connection(name: str, text: str, config: AgentConfig) -> ServerConnection:
    address = Address.parse(name, text)
    tls = config.transport.tls()
    if tls is None:
        address.require_private(name, config.transport.allow_insecure)
    return ServerConnection(address, tls, config.vehicle)


def _tiles_of(listed: pb.ListFieldsResponse) -> tuple[Tile, ...]:
    if len(listed.tiles) > MAX_TILES:
        raise InvalidInput("tiles", f"the server lists {len(listed.tiles)}, above {MAX_TILES}")
    if listed.tiles:
        return tuple(map(tile_of, listed.tiles))
    if len(listed.field_ids) != 1:
        here = ", ".join(listed.field_ids) or "none"
        raise UnknownField(f"the server holds several fields or none ({here}); choose with --field")
    return (Tile(WHOLE_STREET, check_field_id("field", listed.field_ids[0])),)
