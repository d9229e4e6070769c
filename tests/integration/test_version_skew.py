"""Old vehicles at new servers and new vehicles at old servers: earlier releases, from history.

``previous_release.txt`` names their commits. Each is compiled here once, in a minute or two.
"""

import asyncio
import json
import signal
from contextlib import AsyncExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from cav_agent.config import AgentLimits
from history import START_OLD, code_of, git
from integration.test_agents_live_on import running_command, until
from rfcore.codec.h264.config import Coder, CoderSettings
from rfcore.wire.publish import Ground, publish
from rfcore.wire.tiles import Area

PREVIOUS = Path(__file__).with_name("previous_release.txt")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
VEHICLES = 3
DRAIN = ("--drain-hold-s", "0.5")
PATIENT = AgentLimits(answer_s=60.0)
"""A busy machine is not a server that is lost."""


@dataclass(frozen=True)
class Release:
    """An earlier release: its code, compiled, and what it knows."""

    code: Path
    coding: CoderSettings
    """What a vehicle may send to its servers."""
    agent_options: tuple[str, ...]
    """The same for its own vehicles."""
    drain: tuple[str, ...] = ()
    """By which its servers ask vehicles to leave before they stop."""


def release_commits() -> list[str]:
    """Return the commits, oldest first; skip only where history cannot be had without network."""
    lines = PREVIOUS.read_text().splitlines()
    commits = [line for line in lines if line and not line.startswith("#")]
    if git("rev-parse", "--git-dir").returncode != 0:
        pytest.skip("this is no git checkout: there is no history to build from")
    shallow = git("rev-parse", "--is-shallow-repository").stdout.strip() == b"true"
    for commit in commits:
        if git("cat-file", "-e", f"{commit}^{{commit}}").returncode == 0:
            continue
        if shallow:
            pytest.skip(f"the history is shallow and lacks {commit}: git fetch --unshallow")
        raise AssertionError(f"{PREVIOUS.name} names {commit}, which is not in this history")
    return commits


@pytest.fixture(scope="module")
def previous(tmp_path_factory: pytest.TempPathFactory) -> Release:
    """Return the previous release."""
    code = code_of(release_commits()[-1], tmp_path_factory.mktemp("previous"))
    return Release(code, CoderSettings(effort="fast"), ("--effort", "fast"), DRAIN)


@pytest.fixture(scope="module")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> Release:
    """Return the oldest release that must be understood."""
    code = code_of(release_commits()[0], tmp_path_factory.mktemp("earlier"))
    x264 = CoderSettings(coder=Coder.X264, preset="ultrafast")
    return Release(code, x264, ("--preset", "ultrafast"))


@pytest.fixture(scope="module", params=["previous", "earlier"])
def release(request: pytest.FixtureRequest) -> Release:
    """Return each of them."""
    found: Release = request.getfixturevalue(request.param)
    return found


def acked(report: Path) -> int:
    if not report.exists():
        return 0
    lines = report.read_text().split("\n")[:-1]
    good = [json.loads(line) for line in lines if json.loads(line)["result"] == "acked"]
    assert all(line["server_digest"] == line["reconstruction_digest"] for line in good)
    return len(good)


def module_of(release: Release, folder: Path) -> tuple[object, ...]:
    """Return how to run a module of a release, its name and arguments left out."""
    starter = folder / "start_old.py"
    starter.write_text(START_OLD)
    return starter, release.code


@pytest.mark.parametrize(("server_is_old", "agent_is_old"), [(True, False), (False, True)])
async def test_earlier_releases_are_understood(
    release: Release, street: Any, tmp_path: Path, server_is_old: bool, agent_is_old: bool
) -> None:
    """A field is fetched, and frames are acknowledged with the digests that the vehicle expects."""

    def start(is_old: bool, module: str, *arguments: object) -> Any:
        program = module_of(release, tmp_path) if is_old else ("-m",)
        return running_command(tmp_path / f"{module}.log", *program, module, *arguments)

    ready, report = tmp_path / "ready", tmp_path / "report.jsonl"
    fields = tmp_path / "fields"
    fields.mkdir()
    served = ("--fields", street.store, "--listen", "127.0.0.1:0", "--ready-file", ready)
    async with start(server_is_old, "mec_server", *served, "--decoder", "in-process") as server:
        await until(lambda: ready.exists() or server.returncode is not None)
        assert server.returncode is None, (tmp_path / "mec_server.log").read_text()
        driven = (
            "--server",
            ready.read_text().strip(),
            "--drive",
            street.drive,
            "--fields",
            fields,
        )
        coder = release.agent_options if agent_is_old else options_of(release.coding)
        more = (*coder, "--pace", "lockstep", "--report", report)
        async with start(agent_is_old, "cav_agent", *driven, *more) as agent:
            await until(lambda: agent.returncode is not None)
            assert agent.returncode == 0, (tmp_path / "cav_agent.log").read_text()
    assert acked(report) == 6
    assert (fields / f"{street.field_id}.rff").exists()


