"""The parts of the live experiment one after the other, and their result.

One of them is here: a live camera that dies and comes back, into a real agent and a real server,
for minutes.
"""

from __future__ import annotations

import signal
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from lab.live import EvalLive
from lab.live.report import AgeRow, IngestRow, SourceRow, live_parts
from lab.live.showing import PictureAges, TwinBed, agent, measure_age, measure_ingest
from lab.servers.fleet import Lines, read_lines
from lab.soak import slope_per_minute
from lab.truth.stream import SDP
from lab.twin_reader import reading
from rfcore.dataset import read_dataset
from rfcore.errors import BackendUnavailable, RfedgeError
from rfcore.image import jpeg_bytes
from rfedge.loadtest.drive import Usage, Watcher
from rfedge.processes import command_of, service
from rfedge.report.tables import print_tables
from rfedge.results import CHECKOUT, make_result, provenance, write_result

SENDER = CHECKOUT / "deploy/live/gst_sender.py"
"""Runs under the system's Python, which has GStreamer's bindings; it is no part of the package."""
SYSTEM_PYTHON = "/usr/bin/python3"
DOWN_S = 3.0
"""Time for which a killed sender stays away: longer than the agent takes to call its source
lost."""
SETTLED = 0.2
"""Share of the run whose memory is not judged: caches and allocators fill."""
FIRST_PICTURE_S = 120.0


@dataclass(frozen=True)
class LiveCamera:
    """A live camera and its duration: ``folder`` has pictures and a ``camera.toml``."""

    kind: str
    folder: Path
    seconds: float
    kill_every_s: float


