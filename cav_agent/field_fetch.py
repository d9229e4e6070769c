"""Fetches a field's archive from a server; a transfer that broke is resumed.

What has arrived lies in a partial file, and is not sent again. The digest of the whole is checked
before the archive is parsed. An archive that begins with its lowest level of detail
(``rfcore.field.splat_archive``) is of use before it is whole: a beginning of it is parsed, each
array checked against its own digest. The server draws the same from the whole; a beginning of
another field shows at the latest when the server compares a render.

While pictures are sent a field comes chunk by chunk, with rests (``FetchPace``): answers to frames
come the same way, and wait behind it.
"""

from __future__ import annotations

import asyncio
import hashlib
import itertools
import math
import os
import time
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import grpc
import structlog

from rfcore.errors import FieldFormatError, RfedgeError, UnknownField
from rfcore.field import FieldStore
from rfcore.field.archive import PREFIX_BYTES, array_ends, header_end
from rfcore.field.splat_archive import detail_ends
from rfcore.files import open_alone
from rfcore.wire.conventions import retry_after_s
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


IN_FLIGHT_BYTES = 64 * 1024
"""HTTP/2's window: so much of a field is under way beyond what was asked for."""

WAITED_S = 0.001
"""A chunk that took longer was not there before it was asked for."""

SLOWER_S = 0.02
"""A chunk that takes longer after a rest, in which a window of them can come, shows that the link
has become slower."""

ROUND_TRIP_S = 0.1
"""Longest time in which what was asked for begins to come."""

MEASURE_AGAIN_S = 5.0
"""A link's rate is measured again so often, by chunks without rests between them."""


class FetchPace:
    """Spaces the chunks of fields so that they take ``share`` of the link while pictures are sent.

    ``is_sending`` says whether they are. Otherwise chunks follow each other at the link's rate,
    and that is measured: over ``IN_FLIGHT_BYTES`` in chunks that all had to be waited for.
    No clock is read: ``now`` is an argument.
    """

    def __init__(self, share: float, is_sending: Callable[[], bool]) -> None:
        self._share = share
        self._is_sending = is_sending
        self._bytes_per_s: float | None = None
        self._measured_s = 0.0
        self._run: tuple[float, int] | None = None
        """Start and bytes of a measurement: since when chunks come that are all waited for."""
        self._has_rested = False
        self._due_s = 0.0
        self._chunks: deque[tuple[float, int]] = deque(maxlen=64)

    def received(self, size_bytes: int, waited_s: float, now: float) -> float:
        """Note a chunk that was waited for; return when the next may be asked for."""
        self._chunks.append((now, size_bytes))
        self._measure(size_bytes, waited_s, now)
        rate = self._bytes_per_s
        if rate is None or not self._is_sending():
            self._due_s = now
            return now
        self._due_s = max(self._due_s, now) + size_bytes / (self._share * rate)
        if self._due_s <= now or now - self._measured_s >= MEASURE_AGAIN_S:
            return now
        self._run, self._has_rested = None, True
        return self._due_s

    def _measure(self, size_bytes: int, waited_s: float, now: float) -> None:
        is_waited, has_rested = waited_s > WAITED_S, self._has_rested
        self._has_rested = False
        if waited_s > SLOWER_S and has_rested:
            self._measured_s = -math.inf
        if not is_waited or self._run is None:
            self._run = (now, 0) if is_waited else None
            return
        since_s, run_bytes = self._run
        self._run = since_s, run_bytes + size_bytes
        if self._run[1] >= IN_FLIGHT_BYTES:
            self._bytes_per_s = self._run[1] / (now - since_s)
            self._measured_s, self._run = now, (now, 0)

    def wait_s(self, since_s: float, until_s: float) -> float:
        """Return how long an answer between two times can have waited behind chunks."""
        came = (size for at_s, size in self._chunks if since_s - ROUND_TRIP_S <= at_s <= until_s)
        size_bytes = sum(came)
        if not size_bytes or self._bytes_per_s is None:
            return until_s - since_s if size_bytes else 0.0
        return min(size_bytes, 2 * IN_FLIGHT_BYTES) / self._bytes_per_s


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
            self._ends = None
            await self._take(await asyncio.to_thread(_first_bytes, partial, there[-1]))
            self._ends = ends[len(there) :]


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
    pace: FetchPace | None = None,
) -> None:
    """Put field ``field_id`` of the server into ``store``; what arrived before is not sent again.

    The partial file lies in ``folder``; processes that share it have one each. If it was damaged
    meanwhile, the field is fetched anew. ``metadata`` goes with each call. Raises ``UnknownField``
    when the server lacks the field, ``FieldFormatError`` when what arrives is not the field,
    ``RfedgeError`` when it does not come or cannot be kept, and what ``beginnings`` do.
    """
    stub = FieldServiceStub(channel)
    size_bytes = await _size(stub, field_id, metadata)
    log.info("fetching field", field=field_id, size_bytes=size_bytes)
    pace = pace or FetchPace(1.0, lambda: False)
    try:
        with _partial_file(folder, field_id) as partial:
            transfer = Transfer(stub, field_id, partial, size_bytes, metadata, beginnings, pace)
            kept_bytes = partial.stat().st_size
            try:
                await _complete(transfer, store)
            except FieldFormatError as error:
                if not kept_bytes:
                    raise
                log.warning("fetching anew", kept_bytes=kept_bytes, problem=str(error))
                await _complete(transfer, store)
    except OSError as error:
        raise RfedgeError(f"field {field_id} cannot be kept in {folder}: {error}") from error
    log.info("field fetched", field=field_id)


