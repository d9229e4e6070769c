"""A server under compose's limits, a bystander at street size, and what an attack did to both.

The shipped field, 640x360 at 10 Hz, coded beforehand (``attack.bystander``): a vehicle computes on
a machine of its own. The bystander's latencies during the attack are compared with calm ones and
with a *control*: the same attacker, as long, aimed at a decoy that reads everything and answers
nothing. The three take turns, so that what else the machine does meets all of them. Attacker and
decoy have a processor while it is idle (SCHED_IDLE), also where the kernel shares it out by
sessions (sched(7), "The autogroup feature"): theirs would be another machine. Control groups (v1 or
v2) need root, no docker.
"""

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from attack.attacker import DEFERRED, LOG_LINES, OPEN_FILES, PROCESSOR_S
from attack.target import Target
from rfedge.certs.authority import Members, certify, write_certificates
from scoreboard import Scoreboard

ROOT = Path(__file__).parents[2]
FIELD = ROOT / "samples/fields/street.rff"
ATTACKER = ("-m", "attack.attacker")
GROUPS = Path("/sys/fs/cgroup")
MEMORY_BYTES, PIDS, CPUS, MAX_FIELD_GB = 1 << 30, 128, 1.0, 0.25
"""``mem_limit``, ``pids_limit``, ``cpus`` and ``--max-field-gb`` of docker-compose.yml."""
CPU_PERIOD_US = 100_000
"""Within which a group may use ``CPUS`` of this long; Docker's own."""
ROUNDS = 2
"""How often calm, control and attack take turns."""
AUTOGROUP_NICE = 10
ALLOWANCE_MS = 10.0
SCRAPE_S = 5.0
REPORT_S = 30.0
"""Within which the bystander knows how a picture ended: it loses its stream, and opens another."""
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
        if here in item.path.parents:
            item.add_marker(pytest.mark.attack)
            item.add_marker(pytest.mark.slow)


class ControlGroup:
    """Limits on memory, processes and processors: of version 2 where that has them, else of 1."""

    def __init__(self, name: str, memory_bytes: int = MEMORY_BYTES, cpus: float = CPUS) -> None:
        two = GROUPS / "cgroup.controllers"
        self._is_2 = two.exists() and {"memory", "pids", "cpu"} <= set(two.read_text().split())
        kinds = ("",) if self._is_2 else ("memory", "pids", "cpu")
        self._folders = [GROUPS / kind / name for kind in kinds]
        for folder in self._folders:
            folder.mkdir()
        self.limit_memory(memory_bytes)
        of_pids = self._folders[0 if self._is_2 else 1]
        (of_pids / "pids.max").write_text(str(PIDS))
        self._limit_cpus(cpus)

    def _limit_cpus(self, cpus: float) -> None:
        quota_us = round(cpus * CPU_PERIOD_US)
        if self._is_2:
            (self._folders[0] / "cpu.max").write_text(f"{quota_us} {CPU_PERIOD_US}")
            return
        (self._folders[-1] / "cpu.cfs_period_us").write_text(str(CPU_PERIOD_US))
        (self._folders[-1] / "cpu.cfs_quota_us").write_text(str(quota_us))

    def limit_memory(self, limit_bytes: int) -> None:
        """Set how much memory its processes may have together."""
        name = "memory.max" if self._is_2 else "memory.limit_in_bytes"
        (self._folders[0] / name).write_text(str(limit_bytes))

    @property
    def within(self) -> tuple[str, ...]:
        """Return what runs a command in it."""
        put = "; ".join(f"echo $$ > {folder}/cgroup.procs" for folder in self._folders)
        return ("sh", "-c", f'{put}; exec "$@"', "sh")

    def enter(self) -> None:
        """Put this process into it; for ``preexec_fn``."""
        for folder in self._folders:
            (folder / "cgroup.procs").write_text(str(os.getpid()))

    def memory_bytes(self) -> int:
        """Return the memory of its processes now, without the kernel's cache of files."""
        name = "anon" if self._is_2 else "total_rss"
        stat = (self._folders[0] / "memory.stat").read_text().splitlines()
        return next(int(line.split()[1]) for line in stat if line.split()[0] == name)

    def kills(self) -> int:
        """Return how many of its processes the kernel has killed for memory."""
        file = self._folders[0] / ("memory.events" if self._is_2 else "memory.oom_control")
        pairs = (line.split() for line in file.read_text().splitlines())
        return next((int(count) for name, count in pairs if name == "oom_kill"), 0)

    def close(self) -> None:
        """Remove it; its processes have ended."""
        for folder in self._folders:
            until_s = time.monotonic() + 10
            while True:
                try:
                    folder.rmdir()
                    break
                except OSError:
                    assert time.monotonic() < until_s, f"{folder} is not empty"
                    time.sleep(0.05)


