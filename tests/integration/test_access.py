"""Certificates on a live server: revoked, expired, granted less; connections of a great age."""

import asyncio
import threading
from contextlib import AsyncExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import grpc
import pytest
from structlog.testing import capture_logs

import mec_server.server
from frames import message_of
from live_server import Files, certificates, channel_to, open_stream, watch_call
from mec_server.config import IdentityBudget
from rfcore.camera import Camera
from rfcore.wire.conventions import STREAM_METHOD
from rfcore.wire.tls import TlsFiles
from rfcore.wire.twin import Subscription, twin_message_from_wire
from rfcore.wire.twin_client import TwinClient
from rfcore.wire.twin_render import (
    ObjectsRequest,
    ViewRequest,
    objects_request_to_wire,
    view_request_to_wire,
)
from rfcore.wire.v1 import field_pb2, field_pb2_grpc, twin_pb2_grpc
from rfedge.certs import Members

SUPPRESSED = "rfedge_server_log_lines_suppressed_total"
MEMBERS = Members(("cav-raw", "cav-1", "cav-2"), ("desk", "other"), operators=("op",))


@pytest.fixture
def certs(tmp_path: Path) -> Files:
    return certificates(tmp_path / "certs", MEMBERS)


@pytest.fixture
def swift(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mec_server.server, "SWEEP_EVERY_S", 0.02)


async def status_of_watch(address: object, tls: TlsFiles, *names: str) -> grpc.StatusCode:
    """Watch until the server ends the stream; return how."""
    async with channel_to(address, tls) as channel:
        subscription = Subscription(frozenset(names))
        call = watch_call(channel, subscription)
        return await call.code()


@pytest.mark.parametrize(
    ("granted", "may_see"),
    [
        ('tiles = ["west"]', "nothing (this server has no tile west)"),
        ('vehicles = ["cav-2"]', "vehicle cav-2"),
        ("all = true", ""),
    ],
)
async def test_a_watcher_is_told_what_its_certificate_may_see(
    granted: str, may_see: str, certs: Files, serve: Any, tmp_path: Path
) -> None:
    access, told, heard = tmp_path / "access.toml", list[str](), threading.Event()
    access.write_text(f"[consumers.desk]\n{granted}")

    def connected(text: str) -> None:
        told.append(text)
        heard.set()

    async with serve(tls=certs("server"), access=access) as server:
        client = TwinClient(str(server.address), certs("consumer-desk"))
        watching = asyncio.create_task(
            asyncio.to_thread(lambda: list(client.watch(connected=connected)))
        )
        assert await asyncio.to_thread(heard.wait, 15.0)
        client.stop()
        await watching
        client.close()
    assert told == [may_see]


@pytest.mark.usefixtures("swift")
async def test_a_revoked_vehicle_loses_its_open_stream_and_another_does_not(
    certs: Files, serve: Any, coded: Any, tmp_path: Path
) -> None:
    access = tmp_path / "access.toml"
    access.write_text("")
    async with (
        serve(tls=certs("server"), access=access) as server,
        channel_to(server.address, certs("vehicle-cav-raw")) as channel,
        channel_to(server.address, certs("operator-op")) as other,
    ):
        stream = await open_stream(channel, coded.hello)
        watching = watch_call(other)
        await watching.initial_metadata()
        access.write_text('revoked = ["spiffe://rfedge/vehicle/cav-raw"]')
        assert await stream.code() is grpc.StatusCode.UNAUTHENTICATED
        assert "revoked" in await stream.details()
        assert not watching.done()
        again = channel.stream_stream(STREAM_METHOD)()
        assert await again.code() is grpc.StatusCode.UNAUTHENTICATED
        refused = server.registry.get_sample_value("rfedge_server_refused_certificates_total")
        assert refused == 2
        while server.registry.get_sample_value("rfedge_server_sessions"):
            await asyncio.sleep(0.01)
        access.write_text("")
        while True:  # the list is read again within a moment
            try:
                await open_stream(channel, coded.hello)
                break
            except (AssertionError, grpc.aio.AioRpcError, asyncio.InvalidStateError, TypeError):
                await asyncio.sleep(0.02)


