"""The commands of docs/how-to/runbook.md, on a small field, with real servers and a vehicle."""

import asyncio
import itertools
import os
import shlex
import shutil
from collections.abc import AsyncIterator, Iterable, Mapping
from contextlib import AsyncExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest

from cav_agent.config import AgentConfig, AgentLimits
from docs.pages import Page
from integration.conftest import serve, street, vehicle
from integration.test_envoy import Groups, part_of_drive
from lab.servers.envoy import CLUSTER
from mec_server.config import ServerConfig
from rfcore.errors import FieldFormatError, InvalidData, RfedgeError
from rfcore.program import parse_options
from rfcore.wire.conventions import VEHICLE
from rfcore.wire.tile_manifest import Ground, publish, read_publication
from rfcore.wire.tiles import Area
from rfcore.wire.v1 import field_pb2 as pb
from rfcore.wire.v1.field_pb2_grpc import FieldServiceStub
from rfedge.cli import parse
from rfedge.processes import command_of, service

__all__ = ["serve", "street", "vehicle"]

PAGE = Page("how-to/runbook.md")
SERVE, ROLL, CANARY, PUBLISH, *SHARE, EVERYWHERE, ROLLBACK, BACKUP, RESTORE = PAGE.blocks("sh")
PATIENT = AgentLimits(answer_s=60.0, stall_s=60.0)
"""A busy machine is not a server that is lost."""

GROUND = Ground(Area((-5.0, -5.0), (5.0, 5.0)), 0.0)
FRAMES = 6
COMPARED = 24
"""Pictures of each vehicle."""
MOST_MORE_BYTES = 1.02
"""From there on the page takes a version back."""


class Operator:
    """Types the lines of the page; ``127.0.0.1:PORT`` of the page is wherever there is a free one.

    Servers are processes, or in this one with ``serve``; vehicles are in this one.
    """

    def __init__(
        self, stack: AsyncExitStack, vehicle: Any, serve: Any = None, envoy_admin: str = ""
    ) -> None:
        self._envoy_admin = envoy_admin
        self.vehicles: list[Any] = []
        self.servers: list[Any] = []
        self._stack, self._vehicle, self._serve = stack, vehicle, serve
        self._addresses: dict[str, str] = {}

    async def types(self, block: str) -> None:
        """Run the lines of a block, one after another."""
        for line in block.splitlines():
            await self._line(line)

    async def _line(self, line: str) -> None:
        words = shlex.split(line.partition(" &")[0], comments=True)
        if words[0] == "rfedge":
            await asyncio.to_thread(parse(words[1:]).run)
        elif words[0] == "cav-agent":
            await self._drive(words[1:])
        elif words[0] == "mec-server":
            await self._start(words[1:], line.partition("echo $! > ")[2])
        else:
            line = line.replace("127.0.0.1:9901", self._envoy_admin)
            shell = await asyncio.create_subprocess_exec("bash", "-euc", line)
            assert await shell.wait() == 0, line
            if words[0] == "kill":
                await self._ended(line)

    async def _drive(self, words: list[str]) -> None:
        page = parse_options(AgentConfig, "cav-agent", words)
        changes = {
            "drive": page.drive, "fields": page.fields, "loop": page.loop, "report": page.report,
            "neighbours": tuple(self._addresses[place] for place in page.neighbours),
            "limits": PATIENT,
        }  # fmt: skip
        drive = self._vehicle(self._addresses[page.server], **changes)
        self.vehicles.append(await self._stack.enter_async_context(drive))

    async def _start(self, words: list[str], pid_file: str) -> None:
        page = parse_options(ServerConfig, "mec-server", words)
        if self._serve is not None:
            server = await self._stack.enter_async_context(self._serve(fields=page.fields))
            self._addresses[page.listen] = str(server.address)
        else:
            listen = self._addresses.get(page.listen, "127.0.0.1:0")
            words = [listen if word == page.listen else word for word in words]
            command = [*command_of("mec-server"), *words]
            process = service(f"server{len(self.servers)}", command, Path())
            server = await asyncio.to_thread(self._stack.enter_context, process)
            self._addresses[page.listen] = server.address
            Path(pid_file).write_text(str(server.process.pid))
        self.servers.append(server)

    async def _ended(self, line: str) -> None:
        """Wait until the server that was told to stop has ended: well, and by itself."""
        pid = int(Path(line.partition("cat ")[2].rstrip(")")).read_text())
        (stopped,) = (server for server in self.servers if server.process.pid == pid)
        assert await asyncio.to_thread(stopped.process.wait, 60) == 0


