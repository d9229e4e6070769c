"""Fields and pictures of many servers from one NATS, for the page and for ``rfedge watch``.

``SharedTwin`` decides which server shows a vehicle (``rfcore.wire.nats``); it has neither NATS nor
a clock. While NATS is away the page keeps showing what it has until that expires.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Generator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import structlog
from google.protobuf.message import DecodeError

from mec_server.nats import NatsLink, fetch_object, places_bucket, together
from rfcore.errors import ProtocolError, RfedgeError
from rfcore.extras import needs
from rfcore.field import FieldStore
from rfcore.perception.objects import CameraKey
from rfcore.wire.nats import (
    EXPIRES_S,
    PLACE_HEADER,
    WANTED_EVERY_S,
    NatsServers,
    VehicleLocation,
    VehicleLocations,
    pictures_subject,
    vehicle_of_subject,
    wanted_subject,
)
from rfcore.wire.twin import (
    Departure,
    NewestQueue,
    PictureEncoding,
    Subscription,
    TwinPicture,
    twin_message_from_wire,
)
from rfcore.wire.v1 import twin_pb2
from rfedge.twin.scene import PlacedField, TwinScene

with needs("nats"):
    from nats.aio.client import Client
    from nats.aio.msg import Msg

log = structlog.get_logger()

EXPIRE_EVERY_S: Final = 0.5
CONNECT_S: Final = 10.0
FIELDS_AGAIN_S: Final = 2.0
"""Delay before a field that was not in NATS is tried again."""

TwinMessage = TwinPicture | Departure


@dataclass(frozen=True)
class _Shown:
    session: tuple[str, str]
    at_s: float


class SharedTwin:
    """The cameras that all servers show, each vehicle's at its newest session. ``now``: seconds."""

    def __init__(self) -> None:
        self.places = VehicleLocations()
        self._shown: dict[CameraKey, _Shown] = {}

    def hear(self, place: VehicleLocation, message: TwinMessage, now: float) -> bool:
        """Take in a published message; return whether it is to be shown."""
        key = message.key
        if isinstance(message, TwinPicture):
            if not self.places.hear(place, now):
                return False
            self._shown[key] = _Shown(place.session, now)
            return True
        self.places.end(place, now)
        shown = self._shown.get(key)
        if shown is None or shown.session != place.session:
            return False
        del self._shown[key]
        return True

    def expire(self, now: float) -> list[Departure]:
        """Return departures of cameras that no server shows any more, or only an older session
        does."""
        self.places.expire(now)
        gone = [key for key, shown in self._shown.items() if self._is_over(key[0], shown, now)]
        for key in gone:
            del self._shown[key]
        return [Departure(*key) for key in gone]

    def _is_over(self, vehicle_id: str, shown: _Shown, now: float) -> bool:
        place = self.places.place_of(vehicle_id)
        if place is None:
            return True
        return place.session != shown.session and now - shown.at_s > EXPIRES_S


Take = Callable[[TwinMessage, VehicleLocation | None], None]
"""Takes a picture and its vehicle's location; a departure comes without."""


