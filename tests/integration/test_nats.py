"""One twin over two servers and a real nats-server (Debian's, with JetStream)."""

import asyncio
import shutil
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Any

import nats
import pytest
from rich.console import Console
from structlog.testing import capture_logs

from cav_agent.config import PaceKind
from lab.servers import EvalScale
from lab.servers.cases import ScaleRow
from lab.servers.nats import NatsServer
from lab.servers.scale import run_scale
from live_server import until
from mec_server.config import NatsSettings
from mec_server.nats import NatsLink, fetch_object
from mec_server.twin.nats import PlaceRecords
from rfcore.errors import FieldFormatError, RfedgeError, UnknownField
from rfcore.wire.nats import (
    FIELDS_BUCKET,
    PLACES_BUCKET,
    NatsServers,
    VehicleLocation,
    header_bytes,
)
from rfcore.wire.tile_manifest import MANIFEST, Ground, publish
from rfcore.wire.tiles import Area
from rfcore.wire.twin import Departure, PictureEncoding, Subscription, TwinPicture
from rfedge.certs import Members, certify, write_certificates
from rfedge.results import read_result, rows_of
from rfedge.twin.nats_source import NatsPictures, NatsReader, NatsSource, TwinMessage
from rfedge.twin.scene import Board, TwinScene

pytestmark = pytest.mark.slow

EVERYWHERE = Ground(Area((-5.0, -5.0), (5.0, 5.0)), 0.0)
DEPLOY = Path(__file__).parents[2] / "deploy" / "nats"
CONNECTED = "rfedge_twin_nats_connected"


@pytest.fixture
def broker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.chdir(tmp_path)
    with NatsServer(Path("nats")) as running:
        yield running


class Seen:
    """Messages that a reader of all servers gets."""

    def __init__(self) -> None:
        self.messages: list[TwinMessage] = []
        self.connected: list[bool] = []

    def take(self, message: TwinMessage, _: VehicleLocation | None) -> None:
        self.messages.append(message)

    def say(self, connected: bool, _: str) -> None:
        self.connected.append(connected)

    def sessions(self, vehicle_id: str) -> list[str]:
        """Return whose pictures of a vehicle were shown, one after the other."""
        shown = [m for m in self.messages if isinstance(m, TwinPicture)]
        return [m.session_id for m in shown if m.vehicle_id == vehicle_id]


@asynccontextmanager
async def reading(servers: NatsServers | str) -> AsyncIterator[Seen]:
    seen = Seen()
    servers = NatsServers((servers,)) if isinstance(servers, str) else servers
    reader = NatsReader(servers, Subscription(), seen.take, seen.say)
    task = asyncio.create_task(reader.run())
    try:
        await until(lambda: seen.connected == [True])
        yield seen
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def named(broker: NatsServer, name: str) -> NatsSettings:
    return NatsSettings(broker.url, name)


async def on_nats(server: Any) -> None:
    await until(lambda: server.registry.get_sample_value(CONNECTED) == 1)