async def appears(path: Path, process: subprocess.Popen[bytes], log: Path) -> str:
    """Return what ``path`` holds, once it is there."""
    async with asyncio.timeout(60):
        while not (path.exists() and path.read_text().strip()):
            assert process.poll() is None, log.read_text()
            await asyncio.sleep(0.02)
    return path.read_text().strip()


@dataclass
class Scene:
    """Everything that runs, and the row in the making."""

    folder: Path
    group: ControlGroup
    server: subprocess.Popen[bytes]
    target: Target
    decoy: Target
    report: Path
    attack_s: float
    name: str = ""
    what: str = ""
    identity: str = ""
    p99_ms: float = 0.0
    bounds: list[str] = field(default_factory=list)
    measured: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    finished: bool = False

    def note(self, bound: str, measured: str, good: bool) -> None:
        """Note a figure and its bound."""
        self.bounds.append(bound)
        self.measured.append(measured)
        if not good:
            self.failed.append(f"{bound}: {measured}")

    def about(self, name: str, what: str, identity: str) -> None:
        """Say what is done, and with whose certificate."""
        self.name, self.what, self.identity = name.replace("_", " "), what, identity

    def row(self) -> dict[str, Any]:
        """Return the row of the scoreboard; one that was broken off does not hold."""
        whole = bool(self.measured) and self.finished
        bounds = [*self.bounds, *(() if whole else ("measured to the end",))]
        return {
            "attack": f"{self.name}: {self.what}",
            "identity": self.identity,
            "bound": "; ".join(bounds),
            "measured": "; ".join([*self.measured, *(() if whole else ("no",))]),
            "bystander_p99_ms": round(self.p99_ms, 1),
            "held": whole and not self.failed,
        }

    async def _lines(self, begin_s: float, end_s: float) -> list[dict[str, Any]]:
        """Return the bystander's pictures that were captured in a time, once all have ended."""
        async with asyncio.timeout(REPORT_S):
            while True:
                lines = [json.loads(line) for line in self.report.read_text().split("\n")[:-1]]
                captured_s = [x["capture_time_ns"] / 1e9 for x in lines]
                if captured_s and captured_s[-1] > end_s:
                    break
                await asyncio.sleep(0.05)
        return [x for x, s in zip(lines, captured_s, strict=True) if begin_s <= s <= end_s]

    def counters(self) -> Counter[str]:
        """Return what the server has counted of everything so far, its log's lines included.

        Nothing of a server that does not answer.
        """
        lines = (self.folder / "server.log").read_bytes().count(b"\n")
        counted = Counter({LOG_LINES: lines, DEFERRED: kernel_count("TCPDeferAcceptDrop")})
        with suppress(OSError):
            counted.update(scraped(self.target.metrics))
        return counted

    async def phase(self, attack: str = "", target: Target | None = None) -> "Phase":
        """Let a while pass, attacking or not; return what the bystander had of it."""
        before = await asyncio.to_thread(self.counters)
        attacker = None if target is None else await self._attacker(attack, target)
        most_bytes, most_files, began_s, lasts_s = 0, 0, time.time(), self.attack_s / ROUNDS
        before_s = processor_s(self.server.pid)
        try:
            until_s = time.monotonic() + lasts_s
            while time.monotonic() < until_s and self.server.poll() is None:
                most_bytes = max(most_bytes, self.group.memory_bytes())
                most_files = max(most_files, open_files(self.server.pid))
                if attacker is not None and attacker.poll() is not None:
                    pytest.fail((self.folder / "attacker.log").read_text())
                await asyncio.sleep(0.05)
            end_s, worked_s = time.time(), processor_s(self.server.pid) - before_s
            attacked_s = 0.0 if attacker is None else processor_s(attacker.pid)
        finally:
            if attacker is not None:
                attacker.kill()
                attacker.wait()
        lines = await self._lines(began_s, end_s)
        grown = await asyncio.to_thread(self.counters)
        grown.subtract(before)
        grown.update({OPEN_FILES: most_files, PROCESSOR_S: worked_s})
        return Phase(lines, most_bytes, end_s - began_s, worked_s, attacked_s, grown)

    async def _attacker(self, attack: str, target: Target) -> subprocess.Popen[bytes]:
        """Return the process of an attack that has begun."""
        begun, log = self.folder / "begun", self.folder / "attacker.log"
        begun.unlink(missing_ok=True)
        arguments = (attack, str(self.attack_s + 60), json.dumps(asdict(target)), str(begun))
        with log.open("ab") as file:
            attacker = subprocess.Popen(
                [sys.executable, *ATTACKER, *arguments],
                stdout=file,
                stderr=subprocess.STDOUT,
                env=ENVIRONMENT,
                start_new_session=True,
            )
        leave_the_processor(attacker.pid)
        await appears(begun, attacker, log)
        return attacker


