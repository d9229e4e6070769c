"""Sends over every link, a peer or us at a time, and keeps each row as a finished cell."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from itertools import pairwise, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.console import Console

from lab.tcp.wire import wired
from lab.webrtc import EvalWebrtc
from lab.webrtc.bed import FAR_CORE, SUBNET, LinkBed, OurSettings, Schedule
from lab.webrtc.camera import CameraPictures
from lab.webrtc.report import OURS, WebrtcRow, webrtc_parts
from rfcore.errors import BackendUnavailable, RfedgeError
from rfcore.field import load_field
from rfedge.evaluate.clips import Drive, read_drive
from rfedge.evaluate.field_coder import FieldCoder, render_clip
from rfedge.evaluate.runner import Run, program_version
from rfedge.results import rows_of

PACKAGES = {"libwebrtc": "wrtc", "aiortc": "aiortc"}
CRFS = (12.0, 17.0, 22.0, 27.0, 32.0, 37.0, 42.0)
"""CRFs whose quality is measured without a link; those between are interpolated."""
LATE_S = 2.0
"""Pictures of the measured time may be shown so much later, beside round trips."""


@dataclass(frozen=True)
class LinkRates:
    """A link: its rates in Mbit/s one after the other, round trip, and lost packets in percent."""

    rates_mbps: tuple[float, ...]
    rtt_ms: float
    loss_percent: float

    def __str__(self) -> str:
        rates = " to ".join(f"{each:g}" for each in self.rates_mbps)
        return f"{rates} Mbit/s, {self.rtt_ms:g} ms, {self.loss_percent:g} %"


def links_of(job: EvalWebrtc) -> list[LinkRates]:
    """Return every link; a quick run has one."""
    if job.quick:
        return [LinkRates((job.rates_mbps[-1],), job.rtts_ms[0], job.losses[0])]
    made = [
        LinkRates((rate_mbps,), rtt_ms, loss)
        for rate_mbps, rtt_ms, loss in product(job.rates_mbps, job.rtts_ms, job.losses)
    ]
    steps = [] if job.step_mbps is None else [job.step_mbps]
    return made + [LinkRates(step, rtt_ms, 0.0) for step in steps for rtt_ms in job.rtts_ms]


def run_webrtc(job: EvalWebrtc, console: Console) -> dict[str, Any]:
    """Measure every cell that is not there, write the result and print it.

    Raises ``RfedgeError`` without root or a second core, ``BackendUnavailable`` without a peer.
    """
    if os.geteuid() != 0:
        raise RfedgeError("network namespaces need root: run this command as root")
    if (os.cpu_count() or 1) <= FAR_CORE:
        raise RfedgeError("a sender and a receiver need a core each: run this on two cores")
    run = Run.begin("webrtc", job, [job.field], console)
    bench = Bench(job, run, {name: _engine(name) for name in job.peers})
    rows: list[WebrtcRow] = []
    for link in links_of(job):
        peers = [bench.row(link, peer, None) for peer in job.peers]
        shown_db = [row.psnr_db for row in peers if row.psnr_db is not None]
        crfs = dict.fromkeys(crf_at(bench.qualities, db) for db in shown_db)
        rows += [*peers, *(bench.row(link, OURS, crf) for crf in sorted(crfs))]
    content = {
        "hz": bench.drive.name.rate_hz,
        "field_id": bench.field_id,
        "field_bytes": job.field.stat().st_size,
        "frames": {"drive": job.drive, "sha256": bench.drive.digest},
        "engines": list(dict.fromkeys(bench.engines.values())),
        "tcp": tcp_control(),
        "delay_ms": job.delay_ms,
        "effort": job.effort,
        "settle_s": job.settle_s,
        "seconds": job.seconds,
        "rows": rows,
    }
    return run.finish(content, webrtc_parts)


def _engine(peer: str) -> str:
    """Return the package of a peer and its version."""
    package = PACKAGES[peer.partition("-")[0]]
    try:
        return f"{package} {version(package)}"
    except PackageNotFoundError as error:
        raise BackendUnavailable(f"{package} is missing: pip install {package}") from error


def tcp_control() -> str:
    """Return the congestion control of new TCP connections."""
    return Path("/proc/sys/net/ipv4/tcp_congestion_control").read_text().strip()


def crf_at(qualities: Sequence[tuple[float, float]], psnr_db: float) -> float:
    """Return the highest whole CRF that gives a quality, of those between ``qualities``.

    ``qualities``: CRFs ascending, each with its PSNR in dB.
    """
    first, last = qualities[0], qualities[-1]
    wanted = first[0]
    for (crf, db), (next_crf, next_db) in pairwise(qualities):
        if next_db < psnr_db <= db:
            wanted = crf + (db - psnr_db) / (db - next_db) * (next_crf - crf)
    if psnr_db <= last[1]:
        wanted = last[0]
    return float(int(wanted))


@dataclass(frozen=True)
class Bench:
    """What all cells share; ``engines`` are the packages of the peers, with their versions."""

    job: EvalWebrtc
    run: Run
    engines: dict[str, str]

    @cached_property
    def drive(self) -> Drive:
        """The drive."""
        return read_drive(self.job.drive)

    @cached_property
    def camera(self) -> CameraPictures:
        """Its pictures, there and back."""
        return CameraPictures(self.drive.frames)

    @cached_property
    def field_id(self) -> str:
        """The digest of the field."""
        return load_field(self.job.field).field_id

    def key(self, *also: str, **facts: str | float | None) -> dict[str, str | float | int | None]:
        """Return the key of a cell: all that its content depends on, ``also`` the code of it."""
        return {
            **facts,
            "verb": "webrtc",
            "frames": self.drive.digest,
            "hz": self.drive.name.rate_hz,
            "program": program_version(*also),
        }

    @cached_property
    def qualities(self) -> list[tuple[float, float]]:
        """CRFs and the PSNR that the drive has at them, without a link."""
        key = self.key(field=self.field_id, effort=self.job.effort, crfs=str(CRFS))
        rows = self.run.store.rows(key, self._qualities)
        return [(row["crf"], row["psnr_db"]) for row in rows]

    def _qualities(self) -> list[dict[str, Any]]:
        self.run.tell(f"quality at {len(CRFS)} CRFs")
        rendered = render_clip(load_field(self.job.field), self.drive.cameras)
        coder = FieldCoder(rendered, OURS, "", effort=self.job.effort)
        hz = self.drive.name.rate_hz
        coded = [(crf, coder.code(self.drive.frames, hz, crf).psnr_db()) for crf in CRFS]
        return [{"crf": crf, "psnr_db": db} for crf, db in coded]

    def row(self, link: LinkRates, peer: str, crf: float | None) -> WebrtcRow:
        """Return the row of a peer, or of us at a CRF, over a link."""
        job = self.job
        key = self.key(
            *("lab/webrtc", "lab/tcp", "cav_agent", "mec_server"),
            peer=peer,
            engine=self.engines.get(peer, tcp_control()),
            link=str(link),
            seconds=job.seconds,
            settle_s=job.settle_s,
            crf=crf,
            effort=None if crf is None else job.effort,
            delay_ms=None if crf is None else job.delay_ms,
        )
        (kept,) = self.run.store.rows(key, lambda: [asdict(self._measured(link, peer, crf))])
        (row,) = rows_of(WebrtcRow, [kept])
        return row

    def _measured(self, link: LinkRates, peer: str, crf: float | None) -> WebrtcRow:
        job = self.job
        with TemporaryDirectory() as work, wired(
            SUBNET, link.loss_percent, link.rtt_ms, link.rates_mbps
        ) as wire:  # fmt: skip
            schedule = Schedule(job.settle_s, job.seconds, LATE_S + 2e-3 * link.rtt_ms)
            bed = LinkBed(wire, Path(work), self.camera, self.drive.name.rate_hz, schedule)
            if crf is None:
                figures, sent_bytes = bed.peer(*peer.split("-"))
            else:
                us = OurSettings(job.field, self.drive.name.dataset, job.effort, crf)
                figures, sent_bytes = bed.ours(us, job.delay_ms + link.rtt_ms)
        row = WebrtcRow(
            peer=peer,
            rate_bps=1e6 * link.rates_mbps[0],
            step_bps=1e6 * link.rates_mbps[1] if len(link.rates_mbps) > 1 else None,
            rtt_ms=link.rtt_ms,
            loss_percent=link.loss_percent,
            bytes=sent_bytes,
            seconds=job.seconds,
            crf=crf,
            **asdict(figures),
        )
        named = peer if crf is None else f"{peer} at CRF {crf:g}"
        ages = f"p50 {row.p50_ms or 0:.0f}, p99 {row.p99_ms or 0:.0f} ms"
        self.run.tell(
            f"  {link}: {named} {row.mbps:.3f} Mbit/s, {row.psnr_db or 0:.2f} dB, {ages}, "
            f"frozen {row.frozen_percent:.1f} %, {row.shown_hz:.1f} Hz"
        )
        return row