def write_camera(folder: Path, drive: Path) -> None:
    """Write the drive's pictures, and its middle pose for a day, as a camera that stands."""
    folder.mkdir(parents=True, exist_ok=True)
    pictures = list(read_dataset(drive).pictures)
    for i, picture in enumerate(pictures):
        (folder / f"{i:03d}.jpg").write_bytes(jpeg_bytes(picture.read()))
    middle = pictures[len(pictures) // 2].camera
    k, pose = middle.intrinsics, middle.world_from_cam
    (folder / "camera.toml").write_text(
        f"[camera]\nwidth_px = {k.width_px}\nheight_px = {k.height_px}\nfx_px = {k.fx_px}\n\n"
        '[trajectory]\nfile = "trajectory.txt"\nmax_gap_s = 1e6\n'
    )
    w, x, y, z = pose.rotation
    now_s = time.time()
    lines = [
        " ".join(map(str, (f"{now_s + off_s:.6f}", *pose.translation_m, x, y, z, w)))
        for off_s in (-86_400, 86_400)
    ]
    (folder / "trajectory.txt").write_text("\n".join(lines) + "\n")


class Sender:
    """A running sender; ``kill`` ends it as a power failure would, ``start`` begins another."""

    def __init__(self, kind: str, folder: Path) -> None:
        self.kind, self.folder = kind, folder
        self.port = _free_pair() if kind == "rtp" else 0
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Start it, on the port of the one before; raise ``RfedgeError`` if it does not."""
        if not SENDER.is_file():
            raise BackendUnavailable(f"{SENDER} is missing: live cameras need a checkout")
        command = [SYSTEM_PYTHON, str(SENDER), self.kind, f"{self.folder}/%03d.jpg", str(self.port)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        said = self._process.stdout.readline().strip()
        if not said.isdigit():
            raise BackendUnavailable(
                "the sender did not start; `make test-system-packages` installs GStreamer"
            )
        self.port = int(said)

    def kill(self) -> None:
        """End it."""
        if self._process is not None:
            self._process.send_signal(signal.SIGKILL)
            self._process.wait(10)
            if self._process.stdout is not None:
                self._process.stdout.close()
            self._process = None

    def source(self) -> str:
        """Return what the agent is to open."""
        if self.kind == "rtsp":
            return f"rtsp://127.0.0.1:{self.port}/camera"
        path = self.folder / "camera.sdp"
        path.write_text(SDP.format(port=self.port))
        return str(path)


def _free_pair() -> int:
    """Return an even UDP port that is free with the one after it: RTP's, and RTCP's (RFC 3550)."""
    for port in range(20_000, 60_000, 2):
        with suppress(OSError), ExitStack() as stack:
            for number in (port, port + 1):
                one = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                one.bind(("127.0.0.1", number))
            return port
    raise RfedgeError("no two UDP ports side by side are free")


@contextmanager
def sending(camera: LiveCamera) -> Iterator[Sender]:
    """Send until the block ends."""
    sender = Sender(camera.kind, camera.folder)
    try:
        sender.start()
        yield sender
    finally:
        sender.kill()


def measure_source(camera: LiveCamera, drive: Path, field: Path, work: Path) -> SourceRow:
    """Drive with a live camera at 10 Hz; return latencies, and what memory did."""
    write_camera(camera.folder, drive)
    report = work / f"{camera.kind}.jsonl"
    report.unlink(missing_ok=True)
    fields = ("--fields", str(field.parent))
    server = [*command_of("mec-server"), *fields, "--listen", "127.0.0.1:0"]
    with sending(camera) as sender, service("mec-server", server, work) as serving:
        arguments = ["--server", serving.address, *fields, "--effort", "fast"]
        arguments += ["--source", sender.source(), "--camera-file", str(camera.folder)]
        arguments += ["--source-timeout-s", "2", "--report", str(report)]
        ages = PictureAges()
        with agent("live", arguments, work) as driving, reading(serving.address, ages.take):
            _await_pictures(report, ages.ages_ms, driving)
            pids = {"agent": driving.pid, "server": serving.process.pid}
            watcher = Watcher(pids)
            watcher.start()
            kills = _kill_again_and_again(sender, camera)
            usage = watcher.stop()
            return _row(camera, kills, read_lines(report), ages.ages_ms, usage)


def _await_pictures(report: Path, ages_ms: list[float], process: subprocess.Popen[bytes]) -> None:
    """Wait for the first picture that was shown."""
    end_s = time.monotonic() + FIRST_PICTURE_S
    while not (ages_ms and report.exists()):
        if process.poll() is not None or time.monotonic() > end_s:
            raise RfedgeError(f"the agent sent no picture within {FIRST_PICTURE_S:g} s")
        time.sleep(0.1)


def _kill_again_and_again(sender: Sender, camera: LiveCamera) -> int:
    end_s, kills = time.monotonic() + camera.seconds, 0
    while (left_s := end_s - time.monotonic()) > 0:
        time.sleep(min(left_s, camera.kill_every_s))
        if end_s - time.monotonic() <= DOWN_S:
            break
        sender.kill()
        time.sleep(DOWN_S)
        sender.start()
        kills += 1
    return kills


def _row(
    camera: LiveCamera,
    kills: int,
    lines: Lines,
    ages_ms: Sequence[float],
    usage: Any,
) -> SourceRow:
    acked = [line for line in lines if line["result"] == "acked"]
    latency_ms = [line["latency_ms"] for line in acked]
    reported = sum(line["capture_clock"] == "sender_report" for line in acked)
    return SourceRow(
        source=camera.kind,
        seconds=camera.seconds,
        kills=kills,
        frames=len(lines),
        acked=len(acked),
        sender_report_percent=100 * reported / max(1, len(acked)),
        ack_median_ms=float(np.percentile(latency_ms, 50)),
        ack_p99_ms=float(np.percentile(latency_ms, 99)),
        shown_median_ms=float(np.percentile(ages_ms, 50)),
        shown_p99_ms=float(np.percentile(ages_ms, 99)),
        agent_mb=_mean_mb(usage["agent"]),
        agent_mb_per_minute=_slope(usage["agent"]),
        server_mb=_mean_mb(usage["server"]),
        server_mb_per_minute=_slope(usage["server"]),
        threads_first=usage["agent"].samples[0].threads,
        threads_last=usage["agent"].samples[-1].threads,
    )


def _settled(usage: Usage) -> Sequence[Any]:
    return usage.samples[int(SETTLED * len(usage.samples)) :]


def _mean_mb(usage: Usage) -> float:
    return float(np.mean([sample.rss_mb for sample in _settled(usage)]))


def _slope(usage: Usage) -> float:
    return slope_per_minute(_settled(usage))


def _camera(job: EvalLive, kind: str) -> LiveCamera:
    return LiveCamera(kind, job.work / kind, job.source_seconds, job.kill_every_s)


def run_live(job: EvalLive, console: Console) -> None:
    """Measure every part that was asked for, print it, and write the result."""
    bed = TwinBed(job.field, job.drive, job.work, job.hz, job.seconds)
    ages: list[AgeRow] = []
    for count in job.cameras:
        ages.append(measure_age(bed, count))
        _print(console, "ages", ages[-1])
    ingest: list[IngestRow] = []
    if job.rounds:
        ingest.append(measure_ingest(bed, job.rounds, job.consumers))
        _print(console, "ingest", ingest[0])
    sources: list[SourceRow] = []
    for kind in job.sources:
        sources.append(measure_source(_camera(job, kind), job.drive, job.field, job.work))
        _print(console, "sources", sources[-1])
    content = {"settings": asdict(job), "ages": ages, "ingest": ingest, "sources": sources}
    write_result(job.out, make_result("live", provenance([job.field, job.drive]), content))


def _print(console: Console, part: str, row: AgeRow | IngestRow | SourceRow) -> None:
    print_tables(live_parts({part: [asdict(row)]}), console)
