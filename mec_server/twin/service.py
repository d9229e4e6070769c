"""TwinService over grpc.aio: one coroutine per consumer, between its mailbox and its stream.

One thread encodes pictures, each once for all consumers, so that consumers take no time from the
workers that decode.
"""

from __future__ import annotations

import asyncio
import math
import time
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

import grpc

from mec_server.config import SessionLimits
from mec_server.ledger.ledger import Hold
from mec_server.peers import Slots, abort, peer_account
from mec_server.twin.metrics import ConsumerEnd, TwinMetrics
from mec_server.twin.rendering import ViewedTile, ViewService
from mec_server.twin.state import Covers, Entry, Mailbox, ReceivedPicture, Twin
from rfcore.errors import AccessDenied, InvalidInput, LimitExceeded, RfedgeError
from rfcore.perception.objects import ObjectReports, StreetObject
from rfcore.wire.conventions import MAY_SEE
from rfcore.wire.twin import (
    Departure,
    PictureEncoding,
    Subscription,
    TwinPicture,
    encoded_picture,
    subscription_from_wire,
    twin_message_to_wire,
)
from rfcore.wire.twin_render import (
    ObjectsSeen,
    RenderedView,
    objects_request_from_wire,
    objects_to_wire,
    rendered_view_to_wire,
    view_request_from_wire,
)
from rfcore.wire.v1 import twin_pb2 as pb
from rfcore.wire.v1 import twin_pb2_grpc

Encodings = dict[PictureEncoding, asyncio.Future[bytes]]


class PictureEncoder:
    """Encodes pictures; the encoded bytes are kept as long as the picture."""

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1, "twin")
        self._done: WeakKeyDictionary[ReceivedPicture, Encodings] = WeakKeyDictionary()

    async def bytes_of(self, picture: ReceivedPicture, encoding: PictureEncoding) -> bytes:
        """Return the encoded picture."""
        done = self._done.setdefault(picture, {})
        if encoding not in done:
            loop = asyncio.get_running_loop()
            done[encoding] = loop.run_in_executor(
                self._executor, encoded_picture, picture.picture, encoding
            )
        return await asyncio.shield(done[encoding])

    def close(self) -> None:
        """Stop the thread."""
        self._executor.shutdown(cancel_futures=True)


Context = grpc.aio.ServicerContext[pb.WatchRequest, pb.WatchResponse]
AnyContext = grpc.aio.ServicerContext[Any, Any]


@dataclass(frozen=True)
class ConsumerAccess:
    """The pictures and fields that one consumer may see.

    ``covers`` decides for a picture, ``may_draw`` for a field's id; ``check_vehicles`` raises
    ``AccessDenied`` for vehicles asked for by name that the consumer can never see.
    """

    covers: Covers
    check_vehicles: Callable[[frozenset[str]], None]
    may_draw: Callable[[str], bool]
    may_see: str = ""
    """Words for the part of the twin that the consumer may see; "" for everything."""


class ConsumerStream:
    """Writes to one consumer until it leaves, reads too slowly, or the server drains.

    ``end``: why the stream ends. ``unread``: a message that the consumer does not take.
    """

    def __init__(self, stalled_s: float, drained: asyncio.Task[bool]) -> None:
        self.end = ConsumerEnd.LEFT
        self.unread: asyncio.Task[None] | None = None
        self._stalled_s = stalled_s
        self._drained = drained

    @property
    def is_draining(self) -> bool:
        """Whether the server drains, which ends the stream."""
        if self._drained.done():
            self.end = ConsumerEnd.DRAINED
        return self._drained.done()

    async def write(self, work: Coroutine[None, None, None]) -> bool:
        """Do ``work``, which writes a message; return whether the stream goes on."""
        writing = asyncio.create_task(work)
        try:
            await asyncio.wait(
                {writing, self._drained},
                timeout=self._stalled_s,
                return_when=asyncio.FIRST_COMPLETED,
            )
        except asyncio.CancelledError:  # the consumer is gone
            await _cancelled(writing)
            raise
        if writing.done():
            writing.result()
        elif self.is_draining:
            await _cancelled(writing)
            return False
        else:
            self.unread, self.end = writing, ConsumerEnd.SLOW
        return writing.done() and not self.is_draining

    async def wait(self, arrived: asyncio.Event, within_s: float | None) -> bool:
        """Wait for ``arrived`` or the draining; return whether either came ``within_s``."""
        arriving = asyncio.create_task(arrived.wait())
        try:
            done, _ = await asyncio.wait(
                {arriving, self._drained}, timeout=within_s, return_when=asyncio.FIRST_COMPLETED
            )
        finally:
            arriving.cancel()
        arrived.clear()
        return bool(done)