@contextmanager
def _partial_file(folder: Path, field_id: str) -> Iterator[Path]:
    """Choose the first partial file that nobody else fetches to; one that is empty is removed."""
    for number in itertools.count():
        path = folder / (f".{field_id}.{number}.part" if number else f".{field_id}.part")
        try:
            file = open_alone(path)
            break
        except BlockingIOError:
            continue
    with file:
        try:
            yield path
        finally:
            if not path.stat().st_size:
                path.unlink()


async def _complete(transfer: Transfer, store: FieldStore) -> None:
    """Receive the rest and add the field to the store; an archive that is damaged is emptied."""
    try:
        await transfer.receive_all()
        await asyncio.to_thread(_check_and_add, store, transfer.field_id, transfer.partial)
    except FieldFormatError:
        os.truncate(transfer.partial, 0)
        raise


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
    pace: FetchPace

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
                await asyncio.sleep(retry_after_s(error.trailing_metadata()))

    async def _receive(self) -> None:
        have_bytes = self.partial.stat().st_size if self.partial.exists() else 0
        await self._use(have_bytes)
        if have_bytes >= self.size_bytes:
            return
        request = pb.FetchFieldRequest(field_id=self.field_id, offset_bytes=have_bytes)
        call = self.stub.FetchField(request, metadata=self.metadata, wait_for_ready=True)
        with self.partial.open("ab") as file:
            while True:
                asked_s = time.monotonic()
                response = await call.read()
                if not isinstance(response, pb.FetchFieldResponse):  # grpc.aio.EOF
                    break
                now = time.monotonic()
                due_s = self.pace.received(len(response.chunk), now - asked_s, now)
                end_bytes = response.offset_bytes + len(response.chunk)
                if response.offset_bytes != have_bytes or end_bytes > self.size_bytes:
                    raise FieldFormatError(
                        f"the server sent bytes {response.offset_bytes}..{end_bytes} of field "
                        f"{self.field_id} where {have_bytes}.. of {self.size_bytes} were expected"
                    )
                await asyncio.to_thread(_append, file, response.chunk)
                have_bytes = end_bytes
                await self._use(have_bytes)
                await asyncio.sleep(due_s - time.monotonic())
        if have_bytes != self.size_bytes:
            raise FieldFormatError(
                f"field {self.field_id} ended after {have_bytes} of {self.size_bytes} bytes; try "
                "again"
            )

    async def _use(self, have_bytes: int) -> None:
        if self.beginnings is not None:
            await self.beginnings.arrived(self.partial, have_bytes)


def _append(file: BinaryIO, chunk: bytes) -> None:
    file.write(chunk)
    file.flush()


def _check_and_add(store: FieldStore, field_id: str, partial: Path) -> None:
    """Add the file to the store, and empty it."""
    with partial.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if found != field_id:
        raise FieldFormatError(
            f"what the server sent as field {field_id} has sha256 {found}; it was removed"
        )
    store.add(partial, field_id)
    os.truncate(partial, 0)