def options_of(coding: CoderSettings) -> tuple[str, ...]:
    if coding.coder is Coder.OWN:
        return ("--effort", coding.effort)
    return ("--coder", "x264", "--preset", coding.preset)


class Site:
    """Two servers of one tile, each first of an earlier release and then of this one."""

    def __init__(self, release: Release, street: Any, folder: Path, stack: AsyncExitStack) -> None:
        self._release, self._folder, self._stack = release, folder, stack
        self._running: dict[str, Any] = {}
        self._published = folder / "published"
        self._published.mkdir()
        ground = Ground(Area((-5.0, -5.0), (5.0, 5.0)), 0.0)
        archive, now = street.store / "street.rff", datetime(2026, 1, 1, tzinfo=UTC)
        publish(self._published, "street", archive, ground, now)

    async def start_old(self, name: str) -> str:
        """Start a server of the earlier release at a free port; return its address."""
        program = module_of(self._release, self._folder)
        return await self._start(name, "127.0.0.1:0", *program, "mec_server", *self._release.drain)

    async def update(self, name: str, address: str) -> None:
        """Have a server end, and start one of this release in its place."""
        self._running[name].send_signal(signal.SIGTERM)
        assert await asyncio.wait_for(self._running[name].wait(), 60) == 0, self._log(name)
        assert await self._start(name, address, "-m", "mec_server", *DRAIN) == address

    async def _start(self, name: str, listen: str, *program: object) -> str:
        ready = self._folder / f"{name}.ready"
        ready.unlink(missing_ok=True)
        where = ("--fields", self._published, "--listen", listen, "--ready-file", ready)
        command = running_command(
            self._folder / f"{name}.log", *program, *where, "--decoder", "in-process"
        )
        server = await self._stack.enter_async_context(command)
        await until(lambda: ready.exists() or server.returncode is not None)
        assert server.returncode is None, self._log(name)
        self._running[name] = server
        return ready.read_text().strip()

    def _log(self, name: str) -> str:
        return (self._folder / f"{name}.log").read_text()


async def test_servers_are_replaced_by_this_release_one_by_one_under_load(
    release: Release, street: Any, vehicle: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Servers that hand over lose nothing; vehicles of one that cannot lose what is under way."""
    monkeypatch.setattr("cav_agent.frames_in_flight.STALL_S", PATIENT.answer_s)
    async with AsyncExitStack() as stack:
        site = Site(release, street, tmp_path, stack)
        addresses = [await site.start_old(name) for name in ("a", "b")]
        driving = [
            await stack.enter_async_context(
                vehicle(
                    addresses[i % 2], vehicle=f"cav-{i}", neighbours=(addresses[1 - i % 2],),
                    loop=True, fields=tmp_path / f"fields{i}", report=tmp_path / f"{i}.jsonl",
                    coding=release.coding, limits=PATIENT,
                )
            )
            for i in range(VEHICLES)
        ]  # fmt: skip
        await all_go_on(driving)
        for name, address in zip(("a", "b"), addresses, strict=True):
            await site.update(name, address)
            await all_go_on(driving)
        reports = [one.lines() for one in driving]
    for lines in reports:
        ended = [line["result"] for line in lines if line["result"] != "acked"]
        streams = len({line["epoch"] for line in lines})
        assert streams >= 2, "every server had vehicles when it was replaced"
        if release.drain:
            assert ended == []
        else:
            assert set(ended) <= {"lost", "dropped"}
            assert ended.count("lost") <= streams - 1, "the one picture under way to each server"
        for line in lines:
            if line["result"] == "acked":
                assert line["server_digest"] == line["reconstruction_digest"], "the same bytes"
                assert "render" in line["references"], "never a keyframe"


async def all_go_on(driving: list[Any]) -> None:
    """Wait until every vehicle had four more pictures acknowledged."""
    before = [one.acked() for one in driving]
    for one, had in zip(driving, before, strict=True):
        await one.until(lambda one=one, had=had: one.acked() >= had + 4)