async def _cancelled(task: asyncio.Task[None]) -> None:
    """Cancel a task and wait until it has ended, however it does."""
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


class ConsumerStreams:
    """Admits consumers, counts them, and ends their streams.

    ``slots`` limits their number; one that took nothing for ``stalled_s`` is disconnected.
    ``failed`` is called with an unexpected exception, which ends its stream.
    """

    def __init__(
        self,
        metrics: TwinMetrics,
        slots: Slots,
        stalled_s: float,
        failed: Callable[[Exception], None],
    ) -> None:
        self.draining = asyncio.Event()
        self.failed = failed
        self._metrics = metrics
        self._slots = slots
        self._stalled_s = stalled_s

    async def hold(self, context: AnyContext) -> Hold:
        """Return the slot of a call, to be released when it is over; abort a call too many."""
        try:
            return self._slots.hold(context)
        except LimitExceeded as error:
            self._metrics.ended.labels(ConsumerEnd.REFUSED).inc()
            await abort(context, error)

    @asynccontextmanager
    async def opened(self, context: AnyContext) -> AsyncIterator[ConsumerStream]:
        """Count a consumer while the block lasts; abort the call of one that was too slow."""
        drained = asyncio.create_task(self.draining.wait())
        stream = ConsumerStream(self._stalled_s, drained)
        self._metrics.consumers.inc()
        try:
            yield stream
        except grpc.aio.AbortError:
            raise
        except grpc.aio.InternalError:  # of a write to a consumer that is gone
            return
        except Exception as error:
            self.failed(error)
            raise
        finally:
            drained.cancel()
            self._metrics.consumers.dec()
            self._metrics.ended.labels(stream.end).inc()
            self._slots.log(context).info("consumer ended", reason=str(stream.end))
        if stream.unread is not None:
            with suppress(grpc.aio.InternalError):  # it is gone
                await stream.unread  # gRPC sends no status before what is being written
            await context.abort(
                grpc.StatusCode.RESOURCE_EXHAUSTED,
                f"nothing was taken for {self._stalled_s:g} s; read faster",
            )


class TwinService(twin_pb2_grpc.TwinServiceServicer):
    """Streams the pictures of ``twin`` to consumers, and views that ``views`` composes.

    For ``slots``, ``failed`` and ``limits.stalled_s`` see ``ConsumerStreams``. A consumer that
    moves a view and asked for none in ``limits.idle_s`` is disconnected. ``access`` returns what
    the peer of a call may see.
    """

    def __init__(
        self,
        twin: Twin,
        metrics: TwinMetrics,
        slots: Slots,
        limits: SessionLimits,
        failed: Callable[[Exception], None],
        access: Callable[[AnyContext], ConsumerAccess],
        views: ViewService,
    ) -> None:
        self._twin = twin
        self._access = access
        self._metrics = metrics
        self._views = views
        self.pictures = PictureEncoder()
        """Encodes each picture once for all its users."""
        self._streams = ConsumerStreams(metrics, slots, limits.stalled_s, failed)
        self._idle_s = limits.idle_s

    def register(self, server: grpc.aio.Server) -> None:
        """Add the service to a server that has not started."""
        twin_pb2_grpc.add_TwinServiceServicer_to_server(self, server)

    def drain(self) -> None:
        """End the stream of every consumer."""
        self._streams.draining.set()

    def close(self) -> None:
        """Stop encoding."""
        self.pictures.close()

    async def Render(  # noqa: N802
        self, request: pb.RenderRequest, context: AnyContext
    ) -> pb.RenderResponse:
        """Return the street as it is now from one viewpoint."""
        with await self._streams.hold(context):
            try:
                return rendered_view_to_wire(await self._view(request, context))
            except RfedgeError as error:
                await abort(context, error)
            except Exception as error:
                self._streams.failed(error)
                raise

    async def RenderStream(  # type: ignore[override]  # noqa: N802
        self, requests: AsyncIterator[pb.RenderStreamRequest], context: AnyContext
    ) -> None:
        """Return it from a viewpoint that moves, until the consumer has no more requests.

        It ends as well when the consumer asks for nothing for long or reads too slowly, and when
        the server drains.
        """
        identity, _ = peer_account(context)
        with await self._streams.hold(context):
            async with self._streams.opened(context) as stream:
                asked = _ViewRequests(requests, lambda: self._views.spend_message(identity))
                try:
                    await self._send_views(asked, stream, context)
                except RfedgeError as error:
                    await abort(context, error)
                finally:
                    asked.close()
            if stream.end is ConsumerEnd.IDLE:
                await context.abort(
                    grpc.StatusCode.DEADLINE_EXCEEDED,
                    f"no view was asked for within {self._idle_s:g} s; "
                    "open another stream when one is",
                )

    async def _view(self, request: pb.RenderRequest, context: AnyContext) -> RenderedView:
        access, (identity, _) = self._access(context), peer_account(context)
        asked = view_request_from_wire(request)
        return await self._views.view(asked, identity, access.covers, access.may_draw)

    async def _send_views(
        self, asked: _ViewRequests, stream: ConsumerStream, context: AnyContext
    ) -> None:
        while (request := await asked.next(stream, self._idle_s)) is not None:
            skipped = asked.skipped
            view = replace(await self._view(request, context), skipped=skipped)
            answer = pb.RenderStreamResponse(view=rendered_view_to_wire(view))
            if not await stream.write(context.write(answer)):
                return

    async def Watch(  # type: ignore[override]  # noqa: N802 (a coroutine that writes will do)
        self, request: pb.WatchRequest, context: Context
    ) -> None:
        """Send pictures until the consumer leaves, reads too slowly, or the server drains."""
        try:
            subscription = subscription_from_wire(request)
            access = self._access(context)
            access.check_vehicles(subscription.vehicle_ids)
        except (InvalidInput, AccessDenied) as error:
            await abort(context, error)
        writer = _PictureWriter(self._twin, self.pictures, self._metrics, context)
        with await self._streams.hold(context):
            async with self._streams.opened(context) as stream:
                await writer.serve(stream, subscription, access.covers, access.may_see)

    async def Objects(  # type: ignore[override]  # noqa: N802
        self, request: pb.ObjectsRequest, context: AnyContext
    ) -> None:
        """Send the objects of a tile with each picture, until the consumer leaves."""
        try:
            access = self._access(context)
            tile = self._views.tile(objects_request_from_wire(request), access.may_draw)
        except RfedgeError as error:
            await abort(context, error)

        def covers(vehicle_id: str, field_id: str) -> bool:
            return field_id in tile.field_ids and access.covers(vehicle_id, field_id)

        writer = _ObjectsWriter(self._twin, self._views, self._metrics, context, tile)
        with await self._streams.hold(context):
            async with self._streams.opened(context) as stream:
                await writer.serve(stream, Subscription(), covers)


