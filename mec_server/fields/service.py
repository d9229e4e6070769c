"""FieldService over grpc.aio: lists the fields of this server and sends them, from any offset."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import grpc

from mec_server.fields.shelf import Store, read_chunk
from mec_server.ledger.budgets import Limit
from mec_server.ledger.ledger import HELD_RETRY_S
from mec_server.ledger.peer_log import PeerLog
from mec_server.peers import Slots, abort
from rfcore.errors import AccessDenied, LimitExceeded, RfedgeError, UnknownField
from rfcore.wire.checks import check_field_id
from rfcore.wire.tiles import LearntLight, Tile, learnt_message, tile_message
from rfcore.wire.v1 import field_pb2 as pb
from rfcore.wire.v1 import field_pb2_grpc

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
        while chunk := await _readable(request.field_id, lines, read_chunk, path, offset_bytes):
            response = pb.FetchFieldResponse(offset_bytes=offset_bytes, chunk=chunk)
            offset_bytes += len(chunk)
            writing = asyncio.ensure_future(context.write(response))
            try:
                await asyncio.wait({writing}, timeout=self._stalled_s)
                if not writing.done():
                    error = _unread(len(chunk), offset_bytes, self._stalled_s)
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
