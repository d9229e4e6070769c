"""Mutual TLS between the real services: who is let in as whom, and what the others are told."""

import asyncio
import shutil
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from cav_agent.config import AgentLimits
from live_server import Files, certificates, channel_to, watch_call
from rfcore.errors import AccessDenied, InvalidInput, ProtocolError, RfedgeError
from rfcore.wire.address import check_handshake, own_problem
from rfcore.wire.conventions import STREAM_METHOD
from rfcore.wire.tls import TlsFiles
from rfcore.wire.twin_client import TwinClient
from rfedge.certs import Members, certify, write_certificates
from rfedge.cli.services import CertsAdd, CertsInit
from rfedge.link import LinkSettings
from rfedge.link.proxy import LinkProxy

SOON = AgentLimits(give_up_s=5.0)


@pytest.fixture
def authority(tmp_path: Path) -> Callable[..., Files]:
    """Return a function that makes an authority's folder, and one that names files in it."""
    members = Members(("cav-1", "cav-2"), ("watch",))
    return lambda folder="certs", age_days=0: certificates(tmp_path / folder, members, age_days)


@pytest.fixture
def certs(authority: Any) -> Files:
    files: Files = authority()
    return files


async def test_a_vehicle_with_its_certificate_drives_and_gets_its_field(
    certs: Files, serve: Any, travel: Any, tmp_path: Path
) -> None:
    async with serve(tls=certs("server")) as server:
        tls = certs("vehicle-cav-1")
        record = await travel(server.address, tls=tls, field=None, fields=tmp_path / "mine")
    assert record.counts == {"acked": 6}


async def test_encryption_changes_no_byte_of_a_packet_or_picture(
    certs: Files, serve: Any, travel: Any
) -> None:
    async with serve() as server:
        plain = await travel(server.address)
    async with serve(tls=certs("server")) as server:
        secret = await travel(server.address, tls=certs("vehicle-cav-1"))
    for key in ("reconstruction_digest", "server_digest", "payload_bytes"):
        assert [line[key] for line in plain.lines] == [line[key] for line in secret.lines]


@pytest.mark.parametrize("name", ["vehicle-cav-2", "consumer-watch"])
async def test_a_vehicle_may_not_go_by_another_name_than_its_certificates(
    certs: Files, serve: Any, travel: Any, name: str
) -> None:
    async with serve(tls=certs("server")) as server:
        with pytest.raises(ProtocolError, match="'cav-1' is not whom its certificate names") as e:
            await travel(server.address, tls=certs(name))
    assert f"spiffe://rfedge/{name.replace('-', '/', 1)}" in str(e.value)


async def test_an_expired_vehicle_is_told_so_in_one_line(
    authority: Any, certs: Files, serve: Any, travel: Any, tmp_path: Path
) -> None:
    """Both ends know the authority that signed it, and trust another for the server."""
    old, new = authority("old", age_days=60)("vehicle-cav-1"), certs("server")
    both = tmp_path / "both.pem"
    both.write_bytes(old.authority.read_bytes() + new.authority.read_bytes())
    async with serve(tls=replace(new, authority=both)) as server:
        with pytest.raises(AccessDenied) as caught:
            await travel(server.address, tls=replace(old, authority=both))
    refused = f"{server.address} refuses {old.certificate}: certificate has expired; make new"
    assert str(caught.value).startswith(refused)


@pytest.mark.parametrize(
    ("server_has", "vehicle_has", "problem"),
    [
        ("old/server", "old/vehicle-cav-1", "is refused: certificate has expired"),
        (
            "certs/server",
            "foreign/vehicle-cav-1",
            r"certificate of .* is refused: .*foreign/ca\.pem",
        ),
        ("certs/vehicle-cav-2", "certs/vehicle-cav-1", "is refused: "),
        ("certs/server", None, "wants TLS; give --tls-cert"),
        (None, "certs/vehicle-cav-1", "speaks plaintext"),
    ],
    ids=["expired", "of another authority", "a vehicle's", "plaintext to TLS", "TLS to plaintext"],
)
async def test_a_server_that_is_not_trusted_gets_nothing_and_the_vehicle_says_why(
    authority: Any, serve: Any, travel: Any,
    server_has: str | None, vehicle_has: str | None, problem: str,
) -> None:  # fmt: skip
    def files(name: str | None) -> TlsFiles | None:
        if name is None:
            return None
        folder, _, name = name.partition("/")
        if folder not in made:
            made[folder] = authority(folder, age_days=60 if folder == "old" else 0)
        return made[folder](name)

    made: dict[str, Files] = {}
    async with serve(tls=files(server_has)) as server:
        with pytest.raises(AccessDenied, match=problem):
            await travel(server.address, tls=files(vehicle_has))


@pytest.mark.parametrize("wrong", ["expired", "authority", "host"])
async def test_what_a_refusal_says_to_do_helps(
    wrong: str, serve: Any, travel: Any, tmp_path: Path
) -> None:
    mine, theirs = tmp_path / "mine", tmp_path / "theirs"
    there = Members(("cav-2",) if wrong == "authority" else ("cav-1",), ("watch",))
    if wrong == "host":
        there = replace(there, hosts=("elsewhere.example",))
    files = certificates(theirs, there, age_days=60 if wrong == "expired" else 0)
    vehicle = certificates(mine, Members(("cav-1",), ()))("vehicle-cav-1")
    if wrong != "authority":
        vehicle = files("vehicle-cav-1")
    async with serve(tls=files("server")) as server:
        with pytest.raises(AccessDenied) as caught:
            await travel(server.address, tls=vehicle)
    said = str(caught.value)
    if "rfedge certs add" in said:
        CertsAdd(theirs, vehicles=("cav-1",), days=20).run()
    else:
        assert "rfedge certs init --replace" in said
        assert ("--hosts" in said) == (wrong == "host")
        CertsInit(theirs, replace=True).run()
    async with serve(tls=files("server")) as server:
        assert (await travel(server.address, tls=files("vehicle-cav-1"))).counts == {"acked": 6}