class NatsReader:
    """Reads ``subscription`` from NATS and calls ``take`` with each vehicle's messages, once.

    ``say`` is called with whether NATS is connected, and a detail.
    """

    def __init__(
        self,
        servers: NatsServers,
        subscription: Subscription,
        take: Take,
        say: Callable[[bool, str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._link = NatsLink(servers, "rfedge twin", say)
        self._subscription = subscription
        self._take = take
        self._clock = clock
        self._twin = SharedTwin()
        self._problem = ""

    async def run(self) -> None:
        """Read until cancelled, over as many connections as it takes."""
        await together(self._link.run(self._read), self._expire())

    async def _read(self, client: Client) -> None:
        wanted = self._subscription
        for vehicle_id in (*sorted(wanted.vehicle_ids),) or (None,):
            await client.subscribe(pictures_subject(wanted.encoding, vehicle_id), cb=self._hear)
        await together(self._want(client), self._follow_places(client))

    async def _want(self, client: Client) -> None:
        subject = wanted_subject(self._subscription.encoding)
        while True:
            await client.publish(subject)
            await asyncio.sleep(WANTED_EVERY_S)

    async def _follow_places(self, client: Client) -> None:
        """Follow the locations of all vehicles, also of those that send nothing now."""
        watcher = await (await places_bucket(client)).watchall(ignore_deletes=True)
        async for entry in watcher:
            if entry is not None:
                with suppress(ProtocolError):
                    place = VehicleLocation.decode(entry.value or b"")
                    self._twin.places.hear(place, self._clock())

    async def _expire(self) -> None:
        while True:
            await asyncio.sleep(EXPIRE_EVERY_S)
            for departure in self._twin.expire(self._clock()):
                self._take(departure, None)

    async def _hear(self, published: Msg) -> None:
        try:
            place, message = published_message(
                published.subject, (published.headers or {}).get(PLACE_HEADER, ""), published.data
            )
        except ProtocolError as error:
            if str(error) != self._problem:
                log.warning("a server published what cannot be shown", problem=str(error))
            self._problem = str(error)
            return
        if self._twin.hear(place, message, self._clock()):
            self._take(message, place if isinstance(message, TwinPicture) else None)


def published_message(
    subject: str, header: str, body: bytes
) -> tuple[VehicleLocation, TwinMessage]:
    """Return the location and message that a server published.

    Raises ``ProtocolError`` unless subject, header and message name one vehicle: NATS gives
    permissions by the subject.
    """
    try:
        message = twin_message_from_wire(twin_pb2.WatchResponse.FromString(body))
    except DecodeError as error:
        raise ProtocolError(f"{subject}: {error}") from error
    place = VehicleLocation.decode(header.encode())
    named = {vehicle_of_subject(subject), place.vehicle_id, message.vehicle_id}
    if len(named) > 1:
        raise ProtocolError(f"{subject} carries what is of {', '.join(sorted(named))}")
    return place, message


class NatsSource:
    """Shows in ``scene`` what all servers show.

    ``fields``: folder for fetched fields; ``threads`` render each of them.
    """

    def __init__(
        self,
        servers: NatsServers,
        fields: Path,
        scene: TwinScene,
        threads: int = 1,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._scene = scene
        self._folder = fields
        self._store = FieldStore(fields)
        self._threads = threads
        self._clock = clock
        wanted = Subscription(encoding=PictureEncoding.JPEG)
        self._reader = NatsReader(servers, wanted, self._take, self._say, clock)
        self._link = NatsLink(servers, "rfedge twin fields")
        self._wanted: OrderedDict[str, str] = OrderedDict()
        self._asked = asyncio.Event()

    @property
    def live(self) -> None:
        """None: over NATS there are neither objects nor views."""

    async def run(self) -> None:
        """Show pictures until cancelled; fields come over a connection of their own."""
        await together(self._reader.run(), self._link.run(self._bring_fields))

    def _say(self, connected: bool, detail: str) -> None:
        self._scene.connection("connected" if connected else "waiting", detail, self._clock())

    def _take(self, message: TwinMessage, place: VehicleLocation | None) -> None:
        if isinstance(message, Departure):
            self._scene.leave(message.key, self._clock())
            return
        self._scene.show(message, self._clock())
        if place is not None and self._scene.field(place.field_id) is None:
            self._wanted[place.field_id] = place.tile or place.field_id[:8]
            self._asked.set()

    async def _bring_fields(self, client: Client) -> None:
        """Place the fields that vehicles drive in, one after the other."""
        while True:
            self._asked.clear()
            while self._wanted:
                field_id, tile = self._wanted.popitem(last=False)
                if self._scene.field(field_id) is None and not await self._bring(
                    client, field_id, tile
                ):
                    await asyncio.sleep(FIELDS_AGAIN_S)
            await self._asked.wait()

    async def _bring(self, client: Client, field_id: str, tile: str) -> bool:
        self._scene.note(tile, "being fetched", self._clock())
        try:
            if field_id not in await asyncio.to_thread(self._store.ids):
                await fetch_object(client, field_id, self._folder)
            placed = await asyncio.to_thread(self._placed, field_id, tile)
        except RfedgeError as error:
            log.warning("field cannot be shown", field=field_id, problem=str(error))
            self._scene.note(tile, str(error), self._clock())
            return False
        self._scene.place(placed, self._clock())
        return True

    def _placed(self, field_id: str, tile: str) -> PlacedField:
        return PlacedField.of(self._store.load(field_id, threads=self._threads), tile)


class NatsPictures:
    """The pictures of all servers for a thread that waits for one message after the other (``rfedge
    watch``).

    Pictures that are not taken are replaced by newer ones of the same camera.
    """

    def __init__(self, servers: NatsServers) -> None:
        self._servers = servers
        self._lock = threading.Lock()
        self._stopped = False
        self._wake: Callable[[], None] = lambda: None
        self._waiting = NewestQueue[tuple[CameraKey, type], TwinMessage](lambda: self._wake())
        self._is_connected = False
        self._detail = ""

    def watch(
        self,
        subscription: Subscription,
        connected: Callable[[str], None] = lambda _: None,
        problem: Callable[[str], None] = lambda _: None,  # noqa: ARG002
    ) -> Generator[TwinMessage, None, None]:
        """Yield what arrives until ``stop``; raise ``RfedgeError`` if there is no NATS at first.

        ``connected`` is called once there is one; the error says why there is none.
        """
        with asyncio.Runner() as runner:
            loop, arrived = runner.get_loop(), asyncio.Event()
            with self._lock:
                self._wake = lambda: _wake(loop, arrived)
            reader = NatsReader(self._servers, subscription, self._take, self._say)
            reading = loop.create_task(reader.run())
            runner.run(self._until_connected(reading, arrived))
            connected("")
            while not self._stopped:
                if not self._waiting:
                    runner.run(_until(reading, arrived))
                elif (message := self._waiting.take()) is not None:
                    yield message
            reading.cancel()

    def stop(self) -> None:
        """End ``watch``; may be called from any thread, and before it."""
        with self._lock:
            self._stopped = True
            self._wake()

    def _take(self, message: TwinMessage, _: VehicleLocation | None) -> None:
        if isinstance(message, TwinPicture):
            self._waiting.discard((message.key, Departure))
        self._waiting.put((message.key, type(message)), message)

    def _say(self, connected: bool, detail: str) -> None:
        self._is_connected, self._detail = connected, detail
        self._wake()

    async def _until_connected(self, reading: asyncio.Task[None], arrived: asyncio.Event) -> None:
        try:
            async with asyncio.timeout(CONNECT_S):
                while not (self._is_connected or self._stopped):
                    await _until(reading, arrived)
        except TimeoutError:
            urls = ", ".join(self._servers.urls)
            raise RfedgeError(f"no NATS at {urls} within {CONNECT_S:g} s: {self._detail}") from None


async def _until(reading: asyncio.Task[None], arrived: asyncio.Event) -> None:
    """Wait until something arrived; raise what ended the reading."""
    waiting = asyncio.create_task(arrived.wait())
    try:
        await asyncio.wait({reading, waiting}, return_when=asyncio.FIRST_COMPLETED)
    finally:
        waiting.cancel()
    arrived.clear()
    if reading.done():
        reading.result()


def _wake(loop: asyncio.AbstractEventLoop, arrived: asyncio.Event) -> None:
    with suppress(RuntimeError):  # the loop is closed: there is nobody to wake
        loop.call_soon_threadsafe(arrived.set)
