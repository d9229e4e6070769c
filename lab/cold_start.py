"""``rfedge-lab cold-start``: quality over time of a vehicle that fetches its field as it drives."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from statistics import mean, median
from typing import Annotated, Any

from lab.report import Report
from rfcore.errors import InvalidInput, RfedgeError
from rfedge.arguments import DATASET, FIELD, FOLDER, JSON, field_path
from rfedge.processes import command_of, run_to_end, service
from rfedge.report.tables import Column, Table, print_tables
from rfedge.results import Result, check_result_path, make_result, provenance, rows_of, write_result
from rfedge.samples import sample_path

STARTS = ("empty", "empty", "cached")
"""Caches of the drives over each link."""
SETTLED_S, FIRST_PICTURE_S = 3, 60.0
"""Seconds after the first picture from which quality is compared, and until there must be one."""
NOT_CODED = 51.0
"""CRF that a second counts with in which no picture was answered."""


@dataclass(frozen=True)
class ColdStartRow:
    """A second of a drive. ``crf`` and ``bytes`` are medians of its answered pictures."""

    profile: str
    code: str
    cache: str
    run: int
    fetched_s: float | None = None
    """When the field became whole, in seconds of the drive; None: before it, or not yet."""
    second: int = 0
    """Seconds since the first picture: the part of the field that is drawn first was there."""
    pictures: int = 0
    answered: int = 0
    crf: float | None = None
    bytes: float | None = None


@dataclass(frozen=True)
class EvalColdStart:
    """Drive with an empty and with a full cache over links; quality second by second.

    Server, link and vehicle are processes. `--before` names the folder of the commands of another
    installation, which drives over each link as well.
    """

    before: Annotated[Path | None, FOLDER] = None
    """Folder with `cav-agent` and `mec-server` of an earlier revision."""
    profiles: tuple[str, ...] = ("thin", "steady", "jitter", "teleoperation")
    """Names of link profiles in samples/links."""
    size: str = "320x180"
    """Size of the pictures: so small that links limit them, and not this machine."""
    seconds: float = 20.0
    """Duration of each drive, from its first picture on."""
    max_delay_ms: float = 200.0
    """Time from capture to Ack that every vehicle keeps."""
    field: Annotated[Path, FIELD] = sample_path("fields/street.rff")
    """Field archive that the server holds."""
    drive: Annotated[Path, DATASET] = sample_path("street/transforms_drive_vehicles.json")
    """Drive whose pictures are sent, again and again, at 10 Hz."""
    work: Annotated[Path, FOLDER] = Path("out/eval/cold-start")
    """Folder for logs; it is emptied."""
    out: Annotated[Path, JSON] = Path("out/eval/cold-start.json")
    """The result file to write."""

    def __post_init__(self) -> None:
        check_result_path(self.out)
        if not SETTLED_S < self.seconds <= 600:
            raise InvalidInput("seconds", f"{self.seconds:g} is outside {SETTLED_S}..600 s")

    def run(self) -> None:
        """Drive, print and write the rows."""
        from rich.console import Console

        archive = field_path(self.field)
        shutil.rmtree(self.work, ignore_errors=True)
        (self.work / "server").mkdir(parents=True)
        shutil.copy(archive, self.work / "server")
        sized = [*command_of("rfedge"), "dataset", "convert", str(self.drive), "--size", self.size]
        run_to_end("convert", [*sized, "--out", str(self.work / "drive")], self.work, 300)
        programs = {"after": Path(command_of("cav-agent")[0]).parent}
        if self.before is not None:
            programs = {"before": self.before} | programs
        rows = [
            row
            for profile in self.profiles
            for code, folder in programs.items()
            for run, cache in enumerate(STARTS)
            for row in self._drive(folder, ColdStartRow(profile, code, cache, run))
        ]
        content = {"settings": asdict(self), "rows": rows}
        result = make_result("cold-start", provenance([archive, self.drive]), content)
        write_result(self.out, result)
        print_tables(cold_start_parts(json.loads(self.out.read_text())), Console())

    def _drive(self, programs: Path, row: ColdStartRow) -> Iterator[ColdStartRow]:
        """Drive once; yield a row a second."""
        work = self.work / f"{row.profile}-{row.code}-{row.run}"
        cache, report, log = (work / name for name in ("cache", "report.jsonl", "cav-1.log"))
        work.mkdir()
        if row.cache == "cached":
            shutil.copytree(self.work / "server", cache)
        serve = [str(programs / "mec-server"), "--fields", str(self.work / "server")]
        link = [*command_of("rfedge"), "link", "--profile"]
        link += [str(sample_path(f"links/{row.profile}.toml")), "--to"]
        send = [str(programs / "cav-agent"), "--drive", str(self.work / "drive"), "--loop"]
        send += ["--fields", str(cache), "--report", str(report), "--log", "json"]
        send += ["--max-delay-ms", f"{self.max_delay_ms:g}"]
        with (
            service("mec-server", [*serve, "--listen", "127.0.0.1:0"], work) as server,
            service("link", [*link, server.address], work) as between,
            log.open("wb") as lines,
            subprocess.Popen([*send, "--server", between.address], stderr=lines) as agent,
        ):
            try:
                _await_picture(report, agent)
                time.sleep(self.seconds)
            finally:
                agent.terminate()
        told = [json.loads(line) for line in report.read_text().splitlines()]
        events = [json.loads(line) for line in log.read_text().splitlines()]
        yield from rows_of_drive(row, told, events, int(self.seconds))


def _await_picture(report: Path, agent: subprocess.Popen[bytes]) -> None:
    end_s = time.monotonic() + FIRST_PICTURE_S
    while not (report.exists() and report.stat().st_size):
        if agent.poll() is not None or time.monotonic() > end_s:
            raise RfedgeError(f"no picture within {FIRST_PICTURE_S:g} s; see {report.parent}")
        time.sleep(0.05)


def rows_of_drive(
    row: ColdStartRow,
    told: Sequence[dict[str, Any]],
    events: Sequence[dict[str, Any]],
    seconds: int,
) -> Iterator[ColdStartRow]:
    """Yield a row a second of what an agent's report and log tell."""
    began_s = min(line["capture_time_ns"] for line in told) / 1e9
    whole = [e["timestamp"] for e in events if e["event"] == "field fetched"]
    fetched_s = datetime.fromisoformat(whole[0]).timestamp() - began_s if whole else None
    for second in range(seconds):
        begin_ns = 1e9 * (began_s + second)
        lines = [line for line in told if begin_ns <= line["capture_time_ns"] < begin_ns + 1e9]
        acked = [line for line in lines if line["result"] == "acked"]
        yield replace(
            row,
            fetched_s=fetched_s,
            second=second,
            pictures=len(lines),
            answered=len(acked),
            crf=median(line["crf"] for line in acked) if acked else None,
            bytes=median(line["payload_bytes"] for line in acked) if acked else None,
        )


