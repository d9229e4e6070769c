"""One twin over two servers: NATS restarted under load.

Debian's ``nats-server``, two servers and the vehicles are processes; the twin is read in this one,
as ``rfedge twin --nats`` reads it. Half of the vehicles stream to each server.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from lab.servers import EvalScale
from lab.servers.cases import Measured, ScaleRow
from lab.servers.fleet import Fleet, Lines, failures, p99
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.wire.nats import NatsServers
from rfcore.wire.twin import PictureEncoding, Subscription, TwinPicture
from rfedge.processes import command_of, service
from rfedge.twin.nats_source import NatsPictures

BACK_S = 2.0
WAY_TIMES, WAY_MORE_MS = 1.2, 10.0
"""A frame may take this many times as long from sending to Ack as before, and so much more."""
AWAY_S = 2.0
"""Time for which NATS is away before it is started again."""
START_S = 30.0
WAIT_S = 60.0
POLL_S = 0.01
SERVERS = ("east", "west")


def nats_binary() -> Path:
    """Return the command ``nats-server``; raise ``InvalidInput``."""
    found = shutil.which("nats-server", path="/usr/sbin:/usr/bin:/usr/local/bin")
    if found is None:
        raise InvalidInput("nats", "there is no command nats-server; apt-get install nats-server")
    return Path(found)


class NatsServer:
    """A NATS with JetStream that keeps its files in ``folder``; restarted at the port it took.

    With ``config`` it runs in that file's folder, and keeps its files where that says.
    Use it as a context manager: it runs inside.
    """

    def __init__(self, folder: Path, config: Path | None = None) -> None:
        self._folder = folder.resolve()  # the server runs in it
        self._config = config
        self._port = -1
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> NatsServer:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.kill()

    @property
    def url(self) -> str:
        """Its address."""
        return f"nats://127.0.0.1:{self._port}"

    def start(self) -> None:
        """Start it and wait until it listens; raise ``RfedgeError``."""
        ports = self._folder / "ports"
        shutil.rmtree(ports, ignore_errors=True)
        ports.mkdir(parents=True)
        command = [nats_binary(), "-a", "127.0.0.1", "-p", self._port, "--ports_file_dir", ports]
        if self._config is None:
            command += ["-js", "-sd", self._folder / "kept"]
        else:
            command += ["-c", self._config]
        with (self._folder / "nats.log").open("ab") as log:
            self._process = subprocess.Popen(
                [str(word) for word in command],
                cwd=self._folder if self._config is None else self._config.parent,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        self._port = self._until_listening(self._process, ports)

    def kill(self) -> None:
        """End it without a farewell."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def _until_listening(self, process: subprocess.Popen[bytes], ports: Path) -> int:
        deadline = time.monotonic() + START_S
        while time.monotonic() < deadline and process.poll() is None:
            for told in ports.glob("*.ports"):
                urls = json.loads(told.read_text() or "{}").get("nats", [])
                if urls:
                    return int(urls[0].rpartition(":")[2])
            time.sleep(POLL_S)
        self.kill()
        lines = (self._folder / "nats.log").read_text(errors="replace").splitlines()[-5:]
        raise RfedgeError(f"nats-server does not listen after {START_S:g} s: " + "\n".join(lines))


@dataclass
class _NewestPictures:
    """Notes in a thread when the newest picture of each vehicle came, on the monotonic clock."""

    pictures: NatsPictures
    newest_s: dict[str, float] = field(default_factory=dict)

    def run(self) -> None:
        for message in self.pictures.watch(Subscription(encoding=PictureEncoding.JPEG)):
            if isinstance(message, TwinPicture):
                self.newest_s[message.vehicle_id] = time.monotonic()

    def shown_since(self, since_s: float) -> Mapping[str, float]:
        """Return the vehicles that were shown since then, and when last."""
        return {name: at_s for name, at_s in tuple(self.newest_s.items()) if at_s >= since_s}


