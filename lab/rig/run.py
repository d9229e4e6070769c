"""Run a rig's cameras in one session, and in a session each, over one link; measure both.

What the server shows meanwhile, a consumer of the twin keeps: PSNR needs the pictures, and the
spread of an instant the times at which they are shown.
"""

from __future__ import annotations

import itertools
import json
import os
import statistics
import subprocess
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console

from lab.rig import EvalRig
from lab.rig.report import CameraRow, SessionRow
from lab.servers.fleet import Lines, read_lines
from lab.twin_reader import TwinReader
from rfcore.dataset.rig import Rig, RigCamera, RigInstant, read_rig, read_rig_drive
from rfcore.errors import RfedgeError
from rfcore.metrics import psnr
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import PosedPicture
from rfcore.wire.twin import PictureEncoding, Subscription, TwinPicture
from rfedge.processes import Service, command_of, service
from rfedge.results import Result, as_json, make_result, provenance


@dataclass(frozen=True)
class Spread:
    """The milliseconds from the first to the last picture of each instant that is whole."""

    whole: int
    milliseconds: tuple[float, ...]


def spreads_of(pictures: Sequence[TwinPicture], cameras: int) -> Spread:
    """Return the spreads of the instants that ``cameras`` cameras have shown."""
    shown_ns: dict[int, dict[str, int]] = defaultdict(dict)
    for picture in pictures:
        shown_ns[picture.instant][picture.camera_id] = picture.capture_time_ns + picture.age_ns
    whole = [times.values() for times in shown_ns.values() if len(times) == cameras]
    return Spread(len(whole), tuple((max(times) - min(times)) / 1e6 for times in whole))


def instants_apart(pictures: Sequence[TwinPicture], cameras: int) -> int | None:
    """Return how many instants the newest pictures of two cameras were apart at most.

    Counted once every camera has shown one; ``None`` if that never was. Instants that no camera
    has shown, since they were superseded before they were coded, do not count.
    """
    ranks = {n: rank for rank, n in enumerate(sorted({p.instant for p in pictures}))}
    newest: dict[str, int] = {}
    most = None
    for picture in pictures:
        newest[picture.camera_id] = ranks[picture.instant]
        if len(newest) == cameras:
            most = max(most or 0, max(newest.values()) - min(newest.values()))
    return most


@dataclass(frozen=True)
class Case:
    """One way to send the cameras of ``rig``; ``together``: in one session."""

    name: str
    rig: Path
    together: bool
    options: tuple[str, ...]

    @property
    def sessions(self) -> str:
        """The number of sessions, in words."""
        return "one" if self.together else "one each"


@dataclass(frozen=True)
class Outcome:
    """Results of a case: reports by vehicle, pictures shown, bytes on the link, memory."""

    lines: Mapping[str, Lines]
    pictures: Sequence[TwinPicture]
    link_bytes: int
    agent_mb: float


def run_rig(job: EvalRig, console: Console) -> Result:
    """Run every case; return the result. Raises ``RfedgeError`` naming what failed."""
    job.work.mkdir(parents=True, exist_ok=True)
    rows: list[CameraRow] = []
    sessions: list[SessionRow] = []
    for case in _cases(job):
        console.print(f"{case.name}, {case.sessions} session: {case.rig}")
        rig = read_rig(case.rig)
        drive = read_rig_drive(rig)
        found = _measured(case, rig, drive, _outcome(job, case, rig))
        rows += found[0]
        sessions.append(found[1])
    settings = {name: value for name, value in asdict(job).items() if name not in ("out", "work")}
    content = {
        "settings": as_json(settings),
        "sessions": as_json(sessions),
        "rows": as_json(rows),
    }
    return make_result("rig", provenance([job.field]), content)


def _cases(job: EvalRig) -> list[Case]:
    crf = ("--pace", "lockstep")
    delay = ("--rate", f"{job.rate_hz:g}", "--max-delay-ms", f"{job.max_delay_ms:g}")
    cases = [
        Case(name, job.rig, together, options)
        for (name, options), together in itertools.product(
            (("one CRF", crf), ("one delay", delay)), (True, False)
        )
    ]
    if job.many is not None:
        cases.append(Case("one CRF", job.many, True, crf))
    return cases


def _outcome(job: EvalRig, case: Case, rig: Rig) -> Outcome:
    """Run server, link and vehicles; return what they did."""
    work = job.work
    server = [*command_of("mec-server"), "--fields", str(_fields(job)), "--listen", "127.0.0.1:0"]
    server += ["--threads", str(job.threads), "--max-load", "0"]
    report = work / "link.json"
    pictures: list[TwinPicture] = []
    with (
        service("server", server, work) as served,
        TwinReader(served.address, pictures.append, Subscription(encoding=PictureEncoding.I420)),
        service("link", _link_command(job, served, report), work) as link,
    ):
        vehicles = _vehicles(job, case, rig, link)
        agent_mb = _run_together(vehicles, work)
    return Outcome(
        lines={name: read_lines(work / f"{name}.jsonl") for name in vehicles},
        pictures=pictures,
        link_bytes=int(json.loads(report.read_text())["uplink"]["bytes"]),
        agent_mb=agent_mb,
    )


