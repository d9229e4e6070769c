"""A server under compose's limits, bystanders at street size, and what an attack did to them.

The shipped field, 640x360 at 10 Hz, coded beforehand (``attack.bystander``): a vehicle computes on
a machine of its own. The bystander's latencies during the attack are compared with calm ones and
with a *control*: the same attacker, as long, aimed at a decoy that reads everything and answers
nothing. The three take turns, so that what else the machine does meets all of them. A consumer
watches all the while. Newcomers have an attack of their own afterwards, as those who come would
disturb the bystander. Once it has prepared what it sends, the attacker has a processor while it is
idle (``leave_the_processor``), and the decoy likewise: theirs would be another machine. Control
groups (v1 or v2) need root, no docker.
"""

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from attack.attacker import DEFERRED, LOG_LINES, OPEN_FILES, PROCESSOR_S
from attack.bystander import NAME, NEWCOMER
from attack.control_group import SERVER, ControlGroup
from attack.target import VEHICLE, Target
from live_server import tls_options
from machine import MEASURED_AGAIN
from rfedge.certs import Members, certify, write_certificates
from scoreboard import Figures, Scoreboard

ROOT = Path(__file__).parents[2]
FIELD = ROOT / "samples/fields/street.rff"
ATTACKER, BYSTANDER = ("-m", "attack.attacker"), ("-m", "attack.bystander")
(MAX_FIELD,) = (word for word in SERVER["command"] if word.startswith("--max-field-gb="))
ROUNDS = 2
"""Number of turns of calm, control and attack."""
ALLOWANCE_MS = 10.0
SCRAPE_S = 5.0
REPORT_S = 30.0
"""Within which the bystander knows how a picture ended: it loses its stream, and opens another."""
WATCHED_S = 5.0
"""After which a picture that the vehicle knows to be shown and the consumer has not is missed."""
CALM_NEWCOMERS = 3
STOPPED_S = "seconds for which the kernel stopped the server's group"
BOARD = Scoreboard("attacks", "make test-attack")
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT / "tests")}


def pytest_addoption(parser: pytest.Parser) -> None:
    BOARD.options(parser)
    parser.addoption(
        "--attack-s", type=float, default=8.0, help=f"how long each attack lasts, in {ROUNDS} parts"
    )


def pytest_configure(config: pytest.Config) -> None:
    BOARD.open(config)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    BOARD.leave_out(items, here, config.hook.pytest_deselected)
    for item in items:
        if here in item.path.parents and "scene" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.attack)
            item.add_marker(pytest.mark.slow)
            item.add_marker(MEASURED_AGAIN)


async def appears(path: Path, process: subprocess.Popen[bytes], log: Path) -> str:
    """Return what ``path`` holds, once it is there."""
    async with asyncio.timeout(60):
        while not (path.exists() and path.read_text().strip()):
            assert process.poll() is None, log.read_text()
            await asyncio.sleep(0.02)
    return path.read_text().strip()


