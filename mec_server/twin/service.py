"""TwinService over grpc.aio: one coroutine per consumer, between its mailbox and its stream.

Pictures are encoded on one thread of their own, each once for however many consumers, so that
consumers take no time from the workers that decode.
"""

from __future__ import annotations

import asyncio
import math
import time
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

import grpc

from mec_server.config import SessionLimits
from mec_server.peers import Slots, abort, peer_account
from mec_server.twin.metrics import ConsumerEnd, TwinMetrics
from mec_server.twin.rendering import ViewedTile, ViewService
from mec_server.twin.state import Covers, Mailbox, ReceivedPicture, Twin
from rfcore.errors import AccessDenied, InvalidInput, LimitExceeded, RfedgeError
from rfcore.image import I420, jpeg_bytes, png_bytes
from rfcore.native.yuv import rgb_from_i420
from rfcore.perception.objects import ObjectReports, StreetObject
from rfcore.wire.twin import (
    Departure,
    PictureEncoding,
    Subscription,
    TwinPicture,
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

__all__ = [
    "ConsumerAccess",
    "PictureEncoder",
    "RenderCalls",
    "TwinService",
    "encoded",
    "picture_message",
]


class PictureEncoder:
    """Encodes views; an encoded picture is kept as long as its view."""

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1, "twin")
        self._done: WeakKeyDictionary[
            ReceivedPicture, dict[PictureEncoding, asyncio.Future[bytes]]
        ] = WeakKeyDictionary()

    async def bytes_of(self, view: ReceivedPicture, encoding: PictureEncoding) -> bytes:
        """Return the picture of ``view``."""
        done = self._done.setdefault(view, {})
        if encoding not in done:
            loop = asyncio.get_running_loop()
            done[encoding] = loop.run_in_executor(self._executor, encoded, view.picture, encoding)
        return await asyncio.shield(done[encoding])

    def close(self) -> None:
        """Stop the thread."""
        self._executor.shutdown(cancel_futures=True)


def encoded(picture: I420, encoding: PictureEncoding) -> bytes:
    """Return ``picture`` as bytes: see ``PictureEncoding`` in twin.proto."""
    match encoding:
        case PictureEncoding.NONE:
            return b""
        case PictureEncoding.I420:
            return picture.packed()
        case PictureEncoding.JPEG:
            return jpeg_bytes(rgb_from_i420(picture))
        case PictureEncoding.PNG:
            return png_bytes(rgb_from_i420(picture))


Context = grpc.aio.ServicerContext[pb.WatchRequest, pb.WatchResponse]
AnyContext = grpc.aio.ServicerContext[Any, Any]


@dataclass(frozen=True)
class ConsumerAccess:
    """What one consumer may see: ``covers`` says it of a picture, ``may_draw`` of a field's id, and
    ``check_vehicles`` raises ``AccessDenied`` for vehicles asked for by name that it can never
    see."""

    covers: Covers
    check_vehicles: Callable[[frozenset[str]], None]
    may_draw: Callable[[str], bool]


