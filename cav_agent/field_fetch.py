"""Fetches a field from the server: resumable, digest checked before anything is parsed."""

from __future__ import annotations

import asyncio
import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import grpc
import structlog

from rfcore.errors import FieldFormatError, InvalidInput, RfedgeError, UnknownField
from rfcore.wire.checks import check_field_id
from rfcore.wire.tiles import MAX_TILES, Tile, tile_of
from rfcore.wire.v1 import field_pb2 as pb
from rfcore.wire.v1.field_pb2_grpc import FieldServiceStub

if TYPE_CHECKING:
    from rfcore.wire.v1.field_pb2_grpc import FieldServiceAsyncStub

__all__ = ["MAX_FIELD_BYTES", "WHOLE_STREET", "Store", "fetch_field", "published_tiles"]

log = structlog.get_logger()

MAX_FIELD_BYTES = 4 << 30
"""Longest archive the agent takes; more than any vehicle renders in time."""

WHOLE_STREET = "street"
"""What the only tile of a server without tiles is called."""

MAX_RESUMES = 5
RETRIED = (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.INTERNAL, grpc.StatusCode.CANCELLED)


class Store(Protocol):
    """A directory of field archives, as ``rfcore.field.FieldStore``."""

    def ids(self) -> tuple[str, ...]:
        """Return the ids of the fields there."""

    def add(self, source: bytes | Path, field_id: str | None = None) -> str:
        """Add an archive, checked against ``field_id`` before it is parsed."""


async def published_tiles(channel: grpc.aio.Channel) -> tuple[Tile, ...]:
    """Return the tiles a server publishes; of one that publishes none, its only field, everywhere.

    Raises ``UnknownField`` for several fields without tiles, ``InvalidInput`` for a wrong tile.
    """
    stub = FieldServiceStub(channel)
    try:
        listed = await stub.ListFields(pb.ListFieldsRequest(), wait_for_ready=True)
    except grpc.aio.AioRpcError as error:
        raise RfedgeError(f"the server does not list its fields: {error.details()}") from error
    if len(listed.tiles) > MAX_TILES:
        raise InvalidInput("tiles", f"the server lists {len(listed.tiles)}, above {MAX_TILES}")
    if listed.tiles:
        return tuple(map(tile_of, listed.tiles))
    if len(listed.field_ids) != 1:
        here = ", ".join(listed.field_ids) or "none"
        raise UnknownField(f"the server holds several fields or none ({here}); choose with --field")
    return (Tile(WHOLE_STREET, check_field_id("field", listed.field_ids[0])),)


async def fetch_field(channel: grpc.aio.Channel, store: Store, field_id: str, folder: Path) -> None:
    """Put field ``field_id`` of the server into ``store``; what arrived before is not sent again.

    The partial file lies in ``folder``. Raises ``UnknownField`` when the server lacks the field,
    ``FieldFormatError`` when what arrives is not the field, ``RfedgeError`` when it does not come.
    """
    stub = FieldServiceStub(channel)
    partial = folder / f".{field_id}.part"
    size_bytes = await _size(stub, field_id)
    log.info("fetching field", field=field_id, size_bytes=size_bytes)
    await _receive_all(stub, field_id, partial, size_bytes)
    await asyncio.to_thread(_check_and_add, store, field_id, partial)
    log.info("field fetched", field=field_id)


async def _size(stub: FieldServiceAsyncStub, field_id: str) -> int:
    request = pb.GetManifestRequest(field_id=field_id)
    try:
        manifest = await stub.GetManifest(request, wait_for_ready=True)
    except grpc.aio.AioRpcError as error:
        if error.code() is grpc.StatusCode.NOT_FOUND:
            raise UnknownField(f"{error.details()} (asked for {field_id})") from error
        raise RfedgeError(f"the server has no manifest of {field_id}: {error.details()}") from error
    if not 0 < manifest.size_bytes <= MAX_FIELD_BYTES:
        raise FieldFormatError(
            f"field {field_id} has {manifest.size_bytes} bytes, at most {MAX_FIELD_BYTES} are taken"
        )
    return int(manifest.size_bytes)


async def _receive_all(
    stub: FieldServiceAsyncStub, field_id: str, partial: Path, size_bytes: int
) -> None:
    for resume in range(MAX_RESUMES + 1):
        try:
            await _receive(stub, field_id, partial, size_bytes)
            return
        except grpc.aio.AioRpcError as error:
            if error.code() not in RETRIED or resume == MAX_RESUMES:
                problem = f"{error.code().name}: {error.details()}"
                raise RfedgeError(f"field {field_id} does not arrive ({problem})") from error
            log.warning("field transfer interrupted", problem=error.details())


async def _receive(
    stub: FieldServiceAsyncStub, field_id: str, partial: Path, size_bytes: int
) -> None:
    have_bytes = partial.stat().st_size if partial.exists() else 0
    if have_bytes >= size_bytes:
        return
    request = pb.FetchFieldRequest(field_id=field_id, offset_bytes=have_bytes)
    with partial.open("ab") as file:
        async for response in stub.FetchField(request, wait_for_ready=True):
            end_bytes = response.offset_bytes + len(response.chunk)
            if response.offset_bytes != have_bytes or end_bytes > size_bytes:
                raise FieldFormatError(
                    f"the server sent bytes {response.offset_bytes}..{end_bytes} of field "
                    f"{field_id} where {have_bytes}.. of {size_bytes} were expected"
                )
            await asyncio.to_thread(file.write, response.chunk)
            have_bytes = end_bytes
    if have_bytes != size_bytes:
        raise FieldFormatError(
            f"field {field_id} ended after {have_bytes} of {size_bytes} bytes; try again"
        )


def _check_and_add(store: Store, field_id: str, partial: Path) -> None:
    """Add the file to the store, or remove it: a wrong digest cannot be resumed from."""
    try:
        with partial.open("rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
        if found != field_id:
            raise FieldFormatError(
                f"what the server sent as field {field_id} has sha256 {found}; it was removed"
            )
        store.add(partial, field_id)
    finally:
        partial.unlink(missing_ok=True)