@dataclass
class Scene(Figures):
    """Everything that runs, and the row in the making."""

    folder: Path
    group: ControlGroup
    server: subprocess.Popen[bytes]
    target: Target
    decoy: Target
    drive: Path
    attack_s: float
    start: Callable[..., subprocess.Popen[bytes]]
    """Starts a process, by its log's name and its command."""
    name: str = ""
    what: str = ""
    identity: str = ""
    p99_ms: float = 0.0
    consumer_p99_ms: float = 0.0
    newcomer_s: float | None = None
    """Time of the slowest newcomer under attack; None: one was never shown, or none came."""

    def about(self, name: str, what: str, identity: str) -> None:
        """Say what is done, and with whose certificate."""
        self.name, self.what, self.identity = name.replace("_", " "), what, identity

    def row(self) -> dict[str, Any]:
        """Return the row of the scoreboard."""
        return {
            "attack": f"{self.name}: {self.what}",
            "identity": self.identity,
            **self.texts(),
            "bystander_p99_ms": round(self.p99_ms, 1),
            "consumer_p99_ms": round(self.consumer_p99_ms, 1),
            "newcomer_s": None if self.newcomer_s is None else round(self.newcomer_s, 2),
            "held": self.held,
        }

    async def begin(self, role: str) -> None:
        """Start a bystander, and wait for the first line of its report."""
        drive = () if role == "consumer" else (self.drive,)
        told = (role, self.target.address, self.target.certificates, self._report(role))
        process = self.start(role, *BYSTANDER, *told, *drive)
        await appears(self._report(role), process, self.folder / f"{role}.log")

    def _report(self, role: str) -> Path:
        return self.folder / f"{role}.jsonl"

    def _reported(self, role: str) -> list[dict[str, Any]]:
        """Return what a bystander has written down so far."""
        return [json.loads(line) for line in self._report(role).read_text().split("\n")[:-1]]

    async def _after(self, role: str, key: str, end_s: float) -> list[dict[str, Any]]:
        """Return what a bystander wrote down, once it has come to what began after a moment."""
        async with asyncio.timeout(REPORT_S + end_s - time.time()):
            while not (lines := self._reported(role)) or lines[-1][key] / 1e9 <= end_s:
                await asyncio.sleep(0.05)
        return lines

    async def _lines(self, begin_s: float, end_s: float) -> list[dict[str, Any]]:
        """Return the bystander's pictures that were captured in a time, once all have ended.

        ``watched_ms``: how old each was when the consumer had it, None if it never had.
        """
        lines = await self._after("vehicle", "capture_time_ns", end_s)
        within = [x for x in lines if begin_s <= x["capture_time_ns"] / 1e9 <= end_s]
        shown = {x["capture_time_ns"] for x in within if x["result"] == "acked"}
        until_s = time.monotonic() + WATCHED_S
        while True:
            ages_ms = {x["capture_time_ns"]: x["age_ms"] for x in self._reported("consumer")}
            if shown <= ages_ms.keys() or time.monotonic() > until_s:
                break
            await asyncio.sleep(0.05)
        return [x | {"watched_ms": ages_ms.get(x["capture_time_ns"])} for x in within]

    async def newcomers(self, attack: str) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Return those that came before an attack of its own, and those that came during it.

        The attack goes on until the last of these was shown, or left without.
        """
        await self.begin("newcomer")
        async with asyncio.timeout(60):
            while len(self._reported("newcomer")) < CALM_NEWCOMERS:
                await asyncio.sleep(0.05)
        calm_s = time.time()
        async with self._attacking(attack, self.target):
            began_s = time.time()
            lines = await self._after("newcomer", "began_ns", began_s + self.attack_s / ROUNDS)
        calm = [x for x in lines if x["began_ns"] / 1e9 < calm_s][:CALM_NEWCOMERS]
        return calm, [x for x in lines if x["began_ns"] / 1e9 >= began_s]

    def counters(self) -> Counter[str]:
        """Return what the server has counted of everything so far, its log's lines included.

        Nothing of a server that does not answer.
        """
        lines = (self.folder / "server.log").read_bytes().count(b"\n")
        counted = Counter({LOG_LINES: lines, DEFERRED: kernel_count("TCPDeferAcceptDrop")})
        counted.update({STOPPED_S: self.group.stopped_s()})
        with suppress(OSError):
            counted.update(scraped(self.target.metrics))
        return counted

    async def phase(self, attack: str = "", target: Target | None = None) -> "Phase":
        """Let a while pass, attacking or not; return what the bystander had of it."""
        before = await asyncio.to_thread(self.counters)
        async with AsyncExitStack() as stack:
            attacker = None
            if target is not None:
                attacker = await stack.enter_async_context(self._attacking(attack, target))
            most_bytes, most_files, began_s, lasts_s = 0, 0, time.time(), self.attack_s / ROUNDS
            before_s = processor_s(self.server.pid)
            until_s = time.monotonic() + lasts_s
            while time.monotonic() < until_s and self.server.poll() is None:
                most_bytes = max(most_bytes, self.group.memory_bytes())
                most_files = max(most_files, open_files(self.server.pid))
                if attacker is not None and attacker.poll() is not None:
                    pytest.fail((self.folder / "attacker.log").read_text())
                await asyncio.sleep(0.05)
            end_s, worked_s = time.time(), processor_s(self.server.pid) - before_s
            attacked_s = 0.0 if attacker is None else processor_s(attacker.pid)
        lines = await self._lines(began_s, end_s)
        grown = await asyncio.to_thread(self.counters)
        grown.subtract(before)
        grown.update({OPEN_FILES: most_files, PROCESSOR_S: worked_s})
        return Phase(lines, most_bytes, end_s - began_s, worked_s, attacked_s, grown)

    @asynccontextmanager
    async def _attacking(
        self, attack: str, target: Target
    ) -> AsyncIterator[subprocess.Popen[bytes]]:
        """Attack from a process of its own, from when it has begun until the block is left."""
        begun = self.folder / "begun"
        begun.unlink(missing_ok=True)
        seconds, aim = str(self.attack_s + 60), json.dumps(asdict(target))
        attacker = self.start("attacker", *ATTACKER, attack, seconds, aim, begun)
        try:
            await appears(begun, attacker, self.folder / "attacker.log")
            yield attacker
        finally:
            attacker.kill()
            attacker.wait()


def processor_s(pid: int) -> float:
    """Return the processor time of a process so far; what it was if it has ended."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(stat[11]) + int(stat[12])) / TICKS_PER_S


