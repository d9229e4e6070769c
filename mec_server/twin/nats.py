"""A server's part of a twin of many servers: its pictures, and its vehicles' locations, over NATS.

It is a consumer of the twin like any other: one mailbox holds at most the newest picture of a
camera, so pictures for which NATS is too slow are missed, counted, and delay nobody. Nothing is
published that the server has not authenticated and decoded. ``rfcore.wire.nats`` defines the
subjects.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from itertools import count
from pathlib import Path
from typing import Final

import structlog

from mec_server.event_loop import repeat_forever
from mec_server.fields.index import FieldIndex, PublishedFields
from mec_server.metrics import BackgroundTask
from mec_server.nats import FieldExchange, NatsLink, places_bucket, together
from mec_server.twin.metrics import TwinMetrics
from mec_server.twin.service import PictureEncoder, picture_message
from mec_server.twin.state import ReceivedPicture, Twin
from rfcore.errors import ProtocolError
from rfcore.extras import needs
from rfcore.perception.objects import CameraKey
from rfcore.wire.nats import (
    PLACE_HEADER,
    WANTED_S,
    NatsServers,
    VehicleLocation,
    header_bytes,
    key_of,
    picture_subject,
    wanted_encoding,
    wanted_subject,
)
from rfcore.wire.tiles import Tile
from rfcore.wire.twin import Departure, PictureEncoding, Subscription, twin_message_to_wire

with needs("nats"):
    from nats.aio.client import Client
    from nats.aio.msg import Msg
    from nats.js.errors import BadRequestError, KeyNotFoundError, KeyWrongLastSequenceError
    from nats.js.kv import KeyValue

log = structlog.get_logger()

FLUSH_S: Final = 3
BATCH: Final = 16
"""Pictures after which it is waited until NATS has taken them."""
PLACES_EVERY_S: Final = 2.0
"""Period at which locations are written again, well before they expire."""
FAREWELL_S: Final = 1.0
POLL_S: Final = 0.01
AGAIN_S: Final = 0.1
"""Delay before publishing begins, and before it begins anew after an unexpected exception."""
FIELDS_S: Final = 20.0
"""Longest wait at the start for fields that the server lacks and NATS may have."""
END_S: Final = 2.0


class TwinPublisher:
    """Publishes ``twin`` as server ``name``. ``tiles`` says what the server publishes now."""

    def __init__(
        self,
        link: NatsLink,
        name: str,
        twin: Twin,
        pictures: PictureEncoder,
        tiles: Callable[[], tuple[Tile, ...]],
        metrics: TwinMetrics,
    ) -> None:
        self._link = link
        self._name = name
        self._twin = twin
        self._pictures = pictures
        self._tiles = tiles
        self._metrics = metrics
        self._arrived = asyncio.Event()
        every = Subscription(encoding=PictureEncoding.NONE)
        self._mailbox = twin.watch(every, self._arrived.set, counts_misses=False)
        self._newest: dict[CameraKey, ReceivedPicture] = {}
        self._again: OrderedDict[CameraKey, ReceivedPicture] = OrderedDict()
        self._wanted: dict[PictureEncoding, float] = {}
        self._too_large = 0
        metrics.nats_missed = lambda: self._mailbox.missed + self._too_large

    async def run(self) -> None:
        """Publish until cancelled."""
        await self._link.run(self._serve)

    async def say_farewell(self) -> None:
        """Wait for a moment until the departures of a server that stops are published.

        Where NATS is not reached they expire.
        """
        with suppress(TimeoutError):
            async with asyncio.timeout(FAREWELL_S):
                while self._link.is_connected and len(self._mailbox):
                    await asyncio.sleep(POLL_S)

    async def _serve(self, client: Client) -> None:
        """Publish over one connection, beginning with the newest pictures for those who listen
        now."""
        await client.subscribe(wanted_subject(None), cb=self._hear_wish)
        self._tell_again()
        await together(self._publish(client), self._keep_places(client))

    async def _hear_wish(self, message: Msg) -> None:
        encoding = wanted_encoding(message.subject)
        if encoding is None:
            return
        if encoding not in self._encodings():
            self._tell_again()
        self._wanted[encoding] = time.monotonic()

    def _tell_again(self) -> None:
        self._again.update(self._newest)
        self._arrived.set()

    def _encodings(self) -> tuple[PictureEncoding, ...]:
        """Return the encodings that are published now: none, and those that somebody wants."""
        since = time.monotonic() - WANTED_S
        wanted = (each for each, at_s in self._wanted.items() if at_s >= since)
        return tuple(dict.fromkeys((PictureEncoding.NONE, *wanted)))

    async def _publish(self, client: Client) -> None:
        for number in count(1):
            entry = self._take()
            if entry is None or number % BATCH == 0:
                await client.flush(FLUSH_S)  # at most one batch of pictures is under way
            if entry is None:
                await self._arrived.wait()
                self._arrived.clear()
            elif isinstance(entry, Departure):
                await self._publish_departure(client, entry)
            else:
                await self._publish_view(client, entry)

    def _take(self) -> ReceivedPicture | Departure | None:
        """Return the next entry to publish."""
        entry = self._mailbox.take()
        if isinstance(entry, ReceivedPicture):
            self._newest[entry.key] = entry
            self._again.pop(entry.key, None)
        if entry is None and self._again:
            return self._again.popitem(last=False)[1]
        return entry

    async def _publish_view(self, client: Client, view: ReceivedPicture) -> None:
        headers = {PLACE_HEADER: self._place(view).encode().decode()}
        headers_bytes = header_bytes(headers)
        for encoding in self._encodings():
            data = await self._pictures.bytes_of(view, encoding)
            age_s = view.age_s(time.monotonic())
            message = picture_message(view, age_s, encoding, data, self._mailbox.skipped[view.key])
            subject = picture_subject(encoding, *view.key)
            body = twin_message_to_wire(message).SerializeToString()
            size_bytes = headers_bytes + len(body)
            if size_bytes > client.max_payload:
                self._too_large += 1
                log.warning("picture larger than NATS takes", vehicle=view.vehicle_id,
                            size_bytes=size_bytes, limit_bytes=client.max_payload)  # fmt: skip
                continue
            await client.publish(subject, body, headers=headers)
            self._metrics.nats_published.labels(encoding).inc()

    async def _publish_departure(self, client: Client, departure: Departure) -> None:
        key = (departure.vehicle_id, departure.camera_id)
        last = self._newest.pop(key, None)
        self._again.pop(key, None)
        if last is None:
            return
        headers = {PLACE_HEADER: self._place(last).encode().decode()}
        body = twin_message_to_wire(departure).SerializeToString()
        for encoding in self._encodings():
            await client.publish(picture_subject(encoding, *key), body, headers=headers)

    def _place(self, view: ReceivedPicture) -> VehicleLocation:
        tiles = (tile for tile in self._tiles() if view.field_id in tile.archive_ids)
        tile = next(tiles, None)
        return VehicleLocation(
            vehicle_id=view.vehicle_id,
            server=self._name,
            session_id=view.session_id,
            opened_time_ns=view.opened_time_ns,
            epoch=view.frame.packet.epoch,
            tile="" if tile is None else tile.name,
            field_id=view.field_id if tile is None else tile.field_id,
        )

    def _places(self) -> Mapping[str, VehicleLocation]:
        """Return the locations of this server's vehicles, each in its newest session."""
        places: dict[str, VehicleLocation] = {}
        for view in self._newest.values():
            place = self._place(view)
            known = places.get(view.vehicle_id)
            if known is None or place.rank > known.rank:
                places[view.vehicle_id] = place
        return places

    async def _keep_places(self, client: Client) -> None:
        records = PlaceRecords(await places_bucket(client))
        while True:
            await records.write(self._places())
            await asyncio.sleep(PLACES_EVERY_S)


