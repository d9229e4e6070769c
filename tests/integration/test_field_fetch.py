"""A vehicle without the field gets it from the server, whole or not at all."""

from pathlib import Path
from typing import Any

import grpc
import pytest

from cav_agent.field_fetch import fetch_field
from rfcore.errors import FieldFormatError, ProtocolError, UnknownField
from rfcore.field import FieldStore
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


async def test_the_servers_only_field_is_used_when_none_is_named(
    serve: Any, travel: Any, tmp_path: Path
) -> None:
    async with serve() as server:
        record = await travel(server.address, fields=tmp_path / "mine", field=None)
    assert record.counts == {"acked": 6}


async def test_a_field_the_server_lacks_is_refused_with_both_ids_named(
    street: Any, serve: Any, travel: Any
) -> None:
    """The vehicle holds another field than the server: Hello is refused."""
    async with serve() as server:
        with pytest.raises(ProtocolError) as caught:
            await travel(server.address, fields=street.other_store, field=street.other_id)
    assert street.other_id in str(caught.value)
    assert street.field_id in str(caught.value)


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


async def test_what_is_not_the_field_is_removed_and_the_next_try_succeeds(
    street: Any, serve: Any, tmp_path: Path
) -> None:
    partial = tmp_path / f".{street.field_id}.part"
    partial.write_bytes(b"garbage")
    async with (
        serve() as server,
        grpc.aio.insecure_channel(str(server.address)) as channel,
    ):
        store = FieldStore(tmp_path)
        with pytest.raises(FieldFormatError, match=r"has sha256 .*; it was removed"):
            await fetch_field(channel, store, street.field_id, tmp_path)
        assert list(tmp_path.iterdir()) == []
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