class _MailboxWriter(ABC):
    """Writes the entries of one mailbox."""

    def __init__(self, twin: Twin, context: AnyContext) -> None:
        self._twin = twin
        self._context = context
        self._arrived = asyncio.Event()

    async def serve(
        self,
        stream: ConsumerStream,
        subscription: Subscription,
        covers: Covers,
        may_see: str = "",
    ) -> None:
        """Write entries until the stream is over; ``may_see``: as in ``ConsumerAccess``."""
        mailbox = self._twin.watch(subscription, self._arrived.set, covers)
        try:
            # From here on every missed picture is counted.
            stated = ((MAY_SEE, may_see),) if may_see else ()
            await self._context.send_initial_metadata(stated)
            while not stream.is_draining:
                work = self._next(mailbox)
                if work is None:
                    await stream.wait(self._arrived, self._rest_s())
                elif not await stream.write(work):
                    return
        finally:
            self._twin.unwatch(mailbox)

    def _next(self, mailbox: Mailbox) -> Coroutine[None, None, None] | None:
        """Return the writing of the next message, None if there is none."""
        entry = mailbox.take()
        return None if entry is None else self._write(mailbox, entry)

    def _rest_s(self) -> float | None:
        """Return how long to wait for an entry; None for no limit."""
        return None

    @abstractmethod
    async def _write(self, mailbox: Mailbox, entry: Entry) -> None:
        """Write the message for one entry."""


class _PictureWriter(_MailboxWriter):
    """Writes pictures."""

    def __init__(
        self, twin: Twin, pictures: PictureEncoder, metrics: TwinMetrics, context: Context
    ) -> None:
        super().__init__(twin, context)
        self._pictures = pictures
        self._metrics = metrics

    async def _write(self, mailbox: Mailbox, entry: Entry) -> None:
        if isinstance(entry, Departure):
            await self._context.write(twin_message_to_wire(entry))
            return
        encoding = mailbox.subscription.encoding
        data = await self._pictures.bytes_of(entry, encoding)
        age_s = entry.age_s(time.monotonic())
        skipped = mailbox.skipped[entry.key]
        message = twin_message_to_wire(picture_message(entry, age_s, encoding, data, skipped))
        await self._context.write(message)
        self._metrics.sent.labels(encoding).inc()
        self._metrics.bytes.inc(message.ByteSize())
        self._metrics.sent_age.observe(age_s)


