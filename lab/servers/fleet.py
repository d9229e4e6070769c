"""Vehicles as processes, what became of their pictures, and what the twins of servers showed.

Times are of one clock (Unix time): a picture's Ack is its capture plus its latency.
"""

from __future__ import annotations

import json
import math
import subprocess
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

from lab.twin_reader import TwinReader
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.wire.twin import PictureEncoding, Subscription, TwinPicture
from rfedge.processes import command_of

WAIT_S = 120.0
POLL_S = 0.05

Lines = Sequence[Mapping[str, Any]]
"""A vehicle's report: a line a picture (``cav_agent.frame_log``), in the order they ended."""


def resumed_s(lines: Lines, since_ns: int) -> float | None:
    """Return seconds from ``since_ns`` to the first Ack on another stream than the one before.

    None for a vehicle that kept its stream. A stream has epochs of its own.
    """
    acked = [line for line in lines if line["result"] == "acked"]
    before = {line["epoch"] for line in acked if line["capture_time_ns"] < since_ns}
    after = (line for line in acked if line["capture_time_ns"] >= since_ns)
    first = next((line for line in after if line["epoch"] not in before), None)
    if first is None:
        return None
    return float(first["capture_time_ns"] - since_ns) / 1e9 + float(first["latency_ms"]) / 1e3


def failures(lines: Lines, since_ns: int, until_ns: int) -> int:
    """Return how many pictures that were captured in between were sent in vain."""
    return sum(
        line["result"] in ("lost", "nacked") and since_ns <= line["capture_time_ns"] < until_ns
        for line in lines
    )


def keyframes(lines: Lines) -> int:
    """Return how many acknowledged pictures were not predicted from the field's render."""
    return sum(line["result"] == "acked" and "render" not in line["references"] for line in lines)


def p99(values: Iterable[float]) -> float:
    """Return the 99th percentile by nearest rank; the largest of up to a hundred values.

    Raises ``InvalidInput`` without values.
    """
    ordered = sorted(values)
    if not ordered:
        raise InvalidInput("values", "a percentile of nothing")
    return ordered[math.ceil(0.99 * len(ordered)) - 1]


@dataclass
class Fleet:
    """Vehicles as processes, and their reports."""

    drive: Path
    folder: Path
    reports: list[Path] = field(default_factory=list)
    left: list[Path] = field(default_factory=list)
    """Reports of vehicles that are gone."""

    def leave(self, vehicles: int) -> None:
        """Count only the first ``vehicles``; the others were ended."""
        self.left += self.reports[vehicles:]
        del self.reports[vehicles:]

    def start(self, stack: ExitStack, address: str, vehicles: int, hz: float) -> None:
        """Start vehicles and wait until each has had two pictures acknowledged."""
        self.folder.mkdir(parents=True, exist_ok=True)
        for number in range(len(self.reports), len(self.reports) + vehicles):
            report = self.folder / f"{number}.jsonl"
            self.reports.append(report)
            command = [
                *command_of("cav-agent"),
                *("--server", address, "--vehicle", f"cav-{number}", "--loop"),
                *("--drive", str(self.drive), "--fields", str(self.folder / "fields")),
                *("--rate", f"{hz:g}", "--effort", "fast", "--report", str(report)),
            ]
            with (self.folder / f"{number}.log").open("wb") as log:
                process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
            stack.callback(process.wait)
            stack.callback(process.kill)
            if number == 0:  # it fetches the field that the others find
                self.until_acked(0)
        self.until_acked(0)

    def lines(self) -> list[Lines]:
        """Return every vehicle's report so far."""
        return [read_lines(report) for report in self.reports]

    def until_acked(self, since_ns: int) -> None:
        """Wait until each vehicle had two pictures acknowledged that it took after ``since_ns``."""
        deadline = time.monotonic() + WAIT_S
        waiting = list(self.reports)
        while waiting := [x for x in waiting if _acked_since(read_lines(x), since_ns) < 2]:
            if time.monotonic() > deadline:
                raise RfedgeError(f"{waiting[0]} tells of no pictures after {WAIT_S:g} s")
            time.sleep(POLL_S)


def read_lines(report: Path) -> Lines:
    """Return the whole lines of a report so far."""
    if not report.exists():
        return []
    return [json.loads(line) for line in report.read_text().splitlines(True) if line[-1] == "\n"]


def _acked_since(lines: Lines, since_ns: int) -> int:
    return sum(x["result"] == "acked" and x["capture_time_ns"] >= since_ns for x in lines)


@dataclass(frozen=True)
class ShownPicture:
    """A picture that the twin of a server (HOST:PORT) showed."""

    vehicle_id: str
    camera_id: str
    capture_time_ns: int
    server: str


def shown_twice(pictures: Iterable[ShownPicture]) -> int:
    """Return how many vehicles two servers showed at the same time.

    While a vehicle moves, both of its streams are open, and the old server shows what it took
    before: that is one vehicle. It is shown twice if two servers show one of its pictures, or if
    a server shows a picture that was taken after one that its successor has shown.
    """
    of_camera: dict[tuple[str, str], set[tuple[int, str]]] = {}
    for picture in pictures:
        camera = picture.vehicle_id, picture.camera_id
        of_camera.setdefault(camera, set()).add((picture.capture_time_ns, picture.server))
    return len({camera[0] for camera, shown in of_camera.items() if _are_mixed(sorted(shown))})


def _are_mixed(shown: Sequence[tuple[int, str]]) -> bool:
    """Return whether two servers have one moment, or the moments of a server another between."""
    moments = {moment for moment, _ in shown}
    stays = [server for server, _ in groupby(server for _, server in shown)]
    return len(moments) < len(shown) or len(set(stays)) < len(stays)


class TwinWatch:
    """Notes which pictures the twins of servers show, until it is left."""

    def __init__(self) -> None:
        self._pictures: list[ShownPicture] = []
        self._readers: dict[str, TwinReader] = {}
        self._stack = ExitStack()

    def __enter__(self) -> TwinWatch:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def add(self, address: str) -> None:
        """Watch one more server from now on."""

        def take(picture: TwinPicture) -> None:
            shown = ShownPicture(*picture.key, picture.capture_time_ns, address)
            self._pictures.append(shown)

        reader = TwinReader(address, take, Subscription(encoding=PictureEncoding.NONE))
        self._readers[address] = self._stack.enter_context(reader)

    def result(self) -> list[ShownPicture]:
        """Return what was shown so far; raise ``RfedgeError`` for a server that showed nothing."""
        for address, reader in self._readers.items():
            if reader.problem is not None:
                raise RfedgeError(f"{address} does not show its pictures: {reader.problem}")
        return list(self._pictures)