class TwinService(twin_pb2_grpc.TwinServiceServicer):
    """Streams the pictures of ``twin`` to consumers.

    ``slots`` says how many may watch; one that took nothing for ``limits.stalled_s`` is too slow,
    and one that asks for views and asked for none in ``limits.idle_s`` is let go. ``failed`` is
    called with an unexpected exception, which ends the stream that met it. ``sight``
    says what the peer of a call may see, ``views`` composes views for it.
    """

    def __init__(
        self,
        twin: Twin,
        metrics: TwinMetrics,
        slots: Slots,
        limits: SessionLimits,
        failed: Callable[[Exception], None],
        sight: Callable[[Context], ConsumerAccess],
        views: ViewService,
    ) -> None:
        self._twin = twin
        self._sight = sight
        self._metrics = metrics
        self._slots = slots
        self._stalled_s = limits.stalled_s
        self._failed = failed
        self._pictures = PictureEncoder()
        self._draining = asyncio.Event()
        self._views = views
        self._renders = RenderCalls(views, metrics, slots, limits, failed, sight, self._draining)

    def register(self, server: grpc.aio.Server) -> None:
        """Add the service to a server that has not started."""
        twin_pb2_grpc.add_TwinServiceServicer_to_server(self, server)

    @property
    def pictures(self) -> PictureEncoder:
        """What encodes pictures, each once for whoever wants it."""
        return self._pictures

    def drain(self) -> None:
        """End the stream of every consumer."""
        self._draining.set()

    def close(self) -> None:
        """Stop encoding; ``views`` are their owner's."""
        self._pictures.close()

    async def Render(  # noqa: N802
        self, request: pb.RenderRequest, context: Context
    ) -> pb.RenderResponse:
        """Return the street as it is now from one viewpoint."""
        return await self._renders.render(request, context)

    async def RenderStream(  # type: ignore[override]  # noqa: N802
        self, requests: AsyncIterator[pb.RenderStreamRequest], context: Context
    ) -> None:
        """Return it from a viewpoint that moves, until the consumer has no more requests."""
        await self._renders.render_stream(requests, context)

    async def Watch(  # type: ignore[override]  # noqa: N802 (a coroutine that writes will do)
        self, request: pb.WatchRequest, context: Context
    ) -> None:
        """Send pictures until the consumer leaves, reads too slowly, or the server drains."""
        try:
            subscription = subscription_from_wire(request)
            sight = self._sight(context)
            sight.check_vehicles(subscription.vehicle_ids)
        except (InvalidInput, AccessDenied) as error:
            await abort(context, error)
        try:
            held = self._slots.hold(context)
        except LimitExceeded as error:
            self._metrics.ended.labels(ConsumerEnd.REFUSED).inc()
            await abort(context, error)
        consumer = _PictureWriter(self._twin, self._pictures, self._metrics, context)
        with held:
            await self._watch(subscription, sight.covers, context, consumer)

    async def Objects(  # type: ignore[override]  # noqa: N802
        self, request: pb.ObjectsRequest, context: AnyContext
    ) -> None:
        """Send the objects of a place with each picture, until the consumer leaves."""
        try:
            sight = self._sight(context)
            place = self._views.place(objects_request_from_wire(request), sight.may_draw)
            held = self._slots.hold(context)
        except RfedgeError as error:
            await abort(context, error)

        def covers(vehicle_id: str, field_id: str) -> bool:
            return field_id in place.field_ids and sight.covers(vehicle_id, field_id)

        consumer = _ObjectsWriter(self._twin, self._views, self._metrics, context, place)
        with held:
            await self._watch(Subscription(), covers, context, consumer)

    async def _watch(
        self,
        subscription: Subscription,
        covers: Covers,
        context: AnyContext,
        consumer: _MailboxWriter,
    ) -> None:
        self._metrics.consumers.inc()
        end = ConsumerEnd.LEFT
        try:
            end = await consumer.serve(subscription, covers, self._stalled_s, self._draining)
        except Exception as error:
            self._failed(error)
            raise
        finally:
            self._metrics.consumers.dec()
            self._metrics.ended.labels(end).inc()
            self._slots.log(context).info("consumer ended", reason=str(end))
        if consumer.unread is not None:
            await consumer.unread  # gRPC sends no status before what is being written
            await context.abort(
                grpc.StatusCode.RESOURCE_EXHAUSTED,
                f"nothing was taken for {self._stalled_s:g} s; read faster",
            )


class _MailboxWriter(ABC):
    """Writes what arrives in one mailbox. ``unread``: what a slow consumer has not taken."""

    def __init__(self, twin: Twin, context: AnyContext) -> None:
        self._twin = twin
        self._context = context
        self._arrived = asyncio.Event()
        self.unread: asyncio.Task[None] | None = None

    async def serve(
        self,
        subscription: Subscription,
        covers: Covers,
        stalled_s: float,
        draining: asyncio.Event,
    ) -> ConsumerEnd:
        """Write what arrives, to the end; return how it ended."""
        mailbox = self._twin.watch(subscription, self._arrived.set, covers)
        drained = asyncio.create_task(draining.wait())
        try:
            await self._context.send_initial_metadata(
                ()
            )  # from here on every missed picture is counted
            while not draining.is_set():
                work = self._next(mailbox)
                if work is None:
                    await self._rest(drained)
                    continue
                writing = asyncio.create_task(work)
                await asyncio.wait(
                    {writing, drained},
                    timeout=stalled_s,
                    return_when=asyncio.FIRST_COMPLETED,
                )
                if not writing.done() and draining.is_set():
                    writing.cancel()
                    return ConsumerEnd.DRAINED
                if not writing.done():
                    self.unread = writing
                    return ConsumerEnd.SLOW
                writing.result()
            return ConsumerEnd.DRAINED
        finally:
            drained.cancel()
            self._twin.unwatch(mailbox)

    def _next(self, mailbox: Mailbox) -> Coroutine[None, None, None] | None:
        """Return what is to be written now, None for nothing."""
        entry = mailbox.take()
        return None if entry is None else self._write(mailbox, entry)

    def _rest_s(self) -> float | None:
        """How long to wait for an entry; None: until there is one."""
        return None

    async def _rest(self, drained: asyncio.Task[bool]) -> None:
        arrived = asyncio.create_task(self._arrived.wait())
        await asyncio.wait(
            {arrived, drained}, timeout=self._rest_s(), return_when=asyncio.FIRST_COMPLETED
        )
        arrived.cancel()
        self._arrived.clear()

    @abstractmethod
    async def _write(self, mailbox: Mailbox, entry: ReceivedPicture | Departure) -> None:
        """Write what the consumer is to have of one entry."""