@pytest.mark.usefixtures("swift")
async def test_a_certificate_that_expires_ends_the_stream_that_it_opened(
    certs: Files, serve: Any, coded: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with (
        serve(tls=certs("server")) as server,
        channel_to(server.address, certs("vehicle-cav-raw")) as channel,
    ):
        stream = await open_stream(channel, coded.hello)
        later = datetime.now(UTC) + timedelta(days=31)
        monkeypatch.setattr(server._guard, "_utc_now", lambda: later)
        assert await stream.code() is grpc.StatusCode.UNAUTHENTICATED
        assert "expired at" in await stream.details()


async def first_picture(address: object, tls: TlsFiles) -> str:
    async with channel_to(address, tls) as channel:
        call = watch_call(channel)
        async for response in call:
            return twin_message_from_wire(response).vehicle_id
    raise AssertionError("the stream ended")


async def test_consumers_see_what_they_are_granted(
    certs: Files, serve: Any, coded: Any, street: Any, tmp_path: Path
) -> None:
    access = tmp_path / "access.toml"
    access.write_text('[consumers.desk]\nvehicles = ["cav-raw"]')
    async with (
        serve(tls=certs("server"), access=access) as server,
        channel_to(server.address, certs("vehicle-cav-raw")) as channel,
    ):
        stream = await open_stream(channel, coded.hello)
        await stream.write(message_of(coded.hello, coded.frames[0]))
        await stream.read()
        address = server.address
        assert await first_picture(address, certs("consumer-desk")) == "cav-raw"
        assert await first_picture(address, certs("operator-op")) == "cav-raw"
        assert await first_picture(address, certs("vehicle-cav-raw")) == "cav-raw"
        denied = grpc.StatusCode.PERMISSION_DENIED
        assert await status_of_watch(address, certs("consumer-other")) is denied
        assert await status_of_watch(address, certs("consumer-desk"), "cav-2") is denied
        assert await status_of_watch(address, certs("vehicle-cav-2"), "cav-raw") is denied
        async with channel_to(address, certs("consumer-desk")) as desk:
            stub = field_pb2_grpc.FieldServiceStub(desk)
            assert not (await stub.ListFields(field_pb2.ListFieldsRequest())).field_ids
            request = field_pb2.GetManifestRequest(field_id=street.field_id)
            with pytest.raises(grpc.aio.AioRpcError) as told:
                await stub.GetManifest(request)
            assert told.value.code() is denied


@pytest.mark.usefixtures("swift")
async def test_a_grant_that_changes_ends_the_stream_that_had_the_old_one(
    certs: Files, serve: Any, tmp_path: Path
) -> None:
    access = tmp_path / "access.toml"
    access.write_text("[consumers.desk]\nall = true")
    async with (
        serve(tls=certs("server"), access=access) as server,
        channel_to(server.address, certs("consumer-desk")) as channel,
    ):
        call = watch_call(channel)
        await call.initial_metadata()
        access.write_text('[consumers.desk]\nvehicles = ["cav-1"]')
        assert await call.code() is grpc.StatusCode.UNAUTHENTICATED
        assert "has changed; connect again" in await call.details()


async def test_a_connection_of_a_great_age_is_renewed(
    serve: Any, travel: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mec_server.server, "CONNECTION_GRACE_MS", 100)
    async with serve(max_connection_age_s=1.0) as server:
        async with grpc.aio.insecure_channel(str(server.address)) as channel:
            call = watch_call(channel)
            await call.initial_metadata()
            async with asyncio.timeout(30):
                assert await call.code() is not grpc.StatusCode.OK
        assert (await travel(server.address)).counts["acked"] == 6


@pytest.mark.parametrize("claimed_ns", [0, 2**63 - 1])
async def test_a_capture_time_that_cannot_be_makes_no_age(
    serve: Any, coded: Any, raw_vehicle: Any, claimed_ns: int
) -> None:
    from dataclasses import replace

    async with serve() as server, raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        frame = replace(coded.frames[0], capture_time_ns=claimed_ns)
        assert await vehicle.told(frame) == ("ack", 0)
        value = server.registry.get_sample_value
        assert value("rfedge_server_implausible_captures_total") == 1
        assert value("rfedge_twin_age_seconds") < 60
        assert value("rfedge_server_capture_to_picture_seconds_sum") == 0


async def test_views_show_what_their_consumer_is_granted(
    certs: Files, serve: Any, coded: Any, street: Any, tmp_path: Path
) -> None:
    access = tmp_path / "access.toml"
    access.write_text('[consumers.desk]\nvehicles = ["cav-raw"]')
    pose = coded.frames[0].pose
    camera = Camera(coded.hello.cameras[0].intrinsics, pose)
    request = view_request_to_wire(ViewRequest(camera, field_id=street.field_id, max_age_s=10.0))

    async def seen_by(name: str) -> list[str]:
        async with channel_to(server.address, certs(name)) as peer:
            response = await twin_pb2_grpc.TwinServiceStub(peer).Render(request)
            return [camera.vehicle_id for camera in response.cameras]

    async with (
        serve(tls=certs("server"), access=access) as server,
        channel_to(server.address, certs("vehicle-cav-raw")) as channel,
    ):
        stream = await open_stream(channel, coded.hello)
        await stream.write(message_of(coded.hello, coded.frames[0]))
        await stream.read()
        assert await seen_by("operator-op") == ["cav-raw"]
        assert await seen_by("vehicle-cav-raw") == ["cav-raw"]
        assert await seen_by("vehicle-cav-2") == []
        for name in ("consumer-desk", "consumer-other"):
            with pytest.raises(grpc.aio.AioRpcError) as caught:
                await seen_by(name)
            assert caught.value.code() is grpc.StatusCode.PERMISSION_DENIED
            assert "may not see that tile" in caught.value.details()


async def test_calls_that_are_refused_are_charged_for(
    certs: Files, serve: Any, tmp_path: Path
) -> None:
    access = tmp_path / "access.toml"
    access.write_text('revoked = ["spiffe://rfedge/vehicle/cav-raw"]')
    budget = IdentityBudget(calls_per_s=5)
    async with (
        serve(tls=certs("server"), access=access, identity_budget=budget) as server,
        channel_to(server.address, certs("vehicle-cav-raw")) as channel,
        channel_to(server.address, certs("vehicle-cav-1")) as other,
    ):
        told = set()
        async with asyncio.timeout(30):
            while grpc.StatusCode.RESOURCE_EXHAUSTED not in told:
                told.add(await channel.stream_stream(STREAM_METHOD)().code())
        assert grpc.StatusCode.UNAUTHENTICATED in told
        listing = field_pb2_grpc.FieldServiceStub(other).ListFields(field_pb2.ListFieldsRequest())
        assert await listing.code() is grpc.StatusCode.OK


async def test_lines_about_calls_that_are_refused_are_written_at_a_rate(
    certs: Files, serve: Any, tmp_path: Path
) -> None:
    access = tmp_path / "access.toml"
    access.write_text('revoked = ["spiffe://rfedge/vehicle/cav-raw"]')
    calls = 0
    with capture_logs() as lines:
        async with (
            serve(
                tls=certs("server"), access=access, identity_budget=IdentityBudget(calls_per_s=1e6)
            ) as server,
            channel_to(server.address, certs("vehicle-cav-raw")) as channel,
        ):
            async with asyncio.timeout(60):
                while not server.registry.get_sample_value(SUPPRESSED):
                    calls += 1
                    code = await channel.stream_stream(STREAM_METHOD)().code()
                    assert code is grpc.StatusCode.UNAUTHENTICATED
    assert sum(line["event"] == "call refused" for line in lines) == calls - 1


async def test_calls_of_methods_that_there_are_not_are_charged_for(
    certs: Files, serve: Any
) -> None:
    budget = IdentityBudget(calls_per_s=5)
    async with (
        serve(tls=certs("server"), identity_budget=budget) as server,
        channel_to(server.address, certs("vehicle-cav-raw")) as channel,
    ):
        unary = channel.unary_unary("/rfcore.wire.v1.EdgeService/Nothing")(b"")
        assert await unary.code() is grpc.StatusCode.UNIMPLEMENTED
        assert "no such method" in (await unary.details() or "")
        told = set()
        async with asyncio.timeout(30):
            while grpc.StatusCode.RESOURCE_EXHAUSTED not in told:
                told.add(await channel.unary_unary("/no.Service/Nothing")(b"").code())
        assert limited_calls(server) >= 1


def limited_calls(server: Any) -> float:
    labels = {"limit": "identity_calls"}
    return float(server.registry.get_sample_value("rfedge_server_limited_total", labels))


async def test_objects_are_told_to_whom_the_tile_and_the_pictures_are_granted(
    certs: Files, serve: Any, coded: Any, street: Any, tmp_path: Path
) -> None:
    """A vehicle may have the field, and so may ask, but sees nobody else's pictures."""
    access = tmp_path / "access.toml"
    access.write_text('[consumers.desk]\nvehicles = ["cav-raw"]')
    request = objects_request_to_wire(ObjectsRequest(field_id=street.field_id))
    async with AsyncExitStack() as stack:
        server = await stack.enter_async_context(serve(tls=certs("server"), access=access))

        async def objects(name: str) -> Any:
            channel = await stack.enter_async_context(channel_to(server.address, certs(name)))
            return twin_pb2_grpc.TwinServiceStub(channel).Objects(request)

        for name in ("consumer-desk", "consumer-other"):
            call = await objects(name)
            assert await call.code() is grpc.StatusCode.PERMISSION_DENIED
            assert "may not see that tile" in await call.details()
        granted, other = await objects("operator-op"), await objects("vehicle-cav-2")
        for call in (granted, other):
            await call.initial_metadata()
        channel = channel_to(server.address, certs("vehicle-cav-raw"))
        async with channel:
            stream = await open_stream(channel, coded.hello)
            await stream.write(message_of(coded.hello, coded.frames[0]))
            await stream.read()
            assert (await granted.read()).field_id == street.field_id
        assert (await granted.read()).field_id == street.field_id, "once more when it has left"
        await server.stop()
        assert await other.read() is grpc.aio.EOF