class NatsServices:
    """The exchange of fields with other servers over NATS, and the publication of pictures there.

    ``failed`` is called with an unexpected exception of either; it begins anew then.
    """

    def __init__(
        self,
        servers: NatsServers,
        folder: Path,
        index: FieldIndex,
        published: PublishedFields,
        failed: Callable[[BackgroundTask, Exception], None],
    ) -> None:
        self._servers = servers
        self._published = published
        self._failed = failed
        self._exchange = FieldExchange(
            NatsLink(servers, "mec-server fields"),
            folder,
            index,
            published.current,
            published.look_again,
        )
        self._publisher: TwinPublisher | None = None
        self._tasks: list[asyncio.Task[None]] = []

    async def bring_missing(self) -> None:
        """Fetch fields that the folder's manifest names and lacks, as far as NATS has them."""
        await self._exchange.bring_missing(FIELDS_S)

    def publish(
        self, name: str, twin: Twin, pictures: PictureEncoder, metrics: TwinMetrics
    ) -> None:
        """Publish the pictures of ``twin`` as server ``name``, and exchange fields, until left."""
        link = NatsLink(
            self._servers,
            f"mec-server {name}",
            lambda connected, _: metrics.nats_connected.set(connected),
        )
        tiles = self._published.current
        self._publisher = TwinPublisher(link, name, twin, pictures, tiles, metrics)
        for work, task in (
            (self._publisher.run, BackgroundTask.NATS_TWIN),
            (self._exchange.run, BackgroundTask.NATS_FIELDS),
        ):
            repeated = repeat_forever(work, AGAIN_S, partial(self._failed, task))
            self._tasks.append(asyncio.create_task(repeated))

    async def leave(self) -> None:
        """Publish the departures of the streams that have just ended, and disconnect."""
        if self._publisher is None:
            return
        await self._publisher.say_farewell()
        for task in self._tasks:
            task.cancel()
        await asyncio.wait(self._tasks, timeout=END_S)