@pytest.fixture
def desk(street: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Go to a folder with what the page starts from: published fields, a drive, another field."""
    monkeypatch.chdir(tmp_path)
    Path("fields").mkdir()
    publish(Path("fields"), "street", street.store / "street.rff", GROUND, datetime.now(UTC))
    Path("drive").symlink_to(street.drive)
    Path("better.rff").symlink_to(street.other_store / "other.rff")


@pytest.fixture
async def stack() -> AsyncIterator[AsyncExitStack]:
    async with AsyncExitStack() as opened:
        yield opened


def every_result(vehicle: Any) -> set[str]:
    return {line["result"] for line in vehicle.lines()}


@pytest.mark.slow
@pytest.mark.usefixtures("desk")
async def test_servers_are_updated_one_after_another_without_a_lost_frame(vehicle, stack):
    operator = Operator(stack, vehicle)
    await operator.types(SERVE)
    (driving,) = operator.vehicles
    await driving.until(lambda: driving.acked() >= FRAMES)
    await operator.types(ROLL)
    moves = [driving.handovers(cause) for cause in ("server_lost", "tile")]
    assert moves[0] >= 1
    assert sum(moves) == 2, "away from the first, and back to it"
    there = driving.acked()
    await driving.until(lambda: driving.acked() >= there + FRAMES)
    lines = driving.lines()
    assert every_result(driving) == {"acked"}
    assert [line["index"] for line in lines] == [i % FRAMES for i in range(len(lines))]
    for line in lines:
        assert line["server_digest"] == line["reconstruction_digest"], "the same bytes"
        assert "render" in line["references"], "never a keyframe"


def bytes_a_picture(server: Any, since: Mapping[str, float]) -> float:
    """Return what the page's expression says of the tile `street`, of the pictures since then."""
    now = counted(server)
    return (now["payload_bytes"] - since["payload_bytes"]) / (now["pictures"] - since["pictures"])


def counted(server: Any) -> dict[str, float]:
    return {
        name: sum(
            sample.value
            for metric in server.registry.collect()
            for sample in metric.samples
            if sample.name == f"rfedge_server_tile_{name}_total"
            and sample.labels["tile"] == "street"
        )
        for name in ("payload_bytes", "pictures")
    }


@pytest.mark.usefixtures("desk")
async def test_a_canary_shows_that_bytes_rose_and_is_taken_back(street, vehicle, serve, stack):
    """The field that the page calls better is one of another place: bytes have to rise."""
    assert "rfedge_server_tile_payload_bytes_total" in PAGE.text
    operator = Operator(stack, vehicle, serve)
    await operator.types(CANARY)
    (canary,), (driving,) = operator.servers, operator.vehicles
    bytes_of = [await one_round(canary, driving, moved=0)]
    for moved, block in enumerate((PUBLISH, ROLLBACK), 1):
        await operator.types(block)
        await canary.take_up_fields()
        bytes_of.append(await one_round(canary, driving, moved))
    before, bad, after = bytes_of
    assert bad > MOST_MORE_BYTES * before
    assert after < bad / MOST_MORE_BYTES
    assert every_result(driving) == {"acked"}
    versions = {name: read_publication(Path(name)).tiles["street"] for name in ("canary", "fields")}
    assert (versions["canary"].current, len(versions["canary"].field_ids)) == (1, 2)
    assert versions["fields"].field_ids == (street.field_id,), "the others noticed nothing"


@pytest.mark.slow
@pytest.mark.usefixtures("desk")
async def test_a_share_of_a_tiles_vehicles_tries_a_field_behind_envoy_and_is_taken_back(
    street, vehicle, stack, tmp_path
):
    """The field that the page calls better is one of another place: bytes have to rise."""
    start, share, take_back = SHARE
    groups = await asyncio.to_thread(Groups, street, tmp_path, stack)
    shutil.rmtree("fields")
    Path("fields").symlink_to(tmp_path / "all")
    operator = Operator(stack, vehicle, envoy_admin=groups.envoy.admin)
    await operator.types(start)
    (canary,) = operator.servers
    groups.site[CLUSTER].setup.list_servers([canary.address], "canary")
    await asyncio.to_thread(groups.envoy.until, lambda seen: canary.address in seen)
    await operator.types(share)
    await canary_lists(groups.envoy.address, street.other_id)
    names = await names_by_choice(groups.envoy.address, street.other_id)
    assert 2 <= len(names[True]) <= 25, "10 of 100"
    driving = {}
    for tries in (True, False):
        drive = part_of_drive(street, tmp_path / f"drive-{tries}", 2)
        driving[tries] = await stack.enter_async_context(
            vehicle(
                groups.envoy.address, vehicle=names[tries][0], drive=drive, limits=PATIENT,
                fields=tmp_path / f"cached-{tries}", loop=True, report=tmp_path / f"{tries}.jsonl",
            )
        )  # fmt: skip
    for one in driving.values():
        await one.until(lambda one=one: one.acked() >= FRAMES)
    assert {canary.address, groups.address("east")} == {
        address for address, calls in groups.envoy.streams().items() if calls
    }
    assert driving[True].fields() == {f"{street.other_id}.rff"}
    assert driving[False].fields() == {f"{street.field_id}.rff"}
    tried = driving[True].lines()
    assert payload_bytes(tried) > 2 * payload_bytes(driving[False].lines())

    await operator.types(take_back)
    await driving[True].until(lambda: len(from_render_alone(driving[True], len(tried))) >= COMPARED)
    placed = await asyncio.to_thread(groups.envoy.until, lambda seen: sum(seen.values()) == 2)
    assert placed[groups.address("east")] == 2
    back = payload_bytes(from_render_alone(driving[True], len(tried))[:COMPARED])
    assert back < MOST_MORE_BYTES * payload_bytes(from_render_alone(driving[False], 0)[:COMPARED])
    assert all(every_result(one) == {"acked"} for one in driving.values())


def payload_bytes(lines: Any) -> float:
    """Return the mean payload of pictures."""
    return float(np.mean([line["payload_bytes"] for line in lines]))


def from_render_alone(driving: Any, begin: int) -> list[Any]:
    """Return the pictures from the first on, of those from number ``begin`` on, that was predicted
    from the field's render alone: two vehicles of one drive and field send the same bytes then."""
    lines = driving.lines()[begin:]
    return list(itertools.dropwhile(lambda line: line["references"] != ["render"], lines))


async def canary_lists(address: str, field_id: str) -> None:
    """Wait until some vehicle's list has the field: the canary has taken it up."""
    async with asyncio.timeout(60):
        while not (await names_by_choice(address, field_id))[True]:
            await asyncio.sleep(0.1)


async def names_by_choice(address: str, field_id: str) -> dict[bool, list[str]]:
    """Ask for the tiles as 100 vehicles; return those that are told of the field, and others."""
    names: dict[bool, list[str]] = {True: [], False: []}
    async with grpc.aio.insecure_channel(address) as channel:
        stub = FieldServiceStub(channel)
        for name in (f"cav-{number}" for number in range(100)):
            listed = await stub.ListFields(pb.ListFieldsRequest(), metadata=((VEHICLE, name),))
            names[field_id in {tile.field_id for tile in listed.tiles}].append(name)
    return names


async def one_round(server: Any, driving: Any, moved: int) -> float:
    """Wait until the vehicle has moved so often, and then for a round; return bytes a picture."""
    await driving.until(lambda: driving.handovers("tile") == moved)
    there, since = driving.acked(), counted(server)
    await driving.until(lambda: driving.acked() >= there + 2 * FRAMES)
    return bytes_a_picture(server, since)


def contents(folder: Path) -> dict[str, bytes]:
    files: Iterable[Path] = (path for path in folder.iterdir() if not path.name.startswith("."))
    return {path.name: path.read_bytes() for path in files}


@pytest.mark.usefixtures("desk")
async def test_what_is_published_is_backed_up_and_restored(street, stack, capsys):
    operator = Operator(stack, None)
    await operator.types(EVERYWHERE)
    published = contents(Path("fields"))
    await operator.types(BACKUP)
    assert capsys.readouterr().out.endswith("2 of 2 archives are whole\n")
    assert contents(Path("backup")) == published
    damage(Path("fields") / f"{street.field_id}.rff")
    Path("fields/tiles.json").write_text("{")
    with pytest.raises(FieldFormatError, match=r"tiles\.json"):
        parse(["field", "list", "fields", "--verify"]).run()
    await operator.types(RESTORE)
    assert contents(Path("fields")) == published


def damage(archive: Path) -> None:
    """Turn one bit; the length stays."""
    data = bytearray(archive.read_bytes())
    data[len(data) // 2] ^= 1
    archive.write_bytes(data)


@pytest.mark.parametrize(
    ("harm", "says"),
    [
        (lambda first, _: damage(first), "is damaged; copy"),
        (lambda first, _: os.truncate(first, 0), "is damaged; copy"),
        (lambda _, current: damage(current), "is damaged; copy"),
        (lambda _, current: current.unlink(), "is gone; copy"),
        (lambda first, _: first.with_name("tiles.json").unlink(), "publishes no tiles"),
    ],
    ids=["earlier damaged", "earlier empty", "current damaged", "current gone", "no manifest"],
)
@pytest.mark.usefixtures("desk")
async def test_a_bad_copy_is_told(street, stack, harm, says):
    await Operator(stack, None).types(EVERYWHERE)
    ids = street.field_id, street.other_id
    harm(Path(f"fields/{ids[0]}.rff"), Path(f"fields/{ids[1]}.rff"))
    with pytest.raises(RfedgeError, match=says) as told:
        parse(["field", "list", "fields", "--verify"]).run()
    assert isinstance(told.value, InvalidData)


@pytest.mark.usefixtures("desk")
async def test_an_earlier_version_may_be_gone(street, stack, capsys):
    await Operator(stack, None).types(EVERYWHERE)
    Path(f"fields/{street.field_id}.rff").unlink()
    parse(["field", "list", "fields", "--verify"]).run()
    out = capsys.readouterr().out
    assert f"{street.field_id}  gone" in out
    assert out.endswith("1 of 2 archives are whole\n")
