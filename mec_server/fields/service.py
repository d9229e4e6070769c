"""FieldService over grpc.aio: lists the fields of this server and sends them, from any offset.

``FieldShelf`` keeps fields ready to render. A field file is opened when the first vehicle asks for
it and stays in memory, up to a limit.
"""

from __future__ import annotations

import asyncio
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from os import SEEK_END
from pathlib import Path
from typing import Any, Protocol, TypeVar

import grpc
import numpy as np
import structlog

from mec_server.ledger.budgets import Limit
from mec_server.ledger.ledger import HELD_RETRY_S
from mec_server.ledger.peer_log import PeerLog
from mec_server.peers import Slots, abort
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import AccessDenied, InvalidInput, LimitExceeded, RfedgeError, UnknownField
from rfcore.field import Bounds, RadianceField, render_field_view
from rfcore.field.interface import SPLATS
from rfcore.wire.tiles import LearntLight, Tile, learnt_message, tile_message
from rfcore.wire.v1 import field_pb2 as pb
from rfcore.wire.v1 import field_pb2_grpc
from rfcore.wire.values import check_field_id

log = structlog.get_logger()

CHUNK_BYTES = 64 * 1024
"""Size of what is read at once, the same as a connection's window: the memory that a peer which
does not read costs."""

MESSAGE_BYTES = 16 * 1024
"""Size of a message of a field: answers to frames wait behind one, 33 ms at 4 Mbit/s."""

MAX_OPEN_FIELDS = 8

TYPICAL_CAMERA = Intrinsics(640, 360, 400.0, 400.0, 320.0, 180.0)
"""The camera of the picture that is drawn in advance."""


class Store(Protocol):
    """Field archives, as ``mec_server.fields.index.FieldIndex``."""

    def ids(self) -> Sequence[str]:
        """Return the ids of the fields there."""

    def path(self, field_id: str) -> Path:
        """Return an archive's path; raise ``UnknownField``."""


class FieldShelf:
    """A cache of ``most`` opened fields of ``store``: ``load`` opens one, the least recently used
    leaves."""

    def __init__(
        self, store: Store, load: Callable[[str], RadianceField], most: int = MAX_OPEN_FIELDS
    ) -> None:
        self._store = store
        self._most = most
        self._load = load
        self._open: OrderedDict[str, RadianceField] = OrderedDict()
        self._lock = threading.Lock()

    def open(self, field_id: str) -> RadianceField:
        """Return a field, ready to render; raise ``UnknownField`` or ``FieldFormatError``."""
        with self._lock:
            if field_id not in self._open:
                self._open[field_id] = self._load(field_id)
                if len(self._open) > self._most:
                    self._open.popitem(last=False)
            self._open.move_to_end(field_id)
            return self._open[field_id]

    def opened(self, field_id: str) -> RadianceField | None:
        """Return a field if it is open, ``None`` otherwise; waits for one that is being opened."""
        with self._lock:
            return self._open.get(field_id)

    def draw_once(self) -> None:
        """Warm up: draw one picture of the largest open field of splats.

        The first picture of each thread, and the first pictures drawn at the same time, set up
        memory that later ones reuse (40 ms and 10 MB). A hash grid needs next to nothing.
        """
        with self._lock:
            fields = [field for field in self._open.values() if field.metadata.kind == SPLATS]
        if fields:
            field = max(fields, key=lambda field: field.primitives)
            with suppress(InvalidInput):  # too much to be drawn there: what a vehicle would be told
                render_field_view(field, _from_the_middle(field.bounds))

    def warm_up(self) -> int:
        """Open fields in advance, so that the first vehicle waits for none; return how many.

        Fields that are open already (the published ones) are taken to be all that is needed. One
        that cannot be opened is logged; if none can, raises what the first one raised.
        """
        ids = list(self._open or self._store.ids())[:MAX_OPEN_FIELDS]
        failed: list[RfedgeError] = []
        for field_id in ids:
            try:
                self.open(field_id)
            except RfedgeError as error:
                log.error("field cannot be opened", field=field_id, problem=str(error))
                failed.append(error)
        if failed and len(failed) == len(ids):
            raise failed[0]
        return len(ids) - len(failed)


