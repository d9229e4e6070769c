"""A real RTSP server, a real RTP sender, a real agent and a real server."""

from __future__ import annotations

import itertools
import json
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import grpc
import pytest

from cav_agent.live.reader import FrameRecord
from cav_agent.live.settings import ReaderSettings, parse_address
from cav_agent.live.source import ReaderProcess
from lab.truth.stream import SDP
from rfcore.image import read_rgb
from rfcore.metrics import psnr
from rfcore.wire.v1 import twin_pb2, twin_pb2_grpc

pytestmark = [pytest.mark.slow, pytest.mark.sample, pytest.mark.timeout(300)]

FIELDS = Path("samples/fields")


@dataclass
class Run:
    """An agent on a live camera, its server, and a consumer of the twin."""

    agent: subprocess.Popen[bytes]
    report: Path
    metrics: str
    shown_s: list[float] = field(default_factory=list)

    def lines(self) -> list[dict[str, Any]]:
        text = self.report.read_text() if self.report.exists() else ""
        return [json.loads(line) for line in text.splitlines(keepends=True) if line[-1] == "\n"]

    def acked(self) -> list[dict[str, Any]]:
        return [line for line in self.lines() if line["result"] == "acked"]

    def metric(self, name: str) -> float:
        with urllib.request.urlopen(self.metrics, timeout=10) as answer:
            text = answer.read().decode()
        values = [line.split()[-1] for line in text.splitlines() if line.startswith(name)]
        return sum(map(float, values))

    def wait(self, holds: Callable[[], bool], limit_s: float = 90.0) -> None:
        end_s = time.monotonic() + limit_s
        while not holds():
            assert self.agent.poll() is None, "the agent ended"
            assert time.monotonic() < end_s, f"not within {limit_s:g} s"
            time.sleep(0.05)

    def wait_more(self, frames: int) -> None:
        before = len(self.acked())
        self.wait(lambda: len(self.acked()) >= before + frames)

    def threads(self) -> int:
        return len(list(Path(f"/proc/{self.agent.pid}/task").iterdir()))

    def readers(self) -> int:
        children = Path(f"/proc/{self.agent.pid}/task").glob("*/children")
        return sum(len(file.read_text().split()) for file in children)

    def resident_mb(self) -> float:
        pages = int(Path(f"/proc/{self.agent.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@pytest.fixture
def run(tmp_path: Path, live_camera: Path) -> Iterator[Callable[[str], Run]]:
    """Return what drives with a source, until the test's end."""
    processes: list[subprocess.Popen[bytes]] = []

    def command(module: str, *arguments: object) -> subprocess.Popen[bytes]:
        process = subprocess.Popen([sys.executable, "-m", module, *map(str, arguments)])
        processes.append(process)
        return process

    def begin(source: str) -> Run:
        ready, report, port = tmp_path / "ready", tmp_path / "report.jsonl", free_tcp_port()
        listen = ("--listen", "127.0.0.1:0", "--ready-file", ready)
        server = command("mec_server", "--fields", FIELDS, *listen)
        while not ready.exists():
            assert server.poll() is None
            time.sleep(0.02)
        address = ready.read_text().strip()
        where = ("--server", address, "--fields", FIELDS, "--report", report)
        camera = ("--source", source, "--camera-file", live_camera, "--source-timeout-s", 2)
        more = ("--effort", "fast", "--metrics-port", port)
        agent = command("cav_agent", *where, *camera, *more)
        made = Run(agent, report, f"http://127.0.0.1:{port}/metrics")
        threading.Thread(target=consume, args=(address, made), daemon=True).start()
        return made

    yield begin
    for process in reversed(processes):
        process.terminate()
    for process in processes:
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            raise


def consume(address: str, run: Run) -> None:
    """Note how old each picture is when a consumer of the twin has it."""
    with grpc.insecure_channel(address) as channel:
        stub = twin_pb2_grpc.TwinServiceStub(channel)
        with suppress(grpc.RpcError):
            for response in stub.Watch(twin_pb2.WatchRequest(), wait_for_ready=True):
                if response.HasField("picture"):
                    run.shown_s.append((time.time_ns() - response.picture.capture_time_ns) / 1e9)


def lives_through(run: Run, sender: Any, kills: int, frames: int) -> None:
    """Kill the sender and start it again, so often; the agent does not grow."""
    run.wait_more(frames)
    threads, resident_mb = run.threads(), run.resident_mb()
    for _ in range(kills):
        sender.kill()
        run.wait(lambda: run.metric("rfedge_agent_source_open ") == 0)
        sender.start()
        run.wait_more(frames)
    assert run.metric("rfedge_agent_source_open ") == 1
    assert run.metric("rfedge_agent_source_losses_total") >= kills
    assert run.readers() == 1
    assert run.threads() <= threads + 1
    assert run.resident_mb() < resident_mb + 30


def free_tcp_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def clocks_of(run: Run) -> set[str]:
    return {line["capture_clock"] for line in run.acked()}


def test_an_rtsp_camera_is_killed_and_comes_back(run: Any, sender: Any) -> None:
    camera = sender("rtsp")
    driving = run(f"rtsp://127.0.0.1:{camera.port}/camera")
    lives_through(driving, camera, kills=1, frames=25)
    assert "sender_report" in clocks_of(driving)
    stages = driving.acked()[-1]["stage_ms"]
    assert {"receive", "wait", "read", "convert", "render", "link"} <= set(stages)
    assert driving.metric('rfedge_agent_capture_clock{clock="sender_report"}') == 1
    assert min(driving.shown_s) > 0


def test_an_rtp_stream_by_its_sdp_file(run: Any, sender: Any, tmp_path: Path) -> None:
    camera = sender("rtp")
    (tmp_path / "camera.sdp").write_text(SDP.format(port=camera.port))
    driving = run(str(tmp_path / "camera.sdp"))
    lives_through(driving, camera, kills=1, frames=25)
    assert "sender_report" in clocks_of(driving)


class LosingRelay:
    """Passes UDP from one port on to another, but for each so many-th datagram."""

    def __init__(self, source: int, target: int, lose_every: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", source))
        self._target = ("127.0.0.1", target)
        self._lose_every = lose_every
        threading.Thread(target=self._pass_on, daemon=True).start()

    def _pass_on(self) -> None:
        with suppress(OSError):
            for number in itertools.count(1):
                data = self._socket.recv(65536)
                if number % self._lose_every:
                    self._socket.sendto(data, self._target)

    def close(self) -> None:
        self._socket.close()


def test_pictures_that_rest_on_lost_packets_are_not_passed_on(
    sender: Any, live_camera: Path, free_port: int
) -> None:
    """Each 1501st RTP packet is lost, one in four groups of ten pictures."""
    target = free_port + 2 if free_port < 60000 else free_port - 2
    (live_camera / "camera.sdp").write_text(SDP.format(port=target))
    originals = [read_rgb(path) for path in sorted(live_camera.glob("*.jpg"))]
    address = parse_address(str(live_camera / "camera.sdp"))
    relay = LosingRelay(free_port, target, lose_every=1501)
    reader = ReaderProcess(ReaderSettings(address, 10.0, 30.0))
    seen, end_s = [], time.monotonic() + 120
    try:
        sender("rtp")
        while len(seen) < 80 or not seen[-1].damaged:
            record = reader.read(10.0)
            assert isinstance(record, FrameRecord)
            assert time.monotonic() < end_s
            seen.append(record)
    finally:
        reader.close()
        relay.close()
    worst_db = min(max(psnr(frame.rgb, original) for original in originals) for frame in seen)
    assert worst_db > 27, "those after a lost packet have 18 to 20 dB"


@pytest.mark.nightly
@pytest.mark.timeout(900)
def test_five_minutes_with_a_camera_that_dies_again_and_again(run: Any, sender: Any) -> None:
    camera = sender("rtsp")
    driving = run(f"rtsp://127.0.0.1:{camera.port}/camera")
    began_s = time.monotonic()
    while time.monotonic() < began_s + 300:
        lives_through(driving, camera, kills=1, frames=100)