def nats_rows(job: EvalScale) -> Measured:
    """Restart NATS ``job.rounds`` times while vehicles stream; return what that did."""
    job.work.mkdir(parents=True, exist_ok=True)
    fleet = Fleet(job.reduced, job.work / "vehicles")
    with ExitStack() as stack:
        nats = stack.enter_context(NatsServer(job.work / "nats"))
        for number, name in enumerate(SERVERS):
            server = stack.enter_context(service(name, _command(job, name, nats.url), job.work))
            count = (job.vehicles + number) // len(SERVERS)
            fleet.start(stack, server.address, count, job.hz)
        watched = _watch(stack, nats.url)
        since_ns = time.time_ns()
        _until(lambda: len(watched.newest_s) == job.vehicles, "shows every vehicle")
        quiet_ns = time.time_ns()
        time.sleep(job.seconds)
        killed_ns = time.time_ns()
        back_s = [_restart(nats, watched, job.vehicles) for _ in range(job.rounds)]
        until_ns = time.time_ns()
        fleet.until_acked(until_ns)
        told = fleet.lines()
        lost = sum(failures(lines, since_ns, until_ns) for lines in told)
    at_most = ScaleRow.at_most
    return Measured(
        [
            at_most("NATS restarted under load: s until the twin is back", BACK_S, max(back_s)),
            at_most("NATS away or restarted: pictures lost or refused", 0, lost),
            undisturbed(told, quiet_ns, killed_ns, until_ns),
        ]
    )


def undisturbed(told: Iterable[Lines], quiet_ns: int, killed_ns: int, until_ns: int) -> ScaleRow:
    """Return the row that compares the p99 of frames' way before NATS was killed and after that.

    A frame's way is the time from sending to Ack, the server's work included. Frames are told apart
    by when they were captured: from ``quiet_ns``, and from ``killed_ns`` until ``until_ns``. Raises
    ``InvalidInput`` where one of the two has none that was acknowledged.
    """
    lines = [line for each in told for line in each]
    before_ms = p99(_ways_ms(lines, quiet_ns, killed_ns))
    bound_ms = WAY_TIMES * before_ms + WAY_MORE_MS
    measured_ms = p99(_ways_ms(lines, killed_ns, until_ns))
    case = "NATS away or restarted: p99 of a frame's way, ms"
    return ScaleRow.at_most(case, bound_ms, measured_ms)


def _ways_ms(lines: Lines, since_ns: int, until_ns: int) -> Iterator[float]:
    for line in lines:
        if line["result"] == "acked" and since_ns <= line["capture_time_ns"] < until_ns:
            yield line["stage_ms"]["link"] + line["stage_ms"]["server_total"]


def _command(job: EvalScale, name: str, url: str) -> list[str]:
    where = ("--fields", str(job.published), "--listen", "127.0.0.1:0")
    return [*command_of("mec-server"), *where, "--nats", url, "--nats-name", name]


def _watch(stack: ExitStack, url: str) -> _NewestPictures:
    watched = _NewestPictures(NatsPictures(NatsServers((url,))))
    thread = threading.Thread(target=watched.run, name="watch", daemon=True)
    thread.start()
    stack.callback(thread.join, WAIT_S)
    stack.callback(watched.pictures.stop)
    return watched


def _restart(nats: NatsServer, watched: _NewestPictures, vehicles: int) -> float:
    """Kill NATS and start it again; return seconds from then until all vehicles are shown."""
    nats.kill()
    time.sleep(AWAY_S)
    started_s = time.monotonic()
    nats.start()
    first_s: dict[str, float] = {}

    def are_back() -> bool:
        for name, at_s in watched.shown_since(started_s).items():
            first_s.setdefault(name, at_s)
        return len(first_s) == vehicles

    _until(are_back, "is back")
    return max(first_s.values()) - started_s


def _until(holds: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + WAIT_S
    while not holds():
        if time.monotonic() > deadline:
            raise RfedgeError(f"it did not come so far within {WAIT_S:g} s that the twin {what}")
        time.sleep(POLL_S)