def _fields(job: EvalRig) -> Path:
    """Return a folder that holds the field alone."""
    folder = job.work / "fields"
    folder.mkdir(exist_ok=True)
    for stale in folder.iterdir():
        stale.unlink()
    (folder / job.field.name).symlink_to(job.field.resolve())
    return folder


def _link_command(job: EvalRig, server: Service, report: Path) -> list[str]:
    rates = ["--uplink-bps", f"{job.link_bps:g}", "--downlink-bps", f"{job.link_bps:g}"]
    return [*command_of("rfedge"), "link", "--to", server.address, *rates, "--report", str(report)]


def _vehicles(job: EvalRig, case: Case, rig: Rig, link: Service) -> dict[str, list[str]]:
    """Return the command of each vehicle by its name: one for all cameras, or one for each."""
    common = [*command_of("cav-agent"), "--server", link.address, "--fields", str(_fields(job))]
    common += ["--crf", f"{job.crf:g}", "--effort", job.effort]
    common += ["--threads", str(job.threads), "--give-up-s", "60", *case.options]
    if case.together:
        drives = {"rig": ["--rig", str(case.rig)]}
    else:
        drives = {c.name: ["--drive", str(c.drive), "--camera", c.name] for c in rig.cameras}
    return {
        name: [*common, *drive, "--vehicle", name, "--report", str(job.work / f"{name}.jsonl")]
        for name, drive in drives.items()
    }


def _run_together(commands: Mapping[str, Sequence[str]], work: Path) -> float:
    """Run the vehicles to their end; return their peak memory in sum, MB."""
    running = {}
    for name, command in commands.items():
        with (work / f"{name}.log").open("wb") as log:
            running[name] = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
    memory_kib = 0
    for name, process in running.items():
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        memory_kib += usage.ru_maxrss
        if process.returncode:
            raise RfedgeError(f"vehicle {name} failed, see {work / f'{name}.log'}")
    return memory_kib * 1024 / 1e6


def _measured(
    case: Case, rig: Rig, drive: Sequence[RigInstant], outcome: Outcome
) -> tuple[list[CameraRow], SessionRow]:
    shown = {(p.vehicle_id, p.camera_id, p.epoch, p.sequence): p for p in outcome.pictures}
    rows = []
    for camera in rig.cameras:
        vehicle = "rig" if case.together else camera.name
        lines = [line for line in outcome.lines[vehicle] if line["camera"] == camera.name]
        seen = [
            (drive[line["index"]].pictures[camera.name], found)
            for line in lines
            if (found := shown.get((vehicle, camera.name, line["epoch"], line["sequence"])))
        ]
        rows.append(_camera_row(case, camera, lines, seen))
    return rows, _session_row(case, rig, drive, outcome, rows)


def _camera_row(
    case: Case,
    camera: RigCamera,
    lines: Lines,
    seen: Sequence[tuple[PosedPicture, TwinPicture]],
) -> CameraRow:
    acked = [line for line in lines if line["result"] == "acked"]
    latency = [line["latency_ms"] for line in acked]
    return CameraRow(
        case=case.name,
        sessions=case.sessions,
        camera=camera.name,
        captured=len(lines),
        acked=len(acked),
        payload_bytes=_mean([line["payload_bytes"] for line in acked]) or 0.0,
        packet_bytes=_mean([line["packet_bytes"] for line in acked]) or 0.0,
        crf=_mean([line["crf"] for line in acked]) or 0.0,
        psnr_db=_mean([_psnr_db(picture, found) for picture, found in seen]),
        latency_p50_ms=_percentile(latency, 50),
        latency_p99_ms=_percentile(latency, 99),
    )


def _session_row(
    case: Case, rig: Rig, drive: Sequence[RigInstant], outcome: Outcome, rows: Sequence[CameraRow]
) -> SessionRow:
    k = drive[0].pictures[rig.reference.name].camera.intrinsics
    psnrs = [row.psnr_db for row in rows if row.psnr_db is not None]
    row = SessionRow(
        case=case.name,
        sessions=case.sessions,
        cameras=len(rig.cameras),
        size_px=(k.width_px, k.height_px),
        captured=sum(row.captured for row in rows),
        acked=sum(row.acked for row in rows),
        link_bytes=outcome.link_bytes,
        acked_bytes=round(sum(row.acked * row.packet_bytes for row in rows)),
        psnr_mean_db=_mean(psnrs),
        psnr_lowest_db=min(psnrs, default=None),
        agent_mb=outcome.agent_mb,
    )
    if not case.together:
        return row
    spread = spreads_of(outcome.pictures, len(rig.cameras))
    return replace(
        row,
        instants=spread.whole,
        spread_p50_ms=_percentile(spread.milliseconds, 50),
        spread_p99_ms=_percentile(spread.milliseconds, 99),
        most_instants_apart=instants_apart(outcome.pictures, len(rig.cameras)),
    )


def _psnr_db(picture: PosedPicture, shown: TwinPicture) -> float:
    return psnr(shown.planes.y, i420_from_rgb(picture.read()).y)


def _mean(values: Sequence[float]) -> float | None:
    return statistics.fmean(values) if values else None


def _percentile(values: Sequence[float], percent: float) -> float | None:
    return float(np.percentile(values, percent)) if len(values) else None