class _PictureWriter(_MailboxWriter):
    """Writes the pictures themselves."""

    def __init__(
        self, twin: Twin, pictures: PictureEncoder, metrics: TwinMetrics, context: Context
    ) -> None:
        super().__init__(twin, context)
        self._pictures = pictures
        self._metrics = metrics

    async def _write(self, mailbox: Mailbox, entry: ReceivedPicture | Departure) -> None:
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
    """Writes what the pictures show that the field does not have, as of now."""

    def __init__(
        self,
        twin: Twin,
        views: ViewService,
        metrics: TwinMetrics,
        context: AnyContext,
        place: ViewedTile,
    ) -> None:
        super().__init__(twin, context)
        self._views = views
        self._metrics = metrics
        self._place = place
        self._told = ObjectReports()
        self._origin_m = (0.0, 0.0, 0.0)
        self._identity, _ = peer_account(context)

    def _next(self, mailbox: Mailbox) -> Coroutine[None, None, None] | None:
        """Return the next entry's work, or that of telling again what is due."""
        if time.monotonic() >= self._told.again_s:
            return self._tell()
        return super()._next(mailbox)

    def _rest_s(self) -> float | None:
        again_s = self._told.again_s
        return max(0.0, again_s - time.monotonic()) if math.isfinite(again_s) else None

    async def _write(self, mailbox: Mailbox, entry: ReceivedPicture | Departure) -> None:
        if isinstance(entry, ReceivedPicture):
            try:
                found = await self._views.objects_in(entry, self._place, self._identity)
            except LimitExceeded:  # out of worker time: it is missed, as by a slow consumer
                mailbox.skipped[entry.key] += 1
                return
            self._origin_m, seen_s = found.origin_m, entry.captured_s
            taken = (found.detections, entry.key, seen_s, found.rules_out, found.labels)
            self._told.tracker.take(*taken)
        await self._tell()

    async def _tell(self) -> None:
        objects = tuple(self._from_place(each) for each in self._told.now(time.monotonic()))
        message = objects_to_wire(ObjectsSeen(time.time_ns(), self._place.field_id, objects))
        await self._context.write(message)
        self._metrics.bytes.inc(message.ByteSize())

    def _from_place(self, each: StreetObject) -> StreetObject:
        x_m, y_m, z_m = (at + shift for at, shift in zip(each.at_m, self._origin_m, strict=True))
        return replace(each, at_m=(x_m, y_m, z_m))


def picture_message(
    view: ReceivedPicture, age_s: float, encoding: PictureEncoding, data: bytes, skipped: int
) -> TwinPicture:
    """Return what a consumer is sent of ``view``: its picture as ``data``, in ``encoding``."""
    packet = view.frame.packet
    return TwinPicture(
        vehicle_id=view.vehicle_id,
        camera_id=view.frame.camera_id,
        session_id=view.session_id,
        epoch=packet.epoch,
        sequence=packet.sequence,
        capture_time_ns=view.frame.capture_time_ns,
        age_ns=round(age_s * 1e9),
        pose=view.frame.pose,
        intrinsics=view.intrinsics,
        field_id=view.field_id,
        reconstruction_digest=view.digest,
        encoding=encoding,
        picture=data,
        skipped=skipped,
        payload_bytes=len(packet.payload),
        references=packet.references,
        clock=view.frame.clock,
        localisation=view.frame.localisation,
        instant=view.frame.instant,
    )