def open_files(pid: int) -> int:
    """Return how many descriptors a process has; 0 if it has ended."""
    with suppress(OSError):
        return sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
    return 0


def kernel_count(name: str) -> int:
    """Return what the kernel has counted of TCP under a name (netstat -s)."""
    names, values = (
        line.split()
        for line in Path("/proc/net/netstat").read_text().splitlines()
        if line.startswith("TcpExt:")
    )
    return int(dict(zip(names, values, strict=True))[name])


def scraped(metrics: str) -> dict[str, float]:
    """Return the counters at HOST:PORT, as ``Effect.counter`` names them; raise ``OSError``."""
    with urlopen(f"http://{metrics}/metrics", timeout=SCRAPE_S) as answer:
        text = answer.read().decode()
    families = text_string_to_metric_families(text)
    return {
        f"{sample.name}{{{' '.join(label for _, label in sorted(sample.labels.items()))}}}": value
        for family in families
        if family.type == "counter"
        for sample in family.samples
        for value in [sample.value]
    }


@dataclass(frozen=True)
class Phase:
    """The bystander's pictures of a while, the most memory the server's group had, for how long
    of ``lasted_s`` the server had a processor, and for how long the attacker had had one.

    ``grown``: by how much the server's counters grew (``Effect``)."""

    lines: list[dict[str, Any]]
    most_bytes: int
    lasted_s: float
    worked_s: float
    attacked_s: float
    grown: Counter[str]

    def __add__(self, other: "Phase") -> "Phase":
        """Return both as one."""
        return Phase(
            self.lines + other.lines,
            max(self.most_bytes, other.most_bytes),
            self.lasted_s + other.lasted_s,
            self.worked_s + other.worked_s,
            self.attacked_s + other.attacked_s,
            self.grown + other.grown,
        )

    @property
    def p99_ms(self) -> float:
        """Return the 99th percentile of the latencies of what was delivered."""
        return p99_of([x["latency_ms"] for x in self.lines if x["result"] == "acked"])

    @property
    def consumer_p99_ms(self) -> float:
        """Return the 99th percentile of the ages at the consumer of what it was sent."""
        return p99_of([x["watched_ms"] for x in self.lines if x["watched_ms"] is not None])

    @property
    def missed(self) -> int:
        """Return how many pictures were shown at the server and never came to the consumer."""
        return sum(x["result"] == "acked" and x["watched_ms"] is None for x in self.lines)

    @property
    def cores(self) -> float:
        """Return how many processors the server kept busy."""
        return self.worked_s / self.lasted_s

    def count(self, *results: str) -> int:
        """Return how many pictures ended so."""
        return sum(x["result"] in results for x in self.lines)

    @property
    def told(self) -> str:
        """Return how its pictures ended: "80 acked, 1 lost unanswered"."""
        ends = Counter(" ".join(filter(None, (x["result"], reason(x)))) for x in self.lines)
        return ", ".join(f"{count} {end}" for end, count in sorted(ends.items()))


