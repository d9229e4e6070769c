"""Fetches a field's archive from a server; a transfer that broke is resumed.

What has arrived lies in a partial file, and is not sent again. The digest of the whole is checked
before the archive is parsed. An archive that begins with its lowest level of detail
(``rfcore.field.splat_archive``) is of use before it is whole: a beginning of it is parsed, each
array checked against its own digest. The server draws the same from the whole; a beginning of
another field shows at the latest when the server compares a render.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import grpc
import structlog

from cav_agent.server_connection import retry_after_s
from rfcore.errors import FieldFormatError, RfedgeError, UnknownField
from rfcore.field import FieldStore
from rfcore.field.archive import PREFIX_BYTES, array_ends, header_end
from rfcore.field.splat_archive import detail_ends
from rfcore.wire.v1 import field_pb2 as pb
from rfcore.wire.v1.field_pb2_grpc import FieldServiceStub

if TYPE_CHECKING:
    from rfcore.wire.v1.field_pb2_grpc import FieldServiceAsyncStub

log = structlog.get_logger()

Metadata = tuple[tuple[str, str], ...]

MAX_FIELD_BYTES = 4 << 30
"""Longest archive that the agent takes; more than any vehicle renders in time."""

MAX_RESUMES = 5
MAX_REFUSALS = 60
"""Tries of a transfer that broke, and of one that the server is too busy for: about a minute."""

RETRIED = (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.INTERNAL, grpc.StatusCode.CANCELLED)


class Beginnings:
    """Calls ``take`` with the first bytes of an archive, each time that they draw more than before.

    It is not called for the whole archive, nor for one that can only be drawn as a whole. What
    ``take`` raises ends the transfer.
    """

    def __init__(self, take: Callable[[bytes], Awaitable[None]]) -> None:
        self._take = take
        self._ends: list[int] | None = None

    async def arrived(self, partial: Path, have_bytes: int) -> None:
        """Examine a partial file of ``have_bytes``; raise ``FieldFormatError`` if it is damaged."""
        if self._ends is None:
            self._ends = await asyncio.to_thread(_ends_of, partial, have_bytes)
        ends = self._ends or []
        there = [end for end in ends if end <= have_bytes]
        if there:
            self._ends = ends[len(there) :]
            await self._take(await asyncio.to_thread(_first_bytes, partial, there[-1]))


def _ends_of(partial: Path, have_bytes: int) -> list[int] | None:
    """Return where the levels below the whole end, ascending; None as long as no header says so."""
    if have_bytes < PREFIX_BYTES:
        return None
    head_bytes = header_end(_first_bytes(partial, PREFIX_BYTES))
    if have_bytes < head_bytes:
        return None
    ends = detail_ends(array_ends(_first_bytes(partial, head_bytes)))
    return sorted(end for detail, end in ends.items() if detail < 1)


def _first_bytes(partial: Path, count: int) -> bytes:
    with partial.open("rb") as file:
        return file.read(count)


async def fetch_field(
    channel: grpc.aio.Channel,
    store: FieldStore,
    field_id: str,
    folder: Path,
    metadata: Metadata = (),
    beginnings: Beginnings | None = None,
) -> None:
    """Put field ``field_id`` of the server into ``store``; what arrived before is not sent again.

    The partial file lies in ``folder``; ``metadata`` goes with each call. Raises ``UnknownField``
    when the server lacks the field, ``FieldFormatError`` when what arrives is not the field,
    ``RfedgeError`` when it does not come, and what ``beginnings`` do.
    """
    stub = FieldServiceStub(channel)
    partial = folder / f".{field_id}.part"
    size_bytes = await _size(stub, field_id, metadata)
    log.info("fetching field", field=field_id, size_bytes=size_bytes)
    await Transfer(stub, field_id, partial, size_bytes, metadata, beginnings).receive_all()
    await asyncio.to_thread(_check_and_add, store, field_id, partial)
    log.info("field fetched", field=field_id)


async def _size(stub: FieldServiceAsyncStub, field_id: str, metadata: Metadata) -> int:
    request = pb.GetManifestRequest(field_id=field_id)
    try:
        manifest = await stub.GetManifest(request, metadata=metadata, wait_for_ready=True)
    except grpc.aio.AioRpcError as error:
        if error.code() is grpc.StatusCode.NOT_FOUND:
            raise UnknownField(f"{error.details()} (asked for {field_id})") from error
        raise RfedgeError(f"the server has no manifest of {field_id}: {error.details()}") from error
    if not 0 < manifest.size_bytes <= MAX_FIELD_BYTES:
        raise FieldFormatError(
            f"field {field_id} has {manifest.size_bytes} bytes, at most {MAX_FIELD_BYTES} are taken"
        )
    return int(manifest.size_bytes)


@dataclass(frozen=True)
class Transfer:
    """Receives a field's archive into a partial file."""

    stub: FieldServiceAsyncStub
    field_id: str
    partial: Path
    size_bytes: int
    metadata: Metadata
    beginnings: Beginnings | None

    async def receive_all(self) -> None:
        """Receive what is missing; resume where it broke, and try a busy server again."""
        resumes = refusals = 0
        while True:
            try:
                await self._receive()
                return
            except grpc.aio.AioRpcError as error:
                is_refused = error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
                resumes, refusals = resumes + (not is_refused), refusals + is_refused
                final = not is_refused and error.code() not in RETRIED
                if final or resumes > MAX_RESUMES or refusals > MAX_REFUSALS:
                    problem = f"{error.code().name}: {error.details()}"
                    raise RfedgeError(
                        f"field {self.field_id} does not arrive ({problem})"
                    ) from error
                log.warning("field transfer interrupted", problem=error.details())
                await asyncio.sleep(retry_after_s(error))

    async def _receive(self) -> None:
        have_bytes = self.partial.stat().st_size if self.partial.exists() else 0
        await self._use(have_bytes)
        if have_bytes >= self.size_bytes:
            return
        request = pb.FetchFieldRequest(field_id=self.field_id, offset_bytes=have_bytes)
        call = self.stub.FetchField(request, metadata=self.metadata, wait_for_ready=True)
        with self.partial.open("ab") as file:
            async for response in call:
                end_bytes = response.offset_bytes + len(response.chunk)
                if response.offset_bytes != have_bytes or end_bytes > self.size_bytes:
                    raise FieldFormatError(
                        f"the server sent bytes {response.offset_bytes}..{end_bytes} of field "
                        f"{self.field_id} where {have_bytes}.. of {self.size_bytes} were expected"
                    )
                await asyncio.to_thread(_append, file, response.chunk)
                have_bytes = end_bytes
                await self._use(have_bytes)
        if have_bytes != self.size_bytes:
            raise FieldFormatError(
                f"field {self.field_id} ended after {have_bytes} of {self.size_bytes} bytes; try "
                "again"
            )

    async def _use(self, have_bytes: int) -> None:
        """Use what has arrived; remove it if it is damaged, so that no transfer resumes from it."""
        if self.beginnings is None:
            return
        try:
            await self.beginnings.arrived(self.partial, have_bytes)
        except FieldFormatError:
            self.partial.unlink(missing_ok=True)
            raise


def _append(file: BinaryIO, chunk: bytes) -> None:
    file.write(chunk)
    file.flush()


def _check_and_add(store: FieldStore, field_id: str, partial: Path) -> None:
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
