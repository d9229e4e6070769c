"""A server that was told of a proxy takes its word for who a vehicle is, and nobody else's."""

from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import grpc
import pytest
import structlog

import mec_server.server
from live_server import Files, certificates, channel_to, open_stream
from mec_server.config import DecoderKind, ServerConfig
from mec_server.guard import FORWARDED
from mec_server.server import EdgeServer
from rfcore.errors import InvalidInput
from rfcore.wire.conventions import STREAM_METHOD
from rfcore.wire.convert import hello_to_bytes
from rfcore.wire.settings import TransportSettings
from rfcore.wire.tls import TlsFiles
from rfcore.wire.v1 import field_pb2, field_pb2_grpc
from rfedge.certs import Members

MEMBERS = Members(("cav-raw", "cav-2"), ("desk",), proxies=("edge-proxy",))
PROXY = {"proxy_identity": ("edge-proxy",), "decoder": DecoderKind.IN_PROCESS}


@pytest.fixture
def certs(tmp_path: Path) -> Files:
    return certificates(tmp_path / "certs", MEMBERS)


def forwarded(tls: TlsFiles) -> tuple[tuple[str, str], ...]:
    """The header that Envoy sends for a client with this certificate."""
    role, _, name = tls.certificate.stem.partition("-")
    uri = f"spiffe://rfedge/{role}/{name}"
    return ((FORWARDED, f'Hash=ab;Cert="{quote(tls.certificate.read_bytes())}";URI={uri}'),)


async def hello(channel: grpc.aio.Channel, coded: Any, metadata: Any = ()) -> Any:
    stream = channel.stream_stream(STREAM_METHOD)(metadata=metadata)
    await stream.write(hello_to_bytes(coded.hello))
    return stream


async def test_a_vehicle_behind_the_proxy_is_whom_the_proxy_says_it_is(
    certs: Files, serve: Any, coded: Any
) -> None:
    async with (
        serve(tls=certs("server"), **PROXY) as server,
        channel_to(server.address, certs("proxy-edge-proxy")) as proxy,
    ):
        await open_stream(proxy, coded.hello, forwarded(certs("vehicle-cav-raw")))
        for other in ("vehicle-cav-2", "consumer-desk"):
            stream = await hello(proxy, coded, forwarded(certs(other)))
            assert await stream.code() is grpc.StatusCode.PERMISSION_DENIED
        garbled = await hello(proxy, coded, ((FORWARDED, "URI=spiffe://rfedge/vehicle/cav-raw"),))
        assert await garbled.code() is grpc.StatusCode.UNAUTHENTICATED
        own = await hello(proxy, coded)
        assert await own.code() is grpc.StatusCode.PERMISSION_DENIED
        assert "spiffe://rfedge/proxy/edge-proxy" in (await own.details() or "")


@pytest.mark.parametrize(
    ("peer", "told"),
    [("vehicle-cav-2", PROXY), ("consumer-desk", PROXY), ("proxy-edge-proxy", {})],
)
async def test_the_header_of_anybody_else_means_nothing(
    certs: Files, serve: Any, coded: Any, peer: str, told: dict[str, Any]
) -> None:
    async with (
        serve(tls=certs("server"), **told) as server,
        channel_to(server.address, certs(peer)) as channel,
    ):
        forged = await hello(channel, coded, forwarded(certs("vehicle-cav-raw")))
        assert await forged.code() is grpc.StatusCode.PERMISSION_DENIED
        assert "is not whom its certificate names" in (await forged.details() or "")


async def test_a_proxy_alone_may_have_no_field(certs: Files, serve: Any, street: Any) -> None:
    request = field_pb2.GetManifestRequest(field_id=street.field_id)
    async with (
        serve(tls=certs("server"), **PROXY) as server,
        channel_to(server.address, certs("proxy-edge-proxy")) as proxy,
    ):
        stub = field_pb2_grpc.FieldServiceStub(proxy)
        with pytest.raises(grpc.aio.AioRpcError) as told:
            await stub.GetManifest(request)
        assert told.value.code() is grpc.StatusCode.PERMISSION_DENIED
        vehicle = forwarded(certs("vehicle-cav-2"))
        assert (await stub.GetManifest(request, metadata=vehicle)).size_bytes > 0


@pytest.mark.parametrize(
    ("revoked", "other_goes_on"),
    [("spiffe://rfedge/vehicle/cav-raw", True), ("spiffe://rfedge/proxy/edge-proxy", False)],
)
async def test_a_vehicle_behind_the_proxy_is_revoked_alone_and_the_proxy_with_all(
    certs: Files, serve: Any, coded: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    revoked: str, other_goes_on: bool,
) -> None:  # fmt: skip
    monkeypatch.setattr(mec_server.server, "SWEEP_EVERY_S", 0.02)
    access = tmp_path / "access.toml"
    access.write_text("")
    async with (
        serve(tls=certs("server"), access=access, **PROXY) as server,
        channel_to(server.address, certs("proxy-edge-proxy")) as proxy,
    ):
        stream = await open_stream(proxy, coded.hello, forwarded(certs("vehicle-cav-raw")))
        access.write_text(f'revoked = ["{revoked}"]')
        assert await stream.code() is grpc.StatusCode.UNAUTHENTICATED
        assert "revoked" in await stream.details()
        request = field_pb2.ListFieldsRequest()
        listing = field_pb2_grpc.FieldServiceStub(proxy).ListFields(
            request, metadata=forwarded(certs("vehicle-cav-2"))
        )
        ended = await listing.code()
        assert (ended is grpc.StatusCode.OK) is other_goes_on, ended


def test_a_proxy_is_named_only_to_a_server_with_certificates(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="without certificates no proxy is known"):
        ServerConfig(tmp_path, proxy_identity=("edge-proxy",))
    with pytest.raises(InvalidInput, match="proxy-identity"):
        ServerConfig(tmp_path, proxy_identity=("edge proxy/",))


def starts_in_process(config: ServerConfig) -> bool:
    """Whether a server of ``config`` says that it decodes in its own process."""
    with structlog.testing.capture_logs() as lines:
        EdgeServer(config)
    return any(line["event"] == "decoding in the server's own process" for line in lines)


async def test_auto_trusts_nobody_who_comes_through_a_proxy_of_this_machine(
    certs: Files, tmp_path: Path
) -> None:
    files = certs("server")
    transport = TransportSettings(files.certificate, files.key, files.authority)
    alone = ServerConfig(tmp_path, "127.0.0.1:0", transport=transport)
    assert starts_in_process(alone)
    assert not starts_in_process(replace(alone, proxy_identity=("edge-proxy",)))
