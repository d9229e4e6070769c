"""Processes on both sides of a wire: a peer's two ends, or a vehicle, a server and its screen.

Those of a side share one core. Nothing but what is measured crosses the wire.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from lab.tcp.wire import Wire
from lab.webrtc.camera import CameraPictures, there_and_back
from lab.webrtc.engines import VIDEO_CLOCK_HZ
from lab.webrtc.measure import Figures, Shown, Window, figures_of, numbered, read_pictures
from rfcore.errors import InvalidData, RfedgeError
from rfcore.field import FieldStore
from rfedge.processes import command_of, service

SUBNET, FAR = "10.218.0", "10.218.0.2"
NEAR_CORE, FAR_CORE = 0, 1
START_S, END_S = 180.0, 20.0
VEHICLE = "cav"
ROUNDED_NS = 1_000_000
"""Capture times on the wire differ by less."""


@dataclass(frozen=True)
class Schedule:
    """Seconds before the measured ones, measured, and after them."""

    settle_s: float
    seconds: float
    late_s: float


@dataclass(frozen=True)
class OurSettings:
    """What we send: the field's archive, the drive's ``transforms.json``, effort and CRF."""

    field: Path
    drive: Path
    effort: str
    crf: float


@dataclass(frozen=True)
class LinkBed:
    """A wire, a folder for files, and the camera at its near end."""

    wire: Wire
    work: Path
    camera: CameraPictures
    hz: float
    schedule: Schedule

    def peer(self, engine: str, codec: str) -> tuple[Figures, int]:
        """Send by WebRTC; return the figures, and the bytes of the measured time."""
        pictures, sent, shown = (self.work / n for n in ("pictures.npz", "sent.json", "shown.npz"))
        self.camera.write(pictures)
        process = [sys.executable, "-m", "lab.webrtc.peer"]
        with ExitStack() as stack:
            send = [*process, "send", engine, codec, str(pictures), str(self.hz), str(sent)]
            near = stack.enter_context(self._talking("sender", self._near(send)))
            receive = [*process, "receive", engine, codec, str(shown)]
            far = stack.enter_context(self._talking("receiver", self._far(receive)))
            far.say(near.hear())
            near.say(far.hear())
            far.hear()
            near.hear()
            window, sent_bytes = self._measured()
            far.stop()
            near.stop()
        times_ns, stamps, lumas = read_pictures(shown)
        captured = {int(k): ns for k, ns in json.loads(sent.read_text()).items()}
        about = (stamps - stamps[:1]) * self.hz / VIDEO_CLOCK_HZ
        pictures_shown = Shown(times_ns, numbered(lumas, about, self.camera), lumas)
        return figures_of(pictures_shown, captured, self.camera, window), sent_bytes

    def ours(self, us: OurSettings, max_delay_ms: float) -> tuple[Figures, int]:
        """Send with ``cav-agent`` to ``mec-server``; return the same."""
        store = self.work / "fields"
        field_id = FieldStore(store).add(us.field)
        shown, report = self.work / "shown.npz", self.work / "report.jsonl"
        fields = ("--fields", str(store), "--allow-insecure")
        server = [*command_of("mec-server"), *fields, "--listen", "0.0.0.0:0"]
        server += ["--decoder", "in-process"]
        with ExitStack() as stack:
            serving = stack.enter_context(service("mec-server", self._far(server), self.work))
            port = serving.address.rpartition(":")[2]
            screen = [sys.executable, "-m", "lab.webrtc.screen", f"127.0.0.1:{port}", str(shown)]
            far = stack.enter_context(self._talking("screen", self._far(screen)))
            far.hear()
            agent = [*command_of("cav-agent"), *fields, "--server", f"{FAR}:{port}"]
            agent += ["--drive", str(self._drive(us.drive)), "--loop", "--rate", str(self.hz)]
            agent += ["--field", field_id, "--vehicle", VEHICLE, "--report", str(report)]
            agent += ["--crf", str(us.crf), "--effort", us.effort]
            agent += ["--max-delay-ms", str(max_delay_ms)]
            stack.enter_context(self._talking("cav-agent", self._near(agent), talks=False))
            self._await_first(report)
            window, sent_bytes = self._measured()
            far.stop()
        lines = [json.loads(line) for line in report.read_text().splitlines()]
        captured = numbers_of(lines, len(self.camera.cycle), self.hz)
        times_ns, stamps, lumas = read_pictures(shown)
        numbers = numbers_at(stamps.tolist(), captured)
        pictures_shown = Shown(times_ns, numbers, lumas)
        return figures_of(pictures_shown, captured, self.camera, window), sent_bytes

    def _drive(self, source: Path) -> Path:
        """Write the drive there and back, with its files; return its ``transforms.json``."""
        content = json.loads(source.read_text())
        frames = [content["frames"][k] for k in there_and_back(len(self.camera.pictures))]
        content["frames"] = [{**f, "time": k / self.hz} for k, f in enumerate(frames)]
        for name in {frame["file_path"] for frame in frames}:
            (self.work / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source.parent / name, self.work / name)
        drive = self.work / "transforms.json"
        drive.write_text(json.dumps(content))
        return drive

    def _await_first(self, report: Path) -> None:
        end_s = time.monotonic() + START_S
        while not (report.exists() and report.stat().st_size):
            if time.monotonic() > end_s:
                log = (self.work / "cav-agent.log").read_text(errors="replace")[-2000:]
                raise RfedgeError(f"cav-agent sent no picture within {START_S:g} s:\n{log}")
            time.sleep(0.05)

    def _measured(self) -> tuple[Window, int]:
        """Wait for the measured time; return it, and the bytes that the near end sent in it."""
        time.sleep(self.schedule.settle_s)
        begin_ns, before = time.time_ns(), self.wire.sent_bytes()
        time.sleep(self.schedule.seconds / 2)
        self.wire.step()
        time.sleep(max(0.0, self.schedule.seconds - (time.time_ns() - begin_ns) / 1e9))
        window = Window(begin_ns, begin_ns + round(1e9 * self.schedule.seconds), self.hz)
        sent_bytes = self.wire.sent_bytes() - before
        time.sleep(self.schedule.late_s)
        return window, sent_bytes

    def _near(self, command: list[str]) -> list[str]:
        return _within(self.wire.near, NEAR_CORE, command)

    def _far(self, command: list[str]) -> list[str]:
        return _within(self.wire.far, FAR_CORE, command)

    @contextmanager
    def _talking(self, name: str, command: list[str], *, talks: bool = True) -> Iterator[Talking]:
        """Run a process until the block ends; what it says goes into a log unless it talks."""
        log_path = self.work / f"{name}.log"
        with log_path.open("wb") as log:
            out = subprocess.PIPE if talks else log
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=out, stderr=log, text=True
            )
        try:
            yield Talking(name, process, log_path)
        finally:
            process.terminate()
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@dataclass(frozen=True)
class Talking:
    """A process that is talked with by lines."""

    name: str
    process: subprocess.Popen[str]
    log_path: Path

    def say(self, line: str) -> None:
        """Write a line."""
        _pipe(self.process.stdin).write(line)
        _pipe(self.process.stdin).flush()

    def hear(self) -> str:
        """Return the next line; raise ``RfedgeError`` with the log if the process ends before."""
        line = _pipe(self.process.stdout).readline()
        if not line:
            log = self.log_path.read_text(errors="replace")[-2000:]
            raise RfedgeError(f"the {self.name} ended early:\n{log}")
        return line

    def stop(self) -> None:
        """Ask it to write what it knows, and wait until it has; raises as ``hear``."""
        self.say("{}\n")
        if self.process.wait(END_S):
            self.hear()


def _pipe(pipe: IO[str] | None) -> IO[str]:
    assert pipe is not None
    return pipe


def _within(namespace: str, core: int, command: list[str]) -> list[str]:
    return ["ip", "netns", "exec", namespace, "taskset", "-c", str(core), *command]


def numbers_of(lines: list[dict[str, int]], length: int, hz: float) -> Mapping[int, int]:
    """Return capture times by the camera's number, of the lines of an agent's report.

    ``length``: pictures of the drive, after which it begins again. Raises ``InvalidData`` for
    lines that give two pictures one number.
    """
    first_ns = min(line["capture_time_ns"] for line in lines)
    captured: dict[int, int] = {}
    for line in lines:
        about = round((line["capture_time_ns"] - first_ns) * hz / 1e9)
        number = line["index"] + length * round((about - line["index"]) / length)
        if number in captured:
            raise InvalidData(f"two pictures of the report are number {number}")
        captured[number] = line["capture_time_ns"]
    return captured


def numbers_at(stamps_ns: list[int], captured_ns: Mapping[int, int]) -> list[int]:
    """Return the numbers of pictures by their capture times, which the wire rounds.

    Raises ``InvalidData`` for a time at which none was captured.
    """
    numbers = []
    for stamp_ns in stamps_ns:
        number = min(captured_ns, key=lambda k: abs(captured_ns[k] - stamp_ns))
        if abs(captured_ns[number] - stamp_ns) > ROUNDED_NS:
            raise InvalidData(f"a picture of {stamp_ns} ns was shown, but none was captured then")
        numbers.append(number)
    return numbers