class _ObjectsWriter(_MailboxWriter):
    """Writes the objects in the pictures that the field lacks, at their present positions."""

    def __init__(
        self,
        twin: Twin,
        views: ViewService,
        metrics: TwinMetrics,
        context: AnyContext,
        tile: ViewedTile,
    ) -> None:
        super().__init__(twin, context)
        self._views = views
        self._metrics = metrics
        self._tile = tile
        self._reports = ObjectReports()
        self._origin_m = (0.0, 0.0, 0.0)
        self._identity, _ = peer_account(context)

    def _next(self, mailbox: Mailbox) -> Coroutine[None, None, None] | None:
        """Return the writing of the next entry, or of a report that is due again."""
        if time.monotonic() >= self._reports.again_s:
            return self._report()
        return super()._next(mailbox)

    def _rest_s(self) -> float | None:
        again_s = self._reports.again_s
        return max(0.0, again_s - time.monotonic()) if math.isfinite(again_s) else None

    async def _write(self, mailbox: Mailbox, entry: Entry) -> None:
        if isinstance(entry, ReceivedPicture):
            try:
                found = await self._views.objects_in(entry, self._tile, self._identity)
            except LimitExceeded:  # out of worker time: the picture is missed
                mailbox.skipped[entry.key] += 1
                return
            self._origin_m, seen_s = found.origin_m, entry.captured_s
            taken = (found.detections, entry.key, seen_s, found.rules_out, found.labels)
            self._reports.tracker.take(*taken)
        await self._report()

    async def _report(self) -> None:
        objects = tuple(self._in_world(each) for each in self._reports.now(time.monotonic()))
        message = objects_to_wire(ObjectsSeen(time.time_ns(), self._tile.field_id, objects))
        await self._context.write(message)
        self._metrics.bytes.inc(message.ByteSize())

    def _in_world(self, each: StreetObject) -> StreetObject:
        x_m, y_m, z_m = (at + shift for at, shift in zip(each.at_m, self._origin_m, strict=True))
        return replace(each, at_m=(x_m, y_m, z_m))


def picture_message(
    picture: ReceivedPicture, age_s: float, encoding: PictureEncoding, data: bytes, skipped: int
) -> TwinPicture:
    """Return the message for a consumer: the picture as ``data``, in ``encoding``."""
    packet = picture.frame.packet
    return TwinPicture(
        vehicle_id=picture.vehicle_id,
        camera_id=picture.frame.camera_id,
        session_id=picture.session_id,
        epoch=packet.epoch,
        sequence=packet.sequence,
        capture_time_ns=picture.frame.capture_time_ns,
        age_ns=round(age_s * 1e9),
        pose=picture.frame.pose,
        intrinsics=picture.intrinsics,
        field_id=picture.field_id,
        reconstruction_digest=picture.digest,
        encoding=encoding,
        picture=data,
        skipped=skipped,
        payload_bytes=len(packet.payload),
        references=packet.references,
        clock=picture.frame.clock,
        localisation=picture.frame.localisation,
        instant=picture.frame.instant,
        decoding_ns=round(picture.decoding_s * 1e9),
    )


class _ViewRequests:
    """Reads the requests of one stream and keeps the newest.

    ``spend`` is called for each and may raise ``LimitExceeded``, which ends the reading.
    ``skipped``: requests without an answer.
    """

    def __init__(
        self, requests: AsyncIterator[pb.RenderStreamRequest], spend: Callable[[], None]
    ) -> None:
        self.skipped = 0
        self._error: RfedgeError | None = None
        self._newest: pb.RenderRequest | None = None
        self._spend = spend
        self._arrived = asyncio.Event()
        self._reading = asyncio.create_task(self._read(requests))
        self._reading.add_done_callback(lambda _: self._arrived.set())

    def close(self) -> None:
        """Read no more."""
        self._reading.cancel()

    async def next(self, stream: ConsumerStream, within_s: float) -> pb.RenderRequest | None:
        """Wait for a request and return the newest.

        Return None when there will be none, or none came ``within_s``; raise ``LimitExceeded``.
        """
        while self._newest is None and not self._reading.done() and not stream.is_draining:
            if not await stream.wait(self._arrived, within_s):
                stream.end = ConsumerEnd.IDLE
                return None
        if stream.is_draining:
            return None
        if self._error is not None:
            raise self._error
        request, self._newest = self._newest, None
        return request

    async def _read(self, requests: AsyncIterator[pb.RenderStreamRequest]) -> None:
        with suppress(grpc.aio.InternalError):  # of a consumer that is gone
            async for request in requests:
                try:
                    self._spend()
                except RfedgeError as error:
                    self._error = error
                    return
                self.skipped += self._newest is not None
                self._newest = request.view
                self._arrived.set()
