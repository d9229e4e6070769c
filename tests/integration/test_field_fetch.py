"""A vehicle without the field gets it from the server, whole or not at all."""

import asyncio
import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import Any, BinaryIO

import grpc
import pytest

from cav_agent.field_fetch import Beginnings, fetch_field
from mec_server.fields.service import read_chunk
from rfcore.errors import FieldFormatError, RfedgeError, UnknownField
from rfcore.field import FieldStore
from rfcore.field.archive import PREFIX_BYTES, array_ends, header_end
from rfcore.field.splat_archive import detail_ends
from rfcore.field.store import decode_beginning, encode_field
from rfcore.wire.v1 import field_pb2 as pb
from rfcore.wire.v1.field_pb2_grpc import FieldServiceStub


async def test_a_field_the_vehicle_lacks_is_fetched_and_used(
    street: Any, serve: Any, travel: Any, tmp_path: Path
) -> None:
    async with serve() as server:
        record = await travel(server.address, fields=tmp_path / "mine")
    assert record.counts == {"acked": 6}
    assert FieldStore(tmp_path / "mine").ids() == (street.field_id,)
    assert [p.name for p in (tmp_path / "mine").iterdir()] == [f"{street.field_id}.rff"]


async def test_a_field_nobody_has_is_refused_with_both_ids_named(
    street: Any, serve: Any, travel: Any, tmp_path: Path
) -> None:
    async with serve() as server:
        with pytest.raises(UnknownField) as caught:
            await travel(server.address, fields=tmp_path / "mine", field="ef" * 32)
    assert "ef" * 32 in str(caught.value)
    assert street.field_id in str(caught.value)


async def test_an_interrupted_transfer_goes_on_where_it_stopped(
    street: Any, serve: Any, tmp_path: Path
) -> None:
    archive = (street.store / "street.rff").read_bytes()
    partial = tmp_path / f".{street.field_id}.part"
    partial.write_bytes(archive[:1000])
    asked: list[int] = []

    class Listening(grpc.aio.UnaryStreamClientInterceptor):
        async def intercept_unary_stream(self, continuation, details, request):  # type: ignore[no-untyped-def]
            asked.append(request.offset_bytes)
            return await continuation(details, request)

    async with (
        serve() as server,
        grpc.aio.insecure_channel(str(server.address), interceptors=[Listening()]) as channel,
    ):
        await fetch_field(channel, FieldStore(tmp_path), street.field_id, tmp_path)
    assert asked == [1000]
    assert FieldStore(tmp_path).path(street.field_id).read_bytes() == archive


async def test_a_kept_part_that_was_damaged_is_fetched_anew(
    street: Any, serve: Any, tmp_path: Path
) -> None:
    (tmp_path / f".{street.field_id}.part").write_bytes(b"garbage")
    async with (
        serve() as server,
        grpc.aio.insecure_channel(str(server.address)) as channel,
    ):
        store = FieldStore(tmp_path)
        await fetch_field(channel, store, street.field_id, tmp_path)
    assert store.ids() == (street.field_id,)
    assert [path.name for path in tmp_path.iterdir()] == [f"{street.field_id}.rff"]


async def test_what_the_server_sends_is_refused_if_it_is_not_the_field(
    street: Any, serve: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "mec_server.fields.service.read_chunk",
        lambda path, offset_bytes: bytes(len(read_chunk(path, offset_bytes))),
    )
    async with (
        serve() as server,
        grpc.aio.insecure_channel(str(server.address)) as channel,
    ):
        store = FieldStore(tmp_path)
        with pytest.raises(FieldFormatError, match=r"has sha256 .*; it was removed"):
            await fetch_field(channel, store, street.field_id, tmp_path)
    assert list(tmp_path.iterdir()) == []