def p99_of(values_ms: list[float]) -> float:
    """Return the 99th percentile; a minute if there is nothing: all that time nothing came."""
    return float(np.percentile(values_ms, 99)) if values_ms else 60e3


def reason(line: dict[str, Any]) -> str:
    return "" if line["reason"] == "none" else str(line["reason"])


@pytest.fixture
def certificates(tmp_path: Path) -> Path:
    members = Members((NAME, NEWCOMER, VEHICLE), (NAME, VEHICLE))
    write_certificates(tmp_path / "certs", certify(members, datetime.now(UTC), days=2))
    return tmp_path / "certs"


@pytest.fixture
def group() -> Iterator[ControlGroup]:
    if os.geteuid() != 0:
        pytest.fail("control groups need root")
    made = ControlGroup(f"rfedge-attack-{os.getpid()}")
    yield made
    made.close()


def metrics_address(log: Path) -> str:
    entries = (json.loads(x) for x in log.read_text().splitlines() if x.startswith("{"))
    (port,) = (entry["port"] for entry in entries if entry["event"] == "metrics")
    return f"127.0.0.1:{port}"


@pytest.fixture(scope="session")
def coded_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the sample's drive, coded against the field that ships."""
    from rfcore.field import load_field
    from rfedge.loadtest.prerecorded import prerecorded_drive

    drive = ROOT / "samples/street/transforms_drive_vehicles.json"
    return prerecorded_drive(drive, load_field(FIELD), tmp_path_factory.mktemp("coded"))


@pytest.fixture
async def scene(
    request: pytest.FixtureRequest,
    tmp_path: Path,
    certificates: Path,
    group: ControlGroup,
    coded_drive: Path,
) -> AsyncIterator[Scene]:
    from rfcore.field import FieldStore

    fields, access = tmp_path / "fields", tmp_path / "access.toml"
    for empty in (access, tmp_path / "decoy.toml"):
        empty.write_text("".join(f"[consumers.{name}]\nall = true\n" for name in (VEHICLE, NAME)))
    (tmp_path / "decoy-fields").mkdir()
    store = FieldStore(fields)
    field_id = store.add(FIELD)
    started: list[subprocess.Popen[bytes]] = []

    def start(name: str, *command: object, limited: bool = False) -> subprocess.Popen[bytes]:
        words = [sys.executable, *map(str, command)]
        with (tmp_path / f"{name}.log").open("ab") as file:
            process = subprocess.Popen(
                words,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=ENVIRONMENT,
                preexec_fn=group.enter if limited else None,
                start_new_session=True,
            )
        started.append(process)
        return process

    try:
        server = start(
            "server",
            *("-m", "mec_server", "--fields", fields, "--listen", "127.0.0.1:0"),
            *("--ready-file", tmp_path / "ready", "--metrics-port", 0, "--log", "json"),
            *("--decoder", "landlock", "--sandbox-as-root", MAX_FIELD),
            *("--access", access),
            *tls_options(certificates, "server"),
            limited=True,
        )
        decoy = start("decoy", *ATTACKER, "--decoy", tmp_path / "decoy", certificates)
        address = await appears(tmp_path / "ready", server, tmp_path / "server.log")
        told = await appears(tmp_path / "decoy", decoy, tmp_path / "decoy.log")
        root = str(certificates)
        target = Target(
            *(address, metrics_address(tmp_path / "server.log"), root),
            *(field_id, str(fields), str(access), server.pid),
        )
        in_vain = Target(
            *(*told.split(), root, field_id),
            *(str(tmp_path / "decoy-fields"), str(tmp_path / "decoy.toml"), decoy.pid),
        )
        attack_s = request.config.getoption("--attack-s")
        made = Scene(tmp_path, group, server, target, in_vain, coded_drive, attack_s, start)
        await made.begin("vehicle")
        await made.begin("consumer")
        yield made
        BOARD.add(request.node.name, [made.row()])
    finally:
        for process in started:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