async def test_a_vehicle_that_moves_between_servers_is_shown_once_at_every_moment(
    broker: NatsServer, coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    async with (
        serve(nats=named(broker, "east")) as east,
        serve(nats=named(broker, "west")) as west,
        reading(broker.url) as seen,
        raw_vehicle(east.address) as before,
        raw_vehicle(west.address) as after,
    ):
        await on_nats(east)
        await on_nats(west)
        await before.greet(coded.hello)
        assert await before.told(coded.frames[0]) == ("ack", 0)
        await until(lambda: len(seen.messages) >= 1)
        old = seen.sessions("cav-raw")[0]

        await after.greet(coded.hello)
        assert await after.told(coded.frames[0]) == ("ack", 0)
        await until(lambda: seen.sessions("cav-raw")[-1] != old)
        moved = len(seen.messages)
        for number in (1, 2, 3):  # on both, the old one first
            assert await before.told(coded.frames[number]) == ("ack", number)
            assert await after.told(coded.frames[number]) == ("ack", number)
        await until(lambda: len(seen.messages) >= moved + 1)
        await before.farewell()
        assert await after.told(coded.frames[4]) == ("ack", 4)
        await until(lambda: _sequence(seen.messages[-1]) == 4)
        later = seen.messages[moved:]
        assert all(isinstance(message, TwinPicture) for message in later), "it never left"
        assert old not in [message.session_id for message in later]

        async with connected(broker) as client:
            bucket = await client.jetstream().key_value(PLACES_BUCKET)
            async with asyncio.timeout(30):
                while await _server_in(bucket) != "west":
                    await asyncio.sleep(0.05)
        await after.farewell()
        await until(lambda: seen.messages[-1] == Departure("cav-raw", "front"))


def _sequence(message: TwinMessage) -> int:
    return message.sequence if isinstance(message, TwinPicture) else -1


async def _server_in(bucket: Any) -> str:
    try:
        return VehicleLocation.decode((await bucket.get("cav-raw")).value).server
    except nats.js.errors.KeyNotFoundError:
        return ""


@asynccontextmanager
async def connected(broker: NatsServer) -> AsyncIterator[Any]:
    client = await nats.connect(broker.url)
    try:
        yield client
    finally:
        await client.close()


async def test_headers_count_against_the_limit_of_a_message(broker: NatsServer) -> None:
    async with connected(broker) as client:
        heard = await client.subscribe("subject")
        headers = {"Rfedge-Place": "a place", "Other": "more"}
        most = client.max_payload - header_bytes(headers)
        await client.publish("subject", bytes(most), headers=headers)
        assert len((await heard.next_msg(10)).data) == most
        await client.publish("subject", bytes(most + 1), headers=headers)
        await until(lambda: "maximum payload" in str(client.last_error).lower())


async def test_of_two_servers_that_write_a_vehicles_place_the_newer_session_stays(
    broker: NatsServer,
) -> None:
    async with connected(broker) as client:
        bucket = await client.jetstream().create_key_value(bucket="test")
        east, west = PlaceRecords(bucket), PlaceRecords(bucket)
        old = VehicleLocation("cav.1", "east", "s1", 1, 0, "", "ab" * 32)
        new = replace(old, server="west", session_id="s2", opened_time_ns=2)

        async def written() -> VehicleLocation:
            return VehicleLocation.decode((await bucket.get("cav=1")).value)

        for _ in range(2):
            await east.write({"cav.1": old})
            assert await written() == old
        for _ in range(2):
            await west.write({"cav.1": new})
            await east.write({"cav.1": old})
            assert await written() == new
        await east.write({})
        assert await written() == new, "the older one is not its to remove"
        await west.write({})
        with pytest.raises(nats.js.errors.KeyNotFoundError):
            await written()
        await east.write({"cav.1": old})
        assert await written() == old, "a key that was removed can be written again"


async def test_nats_is_restarted_under_load_the_twin_is_back_and_ingest_lost_nothing(
    broker: NatsServer, serve: Any, vehicle: Any, tmp_path: Path
) -> None:
    async with (
        serve(nats=named(broker, "east")) as east,
        serve(nats=named(broker, "west")) as west,
        reading(broker.url) as seen,
        vehicle(
            east.address, vehicle="cav-1", pace=PaceKind.REALTIME, rate=10.0, loop=True,
            report=tmp_path / "1.jsonl", fields=tmp_path / "mine1",
        ) as first,
        vehicle(
            west.address, vehicle="cav-2", pace=PaceKind.REALTIME, rate=10.0, loop=True,
            report=tmp_path / "2.jsonl", fields=tmp_path / "mine2",
        ) as second,
    ):  # fmt: skip
        both = {"cav-1", "cav-2"}
        await until(lambda: {message.vehicle_id for message in seen.messages} == both)
        for _ in range(2):
            broker.kill()
            await until(lambda: east.registry.get_sample_value(CONNECTED) == 0)
            had = [each.acked() for each in (first, second)]
            for each, acked in zip((first, second), had, strict=True):
                await each.until(lambda each=each, acked=acked: each.acked() >= acked + 3)
            seen.messages.clear()
            await asyncio.to_thread(broker.start)
            await until(lambda: {message.vehicle_id for message in seen.messages} == both)
        lines = [*first.lines(), *second.lines()]
        assert {line["result"] for line in lines} & {"lost", "nacked"} == set()
    assert [is_there for is_there, _ in groupby(seen.connected)] == [True, False] * 2 + [True]


async def test_a_server_whose_nats_is_down_serves_and_finds_it_when_it_comes(
    broker: NatsServer, coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    broker.kill()
    with capture_logs() as lines:
        async with serve(nats=named(broker, "east")) as server, raw_vehicle(server.address) as one:
            await one.greet(coded.hello)
            assert await one.told(coded.frames[0]) == ("ack", 0)
            await until(lambda: any("NATS not reached" in line["event"] for line in lines))
            await asyncio.to_thread(broker.start)
            async with reading(broker.url) as seen:
                await until(lambda: len(seen.messages) >= 1)
                assert seen.messages[0].vehicle_id == "cav-raw", "though nothing new was sent"
    assert len([line for line in lines if "NATS not reached" in line["event"]]) <= 2, "no flood"


async def test_a_server_fetches_a_field_that_its_manifest_names_and_another_has(
    broker: NatsServer, street: Any, serve: Any, tmp_path: Path
) -> None:
    for name in ("east", "west"):
        (tmp_path / name).mkdir()
    archive = street.store / "street.rff"
    publish(tmp_path / "east", "street", archive, EVERYWHERE, datetime(2026, 1, 1, tzinfo=UTC))
    shutil.copy(tmp_path / "east" / MANIFEST, tmp_path / "west" / MANIFEST)
    async with (
        serve(fields=tmp_path / "east", nats=named(broker, "east")),
        serve(fields=tmp_path / "west", nats=named(broker, "west")),
    ):
        fetched = tmp_path / "west" / f"{street.field_id}.rff"
        assert fetched.read_bytes() == archive.read_bytes()
        assert {path.name for path in (tmp_path / "west").iterdir()} == {MANIFEST, fetched.name}


async def test_a_field_that_is_not_what_it_is_called_is_refused(
    broker: NatsServer, street: Any, tmp_path: Path
) -> None:
    (tmp_path / "mine").mkdir()
    async with connected(broker) as client:
        with pytest.raises(UnknownField, match=f"{street.field_id} is not in NATS"):
            await fetch_object(client, street.field_id, tmp_path / "mine")
        objects = await client.jetstream().object_store(FIELDS_BUCKET)
        await objects.put(street.field_id, (street.other_store / "other.rff").read_bytes())
        with pytest.raises(FieldFormatError, match="not the field id"):
            await fetch_object(client, street.field_id, tmp_path / "mine")
    assert list((tmp_path / "mine").iterdir()) == []


async def test_a_field_whose_pieces_vanish_is_given_up_soon_and_comes_with_the_next_try(
    broker: NatsServer, street: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mec_server.nats.STALLED_S", 0.2)
    archive = street.store / "street.rff"
    async with connected(broker) as client:
        stored = client.jetstream()
        objects = await stored.create_object_store(FIELDS_BUCKET)
        put = await objects.put(street.field_id, archive.read_bytes())
        await stored.purge_stream(
            f"OBJ_{FIELDS_BUCKET}", subject=f"$O.{FIELDS_BUCKET}.C.{put.nuid}"
        )
        with pytest.raises(UnknownField, match="stopped after 0 bytes from NATS"):
            await fetch_object(client, street.field_id, tmp_path)
        await objects.put(street.field_id, archive.read_bytes())
        await fetch_object(client, street.field_id, tmp_path)
    assert (tmp_path / f"{street.field_id}.rff").read_bytes() == archive.read_bytes()


async def test_the_page_shows_pictures_and_field_of_all_servers(
    broker: NatsServer, coded: Any, street: Any, serve: Any, raw_vehicle: Any, tmp_path: Path
) -> None:
    scene = TwinScene(Board())
    source = NatsSource(NatsServers((broker.url,)), tmp_path / "fields", scene)
    task = asyncio.create_task(source.run())
    async with serve(nats=named(broker, "east")) as server, raw_vehicle(server.address) as one:
        await one.greet(coded.hello)
        await one.told(coded.frames[0])
        await until(lambda: ("cav-raw", "front") in scene.newest)
        await until(lambda: scene.field(street.field_id) is not None)
        assert scene.newest["cav-raw", "front"].picture[:2] == b"\xff\xd8"
        await one.farewell()
        await until(lambda: not scene.newest)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_a_thread_that_watches_gets_pictures_in_its_encoding_until_it_is_stopped(
    broker: NatsServer, coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    pictures = NatsPictures(NatsServers((broker.url,)))
    wanted = Subscription(frozenset({"cav-raw"}), PictureEncoding.I420)

    def watch() -> list[TwinMessage]:
        got = []
        for message in pictures.watch(wanted):
            got.append(message)
            if isinstance(message, Departure):
                pictures.stop()
        return got

    watching = asyncio.create_task(asyncio.to_thread(watch))
    async with serve(nats=named(broker, "east")) as server, raw_vehicle(server.address) as one:
        await one.greet(coded.hello)
        await one.told(coded.frames[0])
        sent = "rfedge_twin_nats_published_total"
        await until(
            lambda: (server.registry.get_sample_value(sent, {"encoding": "i420"}) or 0) >= 1
        )
        await one.farewell()
        got = await watching
    first = got[0]
    assert isinstance(first, TwinPicture)
    assert len(first.picture) == 76 * 52 * 3 // 2
    assert isinstance(got[-1], Departure)


async def test_a_nats_without_a_certificate_is_not_told_the_login(
    broker: NatsServer, tmp_path: Path
) -> None:
    login = tmp_path / "login"
    login.write_text("cav:secret")
    url = broker.url.replace("nats://", "tls://")
    told: list[str] = []
    link = NatsLink(NatsServers((url,), login), "test", lambda _, detail: told.append(detail))
    running = asyncio.create_task(link.run(lambda _: asyncio.sleep(60)))
    await until(lambda: told != [])
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    assert told == ["the server speaks plaintext; give it a certificate, or nats:// for none"]


async def test_the_deployed_configuration_lets_servers_publish_and_consumers_look(
    coded: Any, street: Any, serve: Any, raw_vehicle: Any, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    members = Members(("cav-1",), ("watch",), ("127.0.0.1",))
    certs = tmp_path / "certs"
    write_certificates(certs, certify(members, datetime.now(UTC), 1))
    for ending in ("pem", "key"):
        shutil.copy(certs / f"server.{ending}", certs / f"nats.{ending}")
    text = (DEPLOY / "nats.conf").read_text().replace("/var/lib/nats", str(tmp_path / "kept"))
    (certs / "nats.conf").write_text(text)
    logins = {}
    for user in ("server", "viewer"):
        monkeypatch.setenv(f"NATS_{user.upper()}_PASSWORD", f"{user}-secret")
        logins[user] = tmp_path / f"{user}.login"
        logins[user].write_text(f"{user}:{user}-secret\n")
    files = [certs / name for name in ("ca.pem", "consumer-watch.pem", "consumer-watch.key")]
    with NatsServer(tmp_path / "nats", certs / "nats.conf") as broker:
        url = broker.url.replace("nats://", "tls://")
        viewer = NatsServers((url,), logins["viewer"], *files)
        scene = TwinScene(Board())
        source = asyncio.create_task(NatsSource(viewer, tmp_path / "fields", scene).run())
        async with (
            serve(nats=NatsSettings(url, "east", logins["server"], *files)) as server,
            reading(viewer) as seen,
            raw_vehicle(server.address) as one,
        ):
            await one.greet(coded.hello)
            await one.told(coded.frames[0])
            await until(lambda: len(seen.messages) >= 1)
            await until(lambda: scene.field(street.field_id) is not None)
            await until(lambda: ("cav-raw", "front") in scene.newest)
            refused = await refused_to(viewer, "rfedge.twin.jpeg.cav-raw.front")
            assert "permissions violation for publish" in refused.lower()
        source.cancel()
        await asyncio.gather(source, return_exceptions=True)


async def refused_to(servers: NatsServers, subject: str) -> str:
    """Publish as a consumer; return what NATS says to that."""
    said: list[str] = []

    async def told(error: Exception) -> None:
        said.append(str(error))

    client = await nats.connect(
        list(servers.urls), error_cb=told, tls=servers.tls_context(), **servers.credentials()
    )
    try:
        await client.publish(subject, b"forged")
        await client.flush()
        await until(lambda: said != [])
    finally:
        await client.close()
    return said[0]


@pytest.mark.nightly
@pytest.mark.timeout(300)
def test_the_case_is_measured_with_servers_and_vehicles_as_processes(
    street: Any, tmp_path: Path
) -> None:
    """Times depend on the machine, and are left to the figures."""
    job = EvalScale(
        vehicles=4, servers=2, rounds=1, hz=2.0, size=None, pairs=0, seconds=1.0,
        field=street.store / "street.rff", drive=street.drive, config=DEPLOY,
        work=tmp_path / "work", out=tmp_path / "scale.json", no_envoy=True, nats=True,
    )  # fmt: skip
    try:
        run_scale(job, Console(quiet=True))
    except RfedgeError as error:
        if not str(error).startswith("not held: "):  # a bound in time, on a busy machine
            raise
    back, lost, way = rows_of(ScaleRow, read_result(job.out)["rows"])
    assert 0 < back.measured < 60
    assert way.measured > 0
    assert lost.held, lost
