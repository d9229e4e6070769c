"""FieldService over grpc.aio: lists the fields of this server and sends them, from any offset."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import NoReturn

import grpc

from mec_server.fields.shelf import Store, read_chunks
from rfcore.errors import RfedgeError
from rfcore.wire.checks import check_field_id
from rfcore.wire.status import status_of
from rfcore.wire.tiles import Tile, tile_message
from rfcore.wire.v1 import field_pb2 as pb
from rfcore.wire.v1 import field_pb2_grpc

__all__ = ["FieldService"]


class FieldService(field_pb2_grpc.FieldServiceServicer):
    """Sends the archives of ``store``, and lists the ``tiles`` that are current."""

    def __init__(self, store: Store, tiles: Callable[[], tuple[Tile, ...]]) -> None:
        self._store = store
        self._tiles = tiles

    def register(self, server: grpc.aio.Server) -> None:
        """Add the service to a server that has not started."""
        field_pb2_grpc.add_FieldServiceServicer_to_server(self, server)

    async def ListFields(  # noqa: N802
        self,
        request: pb.ListFieldsRequest,  # noqa: ARG002
        context: grpc.aio.ServicerContext[pb.ListFieldsRequest, pb.ListFieldsResponse],  # noqa: ARG002
    ) -> pb.ListFieldsResponse:
        """List the ids of the fields here, and the tiles."""
        return pb.ListFieldsResponse(
            field_ids=await asyncio.to_thread(self._store.ids),
            tiles=map(tile_message, self._tiles()),
        )

    async def GetManifest(  # noqa: N802
        self,
        request: pb.GetManifestRequest,
        context: grpc.aio.ServicerContext[pb.GetManifestRequest, pb.GetManifestResponse],
    ) -> pb.GetManifestResponse:
        """Return size and digest of an archive."""
        try:
            path = self._store.path(check_field_id("field_id", request.field_id))
        except RfedgeError as error:
            await _refuse(context, error)
        return pb.GetManifestResponse(
            field_id=request.field_id,
            size_bytes=path.stat().st_size,
            sha256=bytes.fromhex(request.field_id),
        )

    async def FetchField(  # noqa: N802
        self,
        request: pb.FetchFieldRequest,
        context: grpc.aio.ServicerContext[pb.FetchFieldRequest, pb.FetchFieldResponse],
    ) -> AsyncIterator[pb.FetchFieldResponse]:
        """Send an archive from an offset on."""
        try:
            path = self._store.path(check_field_id("field_id", request.field_id))
            chunks = read_chunks(path, request.offset_bytes)
            while (chunk := await asyncio.to_thread(next, chunks, None)) is not None:
                yield pb.FetchFieldResponse(offset_bytes=chunk[0], chunk=chunk[1])
        except RfedgeError as error:
            await _refuse(context, error)


async def _refuse(
    context: grpc.aio.ServicerContext[pb.GetManifestRequest, pb.GetManifestResponse]
    | grpc.aio.ServicerContext[pb.FetchFieldRequest, pb.FetchFieldResponse],
    error: RfedgeError,
) -> NoReturn:
    await context.abort(status_of(error), str(error))
    raise AssertionError("abort raises")
