"""Every panel of every dashboard shows something of a live run.

Server, link, vehicle and consumer run as commands; Debian's Prometheus scrapes them with the
configuration that is deployed, only more often. The clock is looked at only to bound the wait.
"""

import asyncio
import json
import shutil
import subprocess
import urllib.parse
import urllib.request
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from mec_server.tile_history import LEARNING, Learnt, TileHistory
from rfcore.wire.tile_manifest import Ground, publish
from rfedge.processes import command_of

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy" / "prometheus"
DASHBOARDS = sorted((ROOT / "deploy/grafana/dashboards").glob("*.json"))
PATIENCE_S = 90.0

pytestmark = [pytest.mark.slow, pytest.mark.prometheus]


def expressions() -> dict[str, str]:
    """Return every query by panel, with Grafana's variables filled in."""
    filled = {}
    for path in DASHBOARDS:
        for panel in json.loads(path.read_text())["panels"]:
            for target in panel["targets"]:
                expr = target["expr"].replace("$instance", ".*")
                expr = expr.replace("$__rate_interval", "10s").replace("$__range", "1m")
                filled[f"{path.stem} / {panel['title']} / {target['refId']}"] = expr
    return filled


def configuration(folder: Path, targets: dict[str, int]) -> None:
    """Write the deployed configuration, once a second instead of every five."""
    for name in ("prometheus.yml", "rules.yml"):
        text = (DEPLOY / name).read_text()
        text = text.replace("_interval: 5s", "_interval: 1s").replace(
            "interval: 5s", "interval: 1s"
        )
        (folder / name).write_text(text)
    (folder / "targets").mkdir()
    for job, port in targets.items():
        entry = [{"targets": [f"127.0.0.1:{port}"]}]
        (folder / "targets" / f"{job}.json").write_text(json.dumps(entry))


def ask(port: int, expr: str) -> list[Any]:
    """Return the result of an instant query; empty while there is none."""
    query = urllib.parse.urlencode({"query": expr})
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/v1/query?{query}") as answer:
        body = json.load(answer)
    assert body["status"] == "success", body
    values = body["data"]["result"]
    return [value for value in values if value["value"][1] != "NaN"]


class Command:
    """A command of ours that runs until the test is over, and what it says on stderr."""

    def __init__(self, name: str, process: asyncio.subprocess.Process) -> None:
        self._name = name
        self._process = process
        self._lines: list[str] = []

    async def says(self, find: Callable[[str], Any]) -> Any:
        """Return the first true value of ``find`` of a line."""
        assert self._process.stderr is not None
        while line := (await self._process.stderr.readline()).decode():
            self._lines.append(line)
            if found := find(line):
                return found
        pytest.fail(f"{self._name} ended:\n{''.join(self._lines)}")

    async def drain(self) -> None:
        """Read on, so that the command never waits for us."""
        assert self._process.stderr is not None
        while await self._process.stderr.readline():
            pass


def metrics_port(line: str) -> int | None:
    """Return the port a command's log line announces for its metrics."""
    if line.startswith("{"):
        said = json.loads(line)
        return said["port"] if said["event"] == "metrics" else None
    mark = "metrics on port "
    return int(line.partition(mark)[2]) if mark in line else None


@asynccontextmanager
async def command(*words: object) -> AsyncIterator[Command]:
    start = [str(word) for word in words]
    process = await asyncio.create_subprocess_exec(
        *start, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    try:
        yield Command(start[0], process)
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


async def written(path: Path) -> str:
    while not path.exists():
        await asyncio.sleep(0.05)
    return path.read_text().strip()


def tile_that_learnt(street: Any, folder: Path) -> Path:
    """Return a folder that publishes the street; its server has learnt of it before."""
    shutil.copytree(street.store, folder / "fields")
    archive = street.store / "street.rff"
    publish(folder / "fields", "west", archive, Ground(), datetime(2026, 1, 1, tzinfo=UTC))
    learnt = Learnt(street.field_id, "h17", street.field_id, 2, 20.0, 1_767_290_400_000, True)
    history = folder / "saved" / LEARNING / "tiles.json"
    history.parent.mkdir(parents=True)
    history.write_text(json.dumps({"west": asdict(TileHistory((learnt,)))}))
    return folder / "fields"


@asynccontextmanager
async def street_in_motion(street: Any, folder: Path) -> AsyncIterator[dict[str, int]]:
    """A server, a link, a vehicle and a consumer; yields the port of the metrics by job."""
    async with AsyncExitStack() as stack:
        start = lambda *words: stack.enter_async_context(command(*words))  # noqa: E731
        ports = {}
        server = await start(
            *command_of("mec-server"), "--fields", tile_that_learnt(street, folder),
            "--listen", "127.0.0.1:0", "--metrics-port", 0, "--ready-file", folder / "server",
            "--record", folder / "saved", "--learn",
        )  # fmt: skip
        ports["mec-server"] = await server.says(metrics_port)
        address = await written(folder / "server")
        link = await start(
            *command_of("rfedge"), "link", "--to", address, "--metrics-port", 0,
            "--profile", ROOT / "samples/links/drive.toml", "--ready-file", folder / "link",
        )  # fmt: skip
        ports["link"] = await link.says(metrics_port)
        agent = await start(
            *command_of("cav-agent"), "--server", await written(folder / "link"), "--loop",
            "--drive", street.drive, "--fields", street.store,
            "--rate", 5, "--effort", "fast", "--localise", "--metrics-port", 0,
            "--allow-recording",
        )  # fmt: skip
        ports["cav-agent"] = await agent.says(metrics_port)
        watcher = await start(*command_of("rfedge"), "watch", address, "--encoding", "jpeg")
        reading = [
            asyncio.create_task(program.drain()) for program in (server, link, agent, watcher)
        ]
        yield ports
        for task in reading:
            task.cancel()


async def test_every_query_of_every_panel_has_data(
    street: Any, prometheus: str, free_port: int, tmp_path: Path
) -> None:
    async with street_in_motion(street, tmp_path) as ports:
        configuration(tmp_path, ports)
        serve = (
            prometheus, f"--config.file={tmp_path / 'prometheus.yml'}",
            f"--storage.tsdb.path={tmp_path / 'tsdb'}",
            f"--web.listen-address=127.0.0.1:{free_port}",
        )  # fmt: skip
        async with command(*serve) as running:
            await running.says(lambda line: "ready to receive web requests" in line)
            reading = asyncio.create_task(running.drain())
            missing = expressions()
            clock = asyncio.get_running_loop().time
            deadline_s = clock() + PATIENCE_S
            while missing and clock() < deadline_s:
                for name, expr in list(missing.items()):
                    if await asyncio.to_thread(ask, free_port, expr):
                        del missing[name]
                await asyncio.sleep(0.5)
            reading.cancel()
    assert not missing, "panels without data:\n" + "\n".join(missing)