class RenderCalls:
    """Answers calls with views. The arguments are those of ``TwinService``; every call, and every
    stream for as long as it lasts, holds one of ``slots``."""

    def __init__(
        self,
        views: ViewService,
        metrics: TwinMetrics,
        slots: Slots,
        limits: SessionLimits,
        failed: Callable[[Exception], None],
        sight: Callable[[AnyContext], ConsumerAccess],
        draining: asyncio.Event,
    ) -> None:
        self._views = views
        self._metrics = metrics
        self._slots = slots
        self._stalled_s, self._idle_s = limits.stalled_s, limits.idle_s
        self._failed = failed
        self._sight = sight
        self._draining = draining

    async def render(self, request: pb.RenderRequest, context: AnyContext) -> pb.RenderResponse:
        """Return one view, or end the call with the status of what is wrong."""
        with await self._hold(context):
            return rendered_view_to_wire(await self._view(request, context))

    async def render_stream(
        self, requests: AsyncIterator[pb.RenderStreamRequest], context: AnyContext
    ) -> None:
        """Answer requests until the peer has no more, asks for nothing for long, reads too slowly,
        or the server drains."""
        with await self._hold(context):
            self._metrics.consumers.inc()
            end = ConsumerEnd.LEFT
            identity, _ = peer_account(context)
            moving = _ViewRequests(requests, lambda: self._views.spend_message(identity))
            drained = asyncio.create_task(self._draining.wait())
            try:
                end = await self._follow(moving, drained, context)
            finally:
                drained.cancel()
                moving.close()
                self._metrics.consumers.dec()
                self._metrics.ended.labels(end).inc()
                self._slots.log(context).info("consumer ended", reason=str(end))
        if moving.unread is not None:
            await moving.unread  # gRPC sends no status before what is being written
            await context.abort(
                grpc.StatusCode.RESOURCE_EXHAUSTED,
                f"nothing was taken for {self._stalled_s:g} s; read faster",
            )
        if end is ConsumerEnd.IDLE:
            await context.abort(
                grpc.StatusCode.DEADLINE_EXCEEDED,
                f"no view was asked for within {self._idle_s:g} s; open another stream when one is",
            )

    async def _hold(self, context: AnyContext) -> Any:
        try:
            return self._slots.hold(context)
        except RfedgeError as error:
            self._metrics.ended.labels(ConsumerEnd.REFUSED).inc()
            await abort(context, error)

    async def _view(self, request: pb.RenderRequest, context: AnyContext) -> RenderedView:
        try:
            sight = self._sight(context)
            asked = view_request_from_wire(request)
            identity, _ = peer_account(context)
            return await self._views.view(asked, identity, sight.covers, sight.may_draw)
        except RfedgeError as error:
            await abort(context, error)
        except Exception as error:
            self._failed(error)
            raise

    async def _follow(
        self, moving: _ViewRequests, drained: asyncio.Task[bool], context: AnyContext
    ) -> ConsumerEnd:
        while (request := await moving.next(drained, self._idle_s)) is not None:
            skipped = moving.skipped
            view = replace(await self._view(request, context), skipped=skipped)
            answer = pb.RenderStreamResponse(view=rendered_view_to_wire(view))
            writing = asyncio.create_task(context.write(answer))
            await asyncio.wait(
                {writing, drained}, timeout=self._stalled_s, return_when=asyncio.FIRST_COMPLETED
            )
            if not writing.done() and drained.done():
                writing.cancel()
                return ConsumerEnd.DRAINED
            if not writing.done():
                moving.unread = writing
                return ConsumerEnd.SLOW
            writing.result()
        if moving.error is not None:
            await abort(context, moving.error)
        if moving.is_idle:
            return ConsumerEnd.IDLE
        return ConsumerEnd.DRAINED if drained.done() else ConsumerEnd.LEFT


class _ViewRequests:
    """Reads the requests of one stream, of which it keeps the newest.

    ``spend`` is called for each and may raise ``LimitExceeded``, which ends the reading. ``error``:
    what ended it, None for the peer. ``is_idle``: no request came for too long. ``skipped``:
    requests that got no answer. ``unread``: an answer that the peer does not take.
    """

    def __init__(
        self, requests: AsyncIterator[pb.RenderStreamRequest], spend: Callable[[], None]
    ) -> None:
        self.skipped = 0
        self.is_idle = False
        self.error: RfedgeError | None = None
        self.unread: asyncio.Task[None] | None = None
        self._newest: pb.RenderRequest | None = None
        self._spend = spend
        self._arrived = asyncio.Event()
        self._reading = asyncio.create_task(self._read(requests))
        self._reading.add_done_callback(lambda _: self._arrived.set())

    def close(self) -> None:
        """Read no more."""
        self._reading.cancel()

    async def next(self, drained: asyncio.Task[bool], within_s: float) -> pb.RenderRequest | None:
        """Return the newest request once there is one, None when there will be none, or none came
        ``within_s``."""
        while self._newest is None and not self._reading.done() and not drained.done():
            arrived = asyncio.create_task(self._arrived.wait())
            done, _ = await asyncio.wait(
                {arrived, drained}, timeout=within_s, return_when=asyncio.FIRST_COMPLETED
            )
            arrived.cancel()
            self._arrived.clear()
            if not done:
                self.is_idle = True
                break
        if drained.done() or self.is_idle or self.error is not None:
            return None
        request, self._newest = self._newest, None
        return request

    async def _read(self, requests: AsyncIterator[pb.RenderStreamRequest]) -> None:
        async for request in requests:
            try:
                self._spend()
            except RfedgeError as error:
                self.error = error
                return
            self.skipped += self._newest is not None
            self._newest = request.view
            self._arrived.set()