Drive = list[ColdStartRow]


def _drives(result: Result) -> list[Drive]:
    drives: dict[tuple[str, str, int], Drive] = {}
    for row in rows_of(ColdStartRow, result["rows"]):
        drives.setdefault((row.profile, row.code, row.run), []).append(row)
    return list(drives.values())


def _crf(row: ColdStartRow) -> float:
    return NOT_CODED if row.crf is None else row.crf


def _column(title: str, value: Any, form: str) -> Column:
    """Return a column of the rows of a drive from ``SETTLED_S`` on."""
    return Column(title, lambda drive: value([r for r in drive if r.second >= SETTLED_S]), form)


def cold_start_parts(result: Result) -> Iterator[Table | str]:
    """Yield a sentence and a row a drive."""
    settings = result["settings"]
    yield (
        f"Each line is a drive of {settings['seconds']:g} s at 10 Hz, {settings['size']} px, "
        f"within {settings['max_delay_ms']:g} ms from capture to Ack, and never better than CRF "
        f"23. The last columns count from {SETTLED_S} s after the first picture. That is coded "
        "against the first part of the field; the rest still arrives. A second without an "
        f"answered picture counts as CRF {NOT_CODED:g}."
    )
    made = [
        Column("link", lambda drive: drive[0].profile),
        Column("code", lambda drive: drive[0].code),
        Column("cache", lambda drive: drive[0].cache),
        Column("field whole after s", lambda drive: drive[0].fetched_s, ".1f"),
        _column("CRF median", lambda rows: median(map(_crf, rows)), ".1f"),
        _column("worst second", lambda rows: max(map(_crf, rows)), ".1f"),
        _column("bytes", lambda rows: mean(r.bytes or 0 for r in rows), ".0f"),
        _column(
            "answered %",
            lambda rows: 100 * sum(r.answered for r in rows) / sum(r.pictures for r in rows),
            ".0f",
        ),
    ]
    yield Table("Cold and warm starts", made, _drives(result))


def draw(result: Result, folder: Path, name: str) -> list[Path]:
    """Draw CRF over time, a panel a link."""
    from matplotlib import pyplot as plt

    from rfedge.report.charts import GREY, LINES, STYLE, write_figure

    drives = _drives(result)
    profiles = list(dict.fromkeys(drive[0].profile for drive in drives))
    lines = [["link", "code", "cache", "run", "second", "CRF"]]
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(
            1, len(profiles), figsize=(7.2, 2.4), sharey=True, squeeze=False
        )
        for drive in drives:
            first, axes = drive[0], panels[0][profiles.index(drive[0].profile)]
            colour = GREY if first.cache == "cached" else LINES[first.code == "before"]
            style = "--" if first.code == "before" else "-"
            crf = list(map(_crf, drive))
            axes.plot([row.second for row in drive], crf, style, color=colour, linewidth=1.2)
            axes.set_title(first.profile, fontsize=9)
            axes.set_xlabel("s")
            label = [first.profile, first.code, first.cache, str(first.run)]
            lines += [[*label, str(row.second), f"{_crf(row):.1f}"] for row in drive]
        panels[0][0].set_ylabel("CRF (lower is better)")
        for code, style in (("before", "--"), ("after", "-")):
            panels[0][-1].plot([], [], style, color=LINES[code == "before"], label=f"empty, {code}")
        panels[0][-1].plot([], [], color=GREY, label="cached")
        panels[0][-1].legend(frameon=False, fontsize=7)
    return write_figure(folder / name, figure, lines)


REPORT = Report(
    "cold-start",
    "Cold starts",
    "How good the pictures are of a vehicle that fetches its field over the link it sends them on.",
    cold_start_parts,
    draw,
)