async def test_a_vehicle_of_another_authority_is_refused_by_the_server(
    authority: Any, certs: Files, serve: Any, travel: Any
) -> None:
    """It shows a foreign certificate, and trusts the right authority."""
    own = replace(authority("foreign")("vehicle-cav-1"), authority=certs("server").authority)
    async with serve(tls=certs("server")) as server:
        with pytest.raises(AccessDenied, match=r"refuses .*1\.pem: unable to get local issuer"):
            await travel(server.address, tls=own)


async def test_a_server_that_is_not_there_is_no_refusal(certs: Files, travel: Any) -> None:
    limits = AgentLimits(give_up_s=0.2)
    with pytest.raises(RfedgeError, match=r"no server welcomed this vehicle within 0\.2 s"):
        await travel("localhost:1", tls=certs("vehicle-cav-1"), limits=limits)


def test_a_certificate_that_is_good_has_no_problem(certs: Files) -> None:
    for name in ("vehicle-cav-1", "consumer-watch"):
        assert own_problem(certs(name)) == ""


@pytest.mark.parametrize("service", ["health", "watch", "edge"])
async def test_no_service_answers_without_a_certificate(
    certs: Files, serve: Any, service: str
) -> None:
    async with serve(tls=certs("server")) as server:
        ca = certs("server").authority.read_bytes()
        credentials = grpc.ssl_channel_credentials(ca)
        async with grpc.aio.secure_channel(str(server.address), credentials) as channel:
            if service == "health":
                stub = health_pb2_grpc.HealthStub(channel)
                call: Any = stub.Check(health_pb2.HealthCheckRequest())
            elif service == "watch":
                call = watch_call(channel)
            else:
                call = channel.stream_stream(STREAM_METHOD)()
            assert await call.code() is grpc.StatusCode.UNAVAILABLE


async def test_a_server_takes_up_new_certificates_and_open_connections_go_on(
    certs: Files, serve: Any, travel: Any, tmp_path: Path
) -> None:
    shutil.copytree(tmp_path / "certs", tmp_path / "before")
    before = TlsFiles(
        *(tmp_path / "before" / n for n in ("vehicle-cav-1.pem", "vehicle-cav-1.key", "ca.pem"))
    )
    health = health_pb2.HealthCheckRequest()
    async with serve(tls=certs("server")) as server, channel_to(server.address, before) as channel:
        await health_pb2_grpc.HealthStub(channel).Check(health)
        issued = certify(Members(("cav-1",)), datetime.now(UTC), days=30)
        write_certificates(tmp_path / "certs", issued, replace=True)
        assert (await travel(server.address, tls=certs("vehicle-cav-1"))).counts == {"acked": 6}
        with pytest.raises(RfedgeError):
            await travel(server.address, tls=before, limits=SOON)
        answer = await health_pb2_grpc.HealthStub(channel).Check(health)
        assert answer.status == health_pb2.HealthCheckResponse.SERVING


async def test_half_of_a_new_certificate_is_not_taken_up(
    certs: Files, serve: Any, travel: Any, tmp_path: Path
) -> None:
    async with serve(tls=certs("server")) as server:
        other = certify(Members(("cav-1",)), datetime.now(UTC), days=30)
        (tmp_path / "certs" / "server.pem").write_bytes(
            next(one.certificate for one in other if one.name == "server")
        )
        record = await travel(server.address, tls=certs("vehicle-cav-1"))
    assert record.counts == {"acked": 6}


def test_a_watcher_in_plaintext_is_told_what_is_missing(
    certs: Files, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server here is one handshake: what the watcher says does not need more."""
    monkeypatch.setattr("rfcore.wire.twin_client.CONNECT_S", 0.1)
    credentials = certs("server").server_credentials()
    server = grpc.server(None)
    port = server.add_secure_port("127.0.0.1:0", credentials)
    server.start()
    try:
        with pytest.raises(AccessDenied, match="wants TLS"):
            list(TwinClient(f"127.0.0.1:{port}").watch())
    finally:
        server.stop(None).wait()


@pytest.mark.parametrize("secured", [False, True])
async def test_a_link_whose_server_is_not_up_is_not_called_a_matter_of_tls(
    certs: Files, secured: bool
) -> None:
    tls = certs("vehicle-cav-1") if secured else None
    proxy = LinkProxy(LinkSettings("127.0.0.1:1"))
    address = await proxy.start()
    try:
        problem = await asyncio.to_thread(check_handshake, address, tls)
    finally:
        await proxy.stop()
    assert problem.startswith(f"something listens at {address} and closes every connection")
    assert "is the server behind it up?" in problem


def test_files_that_do_not_belong_together_are_refused_by_option(certs: Files) -> None:
    one, two = certs("vehicle-cav-1"), certs("vehicle-cav-2")
    with pytest.raises(InvalidInput, match=r"^tls_cert: .*no certificate and its unencrypted key"):
        replace(one, key=two.key)
    with pytest.raises(InvalidInput, match=r"^tls_ca: .* holds no certificate"):
        replace(one, authority=one.key)
    with pytest.raises(InvalidInput, match=r"^tls_key: .*No such file"):
        replace(one, key=Path("missing.key"))
    with pytest.raises(InvalidInput, match=r"^tls: .*belong together"):
        TlsFiles.of(one.certificate, one.key, None)
    assert TlsFiles.of(None, None, None) is None