def _from_the_middle(bounds: Bounds) -> Camera:
    """Return a camera in the middle of a field that looks along its longer side."""
    east_m, north_m, up_m = (np.add(bounds.low_m, bounds.high_m) / 2).tolist()
    long_m, wide_m, _ = np.subtract(bounds.high_m, bounds.low_m).tolist()
    along, aside = ((1.0, 0.0), (0.0, -1.0)) if long_m > wide_m else ((0.0, 1.0), (1.0, 0.0))
    pose = Pose.from_matrix(
        [
            [aside[0], 0.0, along[0], east_m],
            [aside[1], 0.0, along[1], north_m],
            [0.0, -1.0, 0.0, up_m],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    return Camera(TYPICAL_CAMERA, pose)


def read_chunk(path: Path, offset_bytes: int) -> bytes:
    """Return up to ``CHUNK_BYTES`` of a file from ``offset_bytes`` on; nothing at its end.

    Each chunk opens the file and closes it: a transfer that is cut, or that nobody reads, holds
    none open. Raises ``InvalidInput`` for an offset past the end, and ``OSError``.
    """
    with path.open("rb", buffering=0) as file:
        size_bytes = file.seek(0, SEEK_END)
        if offset_bytes > size_bytes:
            raise InvalidInput(
                "offset_bytes", f"{offset_bytes} is past the end of a field of {size_bytes} bytes"
            )
        file.seek(offset_bytes)
        return file.read(CHUNK_BYTES)


R = TypeVar("R")
AnyContext = grpc.aio.ServicerContext[Any, Any]


class FieldService(field_pb2_grpc.FieldServiceServicer):
    """Sends the archives of ``store``, and lists the ``tiles`` that are current.

    ``slots`` says how many fetches there may be; one that takes nothing for ``stalled_s`` ends.
    ``may_fetch`` says whether the peer of a call may have a field, given the names of its tiles.
    """

    def __init__(
        self,
        store: Store,
        tiles: Callable[[], tuple[Tile, ...]],
        slots: Slots,
        stalled_s: float,
        may_fetch: Callable[[AnyContext, frozenset[str]], bool],
    ) -> None:
        self._store = store
        self._tiles = tiles
        self._slots = slots
        self._stalled_s = stalled_s
        self._may_fetch = may_fetch
        self._learnt: tuple[LearntLight, ...] = ()

    def show_learnt(self, learnt: Iterable[LearntLight]) -> None:
        """List this from now on as what the server learnt."""
        self._learnt = tuple(learnt)

    def register(self, server: grpc.aio.Server) -> None:
        """Add the service to a server that has not started."""
        field_pb2_grpc.add_FieldServiceServicer_to_server(self, server)

    async def ListFields(  # noqa: N802
        self,
        request: pb.ListFieldsRequest,  # noqa: ARG002
        context: grpc.aio.ServicerContext[pb.ListFieldsRequest, pb.ListFieldsResponse],
    ) -> pb.ListFieldsResponse:
        """List the ids of the fields here, and the tiles, as far as the peer may have them."""
        held = await asyncio.to_thread(self._store.ids)
        tiles = [
            tile
            for tile in self._tiles()
            if self._may_fetch(context, self._tiles_of(tile.field_id))
        ]
        names = {tile.name for tile in tiles}
        return pb.ListFieldsResponse(
            field_ids=[name for name in held if self._may_fetch(context, self._tiles_of(name))],
            tiles=[tile_message(tile) for tile in tiles],
            learnt=[learnt_message(one) for one in self._learnt if one.tile in names],
        )

    def _tiles_of(self, field_id: str) -> frozenset[str]:
        return frozenset(tile.name for tile in self._tiles() if field_id in tile.archive_ids)

    def _path(self, field_id: str, context: AnyContext) -> Path:
        """Return where a field is; raise ``UnknownField`` or ``AccessDenied``."""
        path = self._store.path(check_field_id("field_id", field_id))
        if not self._may_fetch(context, self._tiles_of(field_id)):
            raise AccessDenied(f"this certificate may not have field {field_id}; ask the operator")
        return path

    async def GetManifest(  # noqa: N802
        self,
        request: pb.GetManifestRequest,
        context: grpc.aio.ServicerContext[pb.GetManifestRequest, pb.GetManifestResponse],
    ) -> pb.GetManifestResponse:
        """Return size and digest of an archive."""
        try:
            path = self._path(request.field_id, context)
            lines = self._slots.log(context)
            status = await _readable(request.field_id, lines, path.stat)
        except RfedgeError as error:
            await abort(context, error)
        return pb.GetManifestResponse(
            field_id=request.field_id,
            size_bytes=status.st_size,
            sha256=bytes.fromhex(request.field_id),
        )

    async def FetchField(  # type: ignore[override]  # noqa: N802 (a coroutine that writes will do)
        self,
        request: pb.FetchFieldRequest,
        context: grpc.aio.ServicerContext[pb.FetchFieldRequest, pb.FetchFieldResponse],
    ) -> None:
        """Send an archive from an offset on, to a peer that reads it.

        A transfer that nobody reads ends, but its slot is given back only when its last chunk was
        read or the peer is gone: until then the chunk takes memory.
        """
        try:
            with self._slots.hold(context):
                try:
                    await self._send(request, context)
                except RfedgeError as error:
                    await abort(context, error)
        except LimitExceeded as error:
            await abort(context, error)

    async def _send(
        self,
        request: pb.FetchFieldRequest,
        context: grpc.aio.ServicerContext[pb.FetchFieldRequest, pb.FetchFieldResponse],
    ) -> None:
        path, offset_bytes = self._path(request.field_id, context), request.offset_bytes
        lines = self._slots.log(context)
        while read := await _readable(request.field_id, lines, read_chunk, path, offset_bytes):
            for start in range(0, len(read), MESSAGE_BYTES):
                chunk = read[start : start + MESSAGE_BYTES]
                response = pb.FetchFieldResponse(offset_bytes=offset_bytes, chunk=chunk)
                offset_bytes += len(chunk)
                await self._write(context, response, offset_bytes)

    async def _write(
        self,
        context: grpc.aio.ServicerContext[pb.FetchFieldRequest, pb.FetchFieldResponse],
        response: pb.FetchFieldResponse,
        next_bytes: int,
    ) -> None:
        writing = asyncio.ensure_future(context.write(response))
        try:
            await asyncio.wait({writing}, timeout=self._stalled_s)
            if not writing.done():
                error = _unread(len(response.chunk), next_bytes, self._stalled_s)
                self._slots.count(error)
                await writing  # gRPC sends no status before what is being written
                raise error
            writing.result()
        finally:
            writing.cancel()


async def _readable(field_id: str, lines: PeerLog, read: Callable[..., R], *arguments: object) -> R:
    """Call ``read`` on a thread and return its result; raise ``UnknownField`` where the disk
    refuses.

    The peer's message names the field and no path of this machine; the path goes to ``lines``.
    """
    try:
        return await asyncio.to_thread(read, *arguments)
    except OSError as error:
        lines.error("field not readable", field=field_id, problem=str(error))
        raise UnknownField(f"field {field_id} cannot be read here; list the fields again") from None


def _unread(chunk_bytes: int, next_bytes: int, stalled_s: float) -> LimitExceeded:
    return LimitExceeded(
        Limit.UNREAD_ANSWERS,
        f"{chunk_bytes} bytes of the field were not taken within {stalled_s:g} s; "
        f"fetch it from offset {next_bytes} on",
        HELD_RETRY_S,
    )
