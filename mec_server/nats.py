"""One connection to NATS, made again for ever, and the exchange of field archives over it.

A coroutine is given each new connection and is cancelled when that is lost: nothing that was to be
sent over the old one is sent over the next. The client library leaves TLS to the server, which
could then be anybody who says that there is none; here TLS is insisted on if it was asked for,
before the login is sent.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Sequence
from contextlib import asynccontextmanager, suppress
from io import BufferedWriter
from pathlib import Path
from typing import Any, Final

import structlog

from mec_server.fields.index import FieldIndex
from rfcore.errors import FieldFormatError, RfedgeError, UnknownField
from rfcore.extras import needs
from rfcore.field.folder import MAX_ARCHIVE_BYTES, SUFFIX
from rfcore.field.store import FieldStore
from rfcore.wire.nats import EXPIRES_S, FIELDS_BUCKET, PLACES_BUCKET, NatsServers
from rfcore.wire.tile_manifest import read_publication
from rfcore.wire.tiles import Tile

with needs("nats"):
    from nats.aio.client import Client
    from nats.errors import ConnectionClosedError, Error, NoRespondersError
    from nats.js.api import KeyValueConfig, StorageType
    from nats.js.errors import BucketNotFoundError, ObjectNotFoundError, ServiceUnavailableError
    from nats.js.kv import KeyValue
    from nats.js.object_store import ObjectStore

log = structlog.get_logger()

CONNECT_S: Final = 2
FIRST_WAIT_S, LONGEST_WAIT_S = 0.1, 0.5
"""Delay between two attempts: a consumer is to be back 2 s after NATS is."""
CLOSE_S: Final = 1.0
STALLED_S: Final = 3.0
"""A connection on which NATS took nothing for this long is closed and made again."""
PING_S: Final = 2
PENDING_BYTES: Final = 8 << 20
"""Most bytes that wait for the socket; the outbox before it holds one picture a camera."""
REQUEST_S: Final = 3.0
EXCHANGE_EVERY_S: Final = 2.0
NO_JETSTREAM = "JetStream is off; start nats-server with -js, or with deploy/nats/nats.conf"

Serve = Callable[[Client], Awaitable[None]]


class NoJetStreamError(Error):
    """The server keeps nothing."""

    def __str__(self) -> str:
        return NO_JETSTREAM


class TlsRefusedError(Error):
    """The server does not speak TLS where that was asked for."""

    def __str__(self) -> str:
        return "the server speaks plaintext; give it a certificate, or nats:// for none"


class _Client(Client):
    """A client that sends nothing before TLS is established, if TLS is asked for."""

    def __init__(self, is_secure: bool) -> None:
        super().__init__()
        self._is_secure = is_secure

    def _connect_command(self) -> bytes:
        if self._is_secure and not self._server_info.get("tls_required"):
            raise TlsRefusedError
        command: bytes = super()._connect_command()
        return command


class NatsLink:
    """Connects to one of ``servers`` as ``name``, and reconnects.

    ``told`` is called with whether it is connected, and a detail, at each change.
    """

    def __init__(
        self,
        servers: NatsServers,
        name: str,
        told: Callable[[bool, str], None] = lambda _connected, _detail: None,
    ) -> None:
        self._servers = servers
        self._name = name
        self._told = told
        self._said: tuple[bool, str] | None = None

    @property
    def is_connected(self) -> bool:
        """Whether there is a connection now."""
        return self._said is not None and self._said[0]

    async def run(self, serve: Serve) -> None:
        """Have ``serve`` use a connection until it returns, or with another if that is lost.

        Ends when ``serve`` returns, or raises anything that is no problem of the connection.
        """
        wait_s = FIRST_WAIT_S
        while True:
            is_connected = False
            try:
                async with self._connection() as (client, lost):
                    is_connected = True
                    self._say(True, _place(client))
                    await _until_lost(client, lost, serve)
                return
            except (Error, OSError, TimeoutError) as error:
                self._say(False, str(error) or type(error).__name__)
            wait_s = FIRST_WAIT_S if is_connected else min(2 * wait_s, LONGEST_WAIT_S)
            await asyncio.sleep(wait_s)

    def _say(self, connected: bool, detail: str) -> None:
        before, self._said = self._said, (connected, detail)
        if before is not None and before == self._said:
            return
        self._told(connected, detail)
        if connected:
            log.info("NATS connected", server=detail)
        elif before is None or before[0]:
            log.warning("NATS not reached, tried again for ever", problem=detail)

    @asynccontextmanager
    async def _connection(self) -> AsyncIterator[tuple[Client, asyncio.Event]]:
        servers, lost = self._servers, asyncio.Event()
        client = _Client(servers.is_secure)
        problems: list[Exception] = []

        async def closed() -> None:
            lost.set()

        async def failed(error: Exception) -> None:
            problems[:] = [error]

        options: dict[str, Any] = dict(servers.credentials())
        if servers.is_secure:
            options["tls"] = servers.tls_context()
        try:
            try:
                await client.connect(
                    servers=list(servers.urls),
                    name=self._name,
                    closed_cb=closed,
                    error_cb=failed,
                    allow_reconnect=False,
                    max_reconnect_attempts=1,
                    reconnect_time_wait=0,
                    connect_timeout=CONNECT_S,
                    ping_interval=PING_S,
                    pending_size=PENDING_BYTES,
                    flush_timeout=STALLED_S,
                    **options,
                )
            except Error as error:
                raise (problems or [error])[0] from error
            yield client, lost
        finally:
            with suppress(Exception):
                async with asyncio.timeout(CLOSE_S):
                    await client.close()


async def _until_lost(client: Client, lost: asyncio.Event, serve: Serve) -> None:
    """Serve to the end; raise what ends it, ``ConnectionClosedError`` if that is the connection."""
    serving = asyncio.ensure_future(serve(client))
    losing = asyncio.create_task(lost.wait())
    try:
        await asyncio.wait({serving, losing}, return_when=asyncio.FIRST_COMPLETED)
        if serving.done() and not serving.cancelled():
            serving.result()
            return
        raise ConnectionClosedError
    finally:
        await _end(serving, losing)


async def together(*work: Coroutine[Any, Any, None]) -> None:
    """Do all of ``work`` until one ends or raises; the others are cancelled."""
    tasks = [asyncio.create_task(each) for each in work]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        await _end(*tasks)


async def _end(*tasks: asyncio.Future[Any]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.wait(tasks, timeout=CLOSE_S)
    for task in tasks:
        if task.done() and not task.cancelled():
            task.exception()  # it was raised already, or came too late to matter


def _place(client: Client) -> str:
    url = client.connected_url
    return url.netloc if url is not None else ""


async def places_bucket(client: Client) -> KeyValue:
    """Return the bucket of vehicles' locations; make it if it is not there.

    Raises ``NoJetStreamError`` where NATS keeps nothing.
    """
    stored = client.jetstream(timeout=REQUEST_S)
    try:
        return await stored.key_value(PLACES_BUCKET)
    except BucketNotFoundError:
        config = KeyValueConfig(PLACES_BUCKET, ttl=EXPIRES_S, storage=StorageType.MEMORY)
        return await stored.create_key_value(config)
    except (NoRespondersError, ServiceUnavailableError) as error:
        raise NoJetStreamError from error


async def _fields_bucket(client: Client) -> ObjectStore:
    stored = client.jetstream(timeout=REQUEST_S)
    try:
        return await stored.object_store(FIELDS_BUCKET)
    except BucketNotFoundError:
        return await stored.create_object_store(FIELDS_BUCKET)
    except (NoRespondersError, ServiceUnavailableError) as error:
        raise NoJetStreamError from error


async def fetch_object(client: Client, field_id: str, folder: Path) -> None:
    """Put a field of the object store into ``folder``, under its id, checked against it before
    anything is parsed.

    Raises ``UnknownField`` where the store lacks it, ``FieldFormatError`` when what comes is not
    the field, and errors of NATS and the disk.
    """
    objects = await _fields_bucket(client)
    try:
        info = await objects.get_info(field_id)
    except ObjectNotFoundError as error:
        raise UnknownField(
            f"field {field_id} is not in NATS; a server that has it puts it there"
        ) from error
    size_bytes = info.size or 0
    if not 0 < size_bytes <= MAX_ARCHIVE_BYTES:
        raise FieldFormatError(
            f"field {field_id} has {size_bytes} bytes in NATS, not 1..{MAX_ARCHIVE_BYTES}"
        )
    log.info("fetching field from NATS", field=field_id, size_bytes=size_bytes)
    partial = folder / f".{field_id}.nats"
    try:
        with partial.open("wb") as file:
            await _receive(objects, field_id, file)
        await asyncio.to_thread(FieldStore(folder).add, partial, field_id)
    finally:
        partial.unlink(missing_ok=True)
    log.info("field fetched from NATS", field=field_id)


async def _receive(objects: ObjectStore, field_id: str, file: BufferedWriter) -> None:
    """Write an object into ``file``; raise ``UnknownField`` when nothing more comes of it.

    A server that puts the same field at the same time replaces the pieces that are waited for.
    """
    receiving = asyncio.create_task(objects.get(field_id, writeinto=file))
    try:
        had_bytes = -1
        while file.tell() > had_bytes:
            had_bytes = file.tell()
            if (await asyncio.wait({receiving}, timeout=STALLED_S))[0]:
                receiving.result()
                return
        raise UnknownField(
            f"field {field_id} stopped after {had_bytes} bytes from NATS; it is tried again"
        )
    finally:
        await _end(receiving)


class FieldExchange:
    """Exchanges field archives with other servers through the object store.

    It puts the archives of the current ``tiles`` there (without tiles: all of ``index``), and
    fetches those that the manifest in ``folder`` names and ``index`` lacks; ``fetched`` is called
    after each.
    """

    def __init__(
        self,
        link: NatsLink,
        folder: Path,
        index: FieldIndex,
        tiles: Callable[[], tuple[Tile, ...]],
        fetched: Callable[[], None],
    ) -> None:
        self._link = link
        self._folder = folder
        self._index = index
        self._tiles = tiles
        self._fetched = fetched
        self._problems: dict[str, str] = {}

    async def run(self) -> None:
        """Exchange fields until cancelled."""
        await self._link.run(self._exchange)

    async def bring_missing(self, within_s: float) -> None:
        """Fetch what the manifest names and the folder lacks, as far as it comes in time."""
        if not await asyncio.to_thread(self._missing):
            return
        with suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                await self._link.run(self._bring_all)

    async def _bring_all(self, client: Client) -> None:
        while missing := await asyncio.to_thread(self._missing):
            await self._bring(client, missing)
            await asyncio.sleep(FIRST_WAIT_S)

    async def _exchange(self, client: Client) -> None:
        there: set[str] = set()
        while True:
            missing = await asyncio.to_thread(self._missing)
            if missing:
                await self._bring(client, missing)
            objects = await _fields_bucket(client)
            for field_id in _archives(self._tiles()) or self._index.ids():
                if field_id not in there:
                    await self._put(objects, field_id)
                    there.add(field_id)
            await asyncio.sleep(EXCHANGE_EVERY_S)

    async def _put(self, objects: ObjectStore, field_id: str) -> None:
        try:
            path = self._index.published_path(field_id)
        except UnknownField:
            return  # withdrawn meanwhile
        with suppress(ObjectNotFoundError):
            if (await objects.get_info(field_id)).size == path.stat().st_size:
                return
        with path.open("rb") as file:
            await objects.put(field_id, file)
        log.info("field put into NATS", field=field_id)

    async def _bring(self, client: Client, field_ids: Sequence[str]) -> None:
        for field_id in field_ids:
            try:
                await fetch_object(client, field_id, self._folder)
            except (RfedgeError, OSError) as error:
                if self._problems.get(field_id) != str(error):
                    log.warning("field not fetched", field=field_id, problem=str(error))
                self._problems[field_id] = str(error)
            else:
                self._problems.pop(field_id, None)
                self._fetched()

    def _missing(self) -> tuple[str, ...]:
        try:
            tiles = read_publication(self._folder).current()
        except (RfedgeError, OSError):
            return ()  # whoever takes up publications says so
        here = set(self._index.ids())
        return tuple(i for i in _archives(tiles) if i not in here and not self._has(i))

    def _has(self, field_id: str) -> bool:
        return (self._folder / f"{field_id}{SUFFIX}").is_file()


def _archives(tiles: Sequence[Tile]) -> tuple[str, ...]:
    """Return the archives of tiles, bases before the layers that need them."""
    ids = (i for tile in tiles for i in (tile.field_id, *_of_lights(tile)))
    return tuple(dict.fromkeys(ids))


def _of_lights(tile: Tile) -> tuple[str, ...]:
    return tuple(i for light in tile.lights for i in light.field_ids)