def leave_the_processor(pid: int) -> None:
    """Let a session's leader, and what it starts, have the processor when others leave it."""
    os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))
    autogroup = Path(f"/proc/{pid}/autogroup")
    if autogroup.exists():
        autogroup.write_text(str(AUTOGROUP_NICE))


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
        latencies_ms = [x["latency_ms"] for x in self.lines if x["result"] == "acked"]
        if not latencies_ms:
            return 60e3  # nothing was answered for all that time
        return float(np.percentile(latencies_ms, 99))

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


def reason(line: dict[str, Any]) -> str:
    return "" if line["reason"] == "none" else str(line["reason"])


@pytest.fixture
def certificates(tmp_path: Path) -> Path:
    members = Members(("bystander", "attacker"), ("attacker",))
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


def tls(root: Path, name: str) -> list[str]:
    files = {"--tls-cert": f"{name}.pem", "--tls-key": f"{name}.key", "--tls-ca": "ca.pem"}
    return [str(part) for option, file in files.items() for part in (option, root / file)]


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
        empty.write_text("[consumers.attacker]\nall = true\n")
    (tmp_path / "decoy-fields").mkdir()
    store = FieldStore(fields)
    field_id = store.add(FIELD)
    started: list[subprocess.Popen[bytes]] = []

    def start(name: str, *command: object, limited: bool = False) -> Any:
        log = tmp_path / f"{name}.log"
        words = [sys.executable, *map(str, command)]
        with log.open("wb") as file:
            process = subprocess.Popen(
                words,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=ENVIRONMENT,
                preexec_fn=group.enter if limited else None,
                start_new_session=True,
            )
        started.append(process)
        return started[-1], log

    try:
        server, server_log = start(
            "server",
            *("-m", "mec_server", "--fields", fields, "--listen", "127.0.0.1:0"),
            *("--ready-file", tmp_path / "ready", "--metrics-port", 0, "--log", "json"),
            *("--decoder", "landlock", "--sandbox-as-root", "--max-field-gb", MAX_FIELD_GB),
            *("--access", access),
            *tls(certificates, "server"),
            limited=True,
        )
        decoy, decoy_log = start("decoy", *ATTACKER, "--decoy", tmp_path / "decoy", certificates)
        leave_the_processor(decoy.pid)
        address = await appears(tmp_path / "ready", server, server_log)
        told = await appears(tmp_path / "decoy", decoy, decoy_log)
        root = str(certificates)
        target = Target(
            *(address, metrics_address(server_log), root),
            *(field_id, str(fields), str(access), server.pid),
        )
        in_vain = Target(
            *(*told.split(), root, field_id),
            *(str(tmp_path / "decoy-fields"), str(tmp_path / "decoy.toml"), decoy.pid),
        )
        report = tmp_path / "bystander.jsonl"
        bystander, log = start(
            "bystander", *("-m", "attack.bystander", coded_drive, address, root, report)
        )
        await appears(report, bystander, log)
        attack_s = request.config.getoption("--attack-s")
        made = Scene(tmp_path, group, server, target, in_vain, report, attack_s)
        yield made
        BOARD.add(request.node.name, [made.row()])
    finally:
        for process in started:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