async def test_two_vehicles_share_a_folder(
    street: Any, serve: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each has a partial file of its own; the one that is left over is taken by the next fetch."""
    archive = (street.store / "street.rff").read_bytes()
    with sent_up_to(monkeypatch, len(archive) // 2) as may_go_on:
        async with (
            serve() as server,
            grpc.aio.insecure_channel(str(server.address)) as channel,
        ):
            store = FieldStore(tmp_path)
            fetches = [
                asyncio.create_task(fetch_field(channel, store, street.field_id, tmp_path))
                for _ in range(2)
            ]
            async with asyncio.timeout(30):
                while len(parts := list(tmp_path.glob(".*.part"))) < 2 or not all(
                    path.stat().st_size for path in parts
                ):
                    await asyncio.sleep(0.001)
            may_go_on.set()
            await asyncio.gather(*fetches)
    assert [path.name for path in tmp_path.iterdir()] == [f"{street.field_id}.rff"]
    assert store.path(street.field_id).read_bytes() == archive


async def test_a_full_disk_is_named_and_what_came_before_is_kept(
    street: Any, serve: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(file: BinaryIO, chunk: bytes) -> None:
        file.write(chunk[:100])
        file.flush()
        raise OSError(errno.ENOSPC, "No space left on device")

    async with (
        serve() as server,
        grpc.aio.insecure_channel(str(server.address)) as channel,
    ):
        store = FieldStore(tmp_path)
        with monkeypatch.context() as disk:
            disk.setattr("cav_agent.field_fetch._append", full)
            with pytest.raises(RfedgeError, match="No space left"):
                await fetch_field(channel, store, street.field_id, tmp_path)
        assert (tmp_path / f".{street.field_id}.part").stat().st_size == 100
        await fetch_field(channel, store, street.field_id, tmp_path)
    assert store.ids() == (street.field_id,)


async def test_the_field_service_tells_what_it_has_and_refuses_by_name(
    street: Any, serve: Any
) -> None:
    async with (
        serve() as server,
        grpc.aio.insecure_channel(str(server.address)) as channel,
    ):
        stub = FieldServiceStub(channel)
        listed = await stub.ListFields(pb.ListFieldsRequest())
        assert list(listed.field_ids) == [street.field_id]
        manifest = await stub.GetManifest(pb.GetManifestRequest(field_id=street.field_id))
        assert manifest.size_bytes == (street.store / "street.rff").stat().st_size
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await stub.GetManifest(pb.GetManifestRequest(field_id="../../etc/passwd"))
        assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT
        past = pb.FetchFieldRequest(field_id=street.field_id, offset_bytes=1 << 40)
        with pytest.raises(grpc.aio.AioRpcError, match="offset_bytes: 1099511627776 is past"):
            await stub.FetchField(past).read()


async def test_a_damaged_field_keeps_the_server_from_starting(
    street: Any, serve: Any, tmp_path: Path
) -> None:
    data = bytearray((street.store / "street.rff").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / f"{street.field_id}.rff").write_bytes(data)
    with pytest.raises(FieldFormatError, match=street.field_id):
        async with serve(fields=tmp_path):
            pass


@contextmanager
def sent_up_to(monkeypatch: pytest.MonkeyPatch, size_bytes: int) -> Iterator[Event]:
    """Servers send so many bytes of a field, 100 at once, and the rest once the event is set."""
    may_go_on = Event()

    def chunk(path: Path, offset_bytes: int) -> bytes:
        if offset_bytes >= size_bytes:
            assert may_go_on.wait(60)
        return read_chunk(path, offset_bytes)[:100]

    monkeypatch.setattr("mec_server.fields.service.read_chunk", chunk)
    try:
        yield may_go_on
    finally:
        may_go_on.set()


def detail_bytes(archive: bytes) -> dict[float, int]:
    """Return the bytes of an archive that each level of detail needs."""
    return dict(detail_ends(array_ends(archive[: header_end(archive[:PREFIX_BYTES])])))


async def test_a_vehicle_drives_with_the_beginning_of_a_field_and_then_with_all_of_it(
    street: Any, serve: Any, vehicle: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One stream, one epoch, no frame refused: each says what level of detail it was drawn at."""
    archive = encode_field(street.field.compressed())
    store, mine = tmp_path / "fields", tmp_path / "mine"
    field_id = FieldStore(store).add(archive)
    with sent_up_to(monkeypatch, detail_bytes(archive)[0.25]) as may_go_on:
        async with (
            serve(fields=store) as server,
            vehicle(server.address, fields=mine, field=field_id, loop=True) as driving,
        ):
            await driving.until(lambda: driving.acked() >= 3 and details(driving)[-1] == "25%")
            assert driving.fields() == {f".{field_id}.part"}
            may_go_on.set()
            await driving.until(lambda: details(driving)[-1] == "100%")
            seen = driving.acked()
            await driving.until(lambda: driving.acked() >= seen + 3)
    drawn = details(driving)
    assert drawn == sorted(drawn, key=lambda detail: float(detail[:-1]))
    assert {line["result"] for line in driving.lines()} == {"acked"}
    assert {line["epoch"] for line in driving.lines()} == {0}
    assert {line["light_field"] for line in driving.lines()} == {None}
    assert driving.fields() == {f"{field_id}.rff"}
    assert driving.value("rfedge_agent_field_bytes_total") == len(archive)


def details(driving: Any) -> list[str]:
    """Return at what detail each picture was drawn, by the name of its rung."""
    return [line["rung"].split()[0] for line in driving.lines()]


async def test_beginnings_are_handed_over_once_each_and_again_after_a_broken_transfer(
    street: Any, serve: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive = encode_field(street.field.compressed())
    ends, mine = detail_bytes(archive), tmp_path / "mine"
    field_id = FieldStore(tmp_path / "fields").add(archive)
    begun: list[float] = []

    async def take(data: bytes) -> None:
        begun.append(decode_beginning(data, field_id).most_detail)

    async with (
        serve(fields=tmp_path / "fields") as server,
        grpc.aio.insecure_channel(str(server.address)) as channel,
    ):
        with sent_up_to(monkeypatch, ends[0.25]) as may_go_on:
            fetching = asyncio.create_task(
                fetch_field(channel, FieldStore(mine), field_id, mine, (), Beginnings(take))
            )
            async with asyncio.timeout(30):
                while begun != [0.1, 0.25]:
                    await asyncio.sleep(0.001)
            fetching.cancel()
            may_go_on.set()
        await fetch_field(channel, FieldStore(mine), field_id, mine, (), Beginnings(take))
    assert begun == [0.1, 0.25, 0.25, 0.5], "what is there at once is handed over as one"
    assert FieldStore(mine).path(field_id).read_bytes() == archive


async def test_a_damaged_beginning_is_fetched_anew(street: Any, serve: Any, tmp_path: Path) -> None:
    archive = encode_field(street.field.compressed())
    field_id = FieldStore(tmp_path / "fields").add(archive)
    store = FieldStore(tmp_path / "mine")
    partial = tmp_path / "mine" / f".{field_id}.part"
    damaged = bytearray(archive[: detail_bytes(archive)[0.1]])
    damaged[-100] ^= 1
    partial.write_bytes(damaged)

    async def take(data: bytes) -> None:
        decode_beginning(data, field_id)

    async with (
        serve(fields=tmp_path / "fields") as server,
        grpc.aio.insecure_channel(str(server.address)) as channel,
    ):
        await fetch_field(channel, store, field_id, tmp_path / "mine", (), Beginnings(take))
    assert store.ids() == (field_id,)