class PlaceRecords:
    """Writes the locations of this server's vehicles to the bucket, unless another server's are
    newer."""

    def __init__(self, bucket: KeyValue) -> None:
        self._bucket = bucket
        self._written: dict[str, tuple[VehicleLocation, int]] = {}

    async def write(self, places: Mapping[str, VehicleLocation]) -> None:
        """Write ``locations``, and remove those written before of vehicles that are gone."""
        for vehicle_id in self._written.keys() - places.keys():
            _, revision = self._written.pop(vehicle_id)
            with suppress(BadRequestError):  # another server has written since
                await self._bucket.delete(key_of(vehicle_id), last=revision)
        for place in places.values():
            await self._put(place)

    async def _put(self, place: VehicleLocation) -> None:
        """Write one location, in place of an older one."""
        key, value = key_of(place.vehicle_id), place.encode()
        _, revision = self._written.pop(place.vehicle_id, (place, 0))
        try:
            revision = await self._update(key, value, revision)
        except KeyWrongLastSequenceError:
            found = await self._read(key)
            if found is not None and found[0].rank > place.rank:
                return
            try:
                revision = await self._update(key, value, 0 if found is None else found[1])
            except KeyWrongLastSequenceError:
                return  # another server was quicker; the next look decides
        self._written[place.vehicle_id] = (place, revision)

    async def _update(self, key: str, value: bytes, revision: int) -> int:
        if revision:
            revision = await self._bucket.update(key, value, last=revision)
        else:
            revision = await self._bucket.create(key, value)
        return revision

    async def _read(self, key: str) -> tuple[VehicleLocation, int] | None:
        """Return the entry and its revision; ``None`` if there is none that can be read."""
        try:
            entry = await self._bucket.get(key)
            return VehicleLocation.decode(entry.value or b""), entry.revision or 0
        except (KeyNotFoundError, ProtocolError):
            return None
