"""Run the latency experiment: drives and a field in, ``latency.json`` out.

Ours and low-delay x264 of the same preset are coded to the same quality (the CRF is searched in
steps of a half), then played over constant rates and over recorded links.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from rich.console import Console

from rfcore.codec.ladder import Rung
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, load_field
from rfcore.link import DirectionPlan, LinkProfile
from rfcore.link.trace import read_mahimahi
from rfedge.evaluate.cells import CellStore
from rfedge.evaluate.clip import ClipCoder, CodedClip
from rfedge.evaluate.compare import Contest
from rfedge.evaluate.drives import DriveName
from rfedge.evaluate.ladder import LadderClip, measure_rung, render_clip
from rfedge.evaluate.latency import (
    BUDGETS_MS,
    FRAMES_FOR_REQUIREMENT,
    REQUIREMENT,
    needed_rate_bps,
    play,
    repeated,
)
from rfedge.evaluate.own import FieldCoder, see_clip
from rfedge.evaluate.result_file import check_result_path, provenance, write_result
from rfedge.evaluate.rivals import x264_lowdelay
from rfedge.provenance import revision

__all__ = ["LatencyJob", "run_latency"]

RATES_MBPS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
CRF_STEP = 0.5
FIRST_CRF, LOWEST_CRF, HIGHEST_CRF = 27.0, 14.0, 44.0
QUICK_FRAMES, PLAYED_FRAMES = 6, 3000
CURVE_POINTS = 101
Row = dict[str, Any]


@dataclass(frozen=True)
class LatencyJob:
    """What to play; see ``rfedge eval latency --help``."""

    field: Path
    drives: Sequence[str]
    traces: Sequence[Path]
    preset: str
    quality_db: float
    out: Path
    cells: Path
    quick: bool = False

    def __post_init__(self) -> None:
        check_result_path(self.out)
        if not 20 <= self.quality_db <= 50:
            raise InvalidInput("quality_db", f"{self.quality_db} dB is outside 20..50 dB")


@dataclass(frozen=True)
class Sender:
    """A method at one quality: its frames, and what both ends compute, stage by stage."""

    contest: Contest
    method: str
    clip: CodedClip
    stage_ms: dict[str, float]

    @property
    def facts(self) -> Row:
        """What every row says about the sender."""
        mse = float(self.clip.luma_mse[1:].mean())
        return {
            "scene": self.contest.scene,
            "hz": self.contest.rate_hz,
            "method": self.method,
            "crf": self.clip.point,
            "psnr_db": float(10 * np.log10(255.0**2 / mse)),
        }


def run_latency(job: LatencyJob, console: Console) -> Row:
    """Code, play, write ``job.out``, and return its content."""
    names = [DriveName.parse(text) for text in job.drives]
    links = list(_links(job.traces))
    field = load_field(job.field)
    console.print(
        f"{2 * len(names)} clips to code at about 5 CRFs each, {len(links)} links to play them over"
    )
    began_s = monotonic()
    senders = [s for name in names for s in _senders(job, name, field, console)]
    console.print(f"coded in {monotonic() - began_s:.0f} s")
    rows = [_row(sender, name, plan) for sender in senders for name, plan in links]
    result = {
        "case": "latency",
        **provenance(revision()),
        "quick": job.quick,
        "field_id": field.field_id,
        "field_psnr_db": {s.contest.scene: s.contest.field_psnr_db for s in senders},
        "frames": {s.contest.scene: s.contest.frames_digest for s in senders},
        "traces": {path.stem: hashlib.sha256(path.read_bytes()).hexdigest() for path in job.traces},
        "played_frames": PLAYED_FRAMES,
        "requirement": {"share": REQUIREMENT, "frames_needed": FRAMES_FOR_REQUIREMENT},
        "needed": [_needed(sender) for sender in senders],
        "rows": rows,
    }
    write_result(job.out, result)
    return result


def _links(traces: Sequence[Path]) -> Iterator[tuple[str, DirectionPlan]]:
    for rate_mbps in RATES_MBPS:
        yield f"{rate_mbps:g} Mbit/s", DirectionPlan(LinkProfile(1e6 * rate_mbps))
    for path in traces:
        trace = read_mahimahi(path)
        yield path.stem, DirectionPlan(LinkProfile(trace.mean_rate_bps), (trace,))


def _senders(
    job: LatencyJob, name: DriveName, field: RadianceField, console: Console
) -> Iterator[Sender]:
    clip = LadderClip.of(read_dataset(name.dataset), QUICK_FRAMES if job.quick else None)
    seen = see_clip(field, clip.cameras)
    contest = Contest(name.scene, name.rate_hz, clip.frames, clip.digest, None)
    store = CellStore(job.cells)
    ours = FieldCoder(seen, f"rfedge-{job.preset}", revision(), preset=job.preset)
    coded = _at_quality(contest, ours, job.quality_db, store)
    yield Sender(contest, ours.name, coded, _own_stages(job, clip, field, coded.point))
    rival = x264_lowdelay(job.preset)
    coded = _at_quality(contest, rival, job.quality_db, store)
    stages = {"sender encode": coded.cpu_ms / len(coded.frame_bytes)}
    yield Sender(contest, rival.name, coded, stages)
    console.print(f"  {name.scene} {name.rate_hz:g} Hz")


def _own_stages(
    job: LatencyJob, clip: LadderClip, field: RadianceField, crf: float
) -> dict[str, float]:
    """Return the milliseconds of both ends, from the ladder's measurement of the full rung."""
    rung = Rung(preset=job.preset)
    row = measure_rung(clip, render_clip(field, clip, rung.quality), rung, crf)
    ours = {f"sender {name}": ms for name, ms in row["sender_stage_ms"].items()}
    return ours | {f"receiver {name}": ms for name, ms in row["receiver_stage_ms"].items()}


def _at_quality(
    contest: Contest, coder: ClipCoder, quality_db: float, store: CellStore
) -> CodedClip:
    """Return the clip at the highest CRF, in steps of a half, that is not below ``quality_db``."""

    def coded(crf: float) -> CodedClip:
        key = contest.cell_key(coder, crf)
        return store.clip(key, lambda: coder.code(contest.frames, contest.rate_hz, crf))

    low, high = LOWEST_CRF, HIGHEST_CRF
    crf = FIRST_CRF
    while high - low > CRF_STEP:
        good = 10 * np.log10(255.0**2 / coded(crf).luma_mse[1:].mean()) >= quality_db
        low, high = (crf, high) if good else (low, crf)
        crf = low + CRF_STEP * max(1, round((high - low) / 2 / CRF_STEP))
    return coded(low)


def _row(sender: Sender, name: str, plan: DirectionPlan) -> Row:
    sizes = repeated(sender.clip.frame_bytes.tolist(), PLAYED_FRAMES)
    played = play(sizes, sender.contest.rate_hz, plan)
    computing_ms = sum(sender.stage_ms.values())
    curve = [played.quantile_ms(share) for share in np.linspace(0, 1, CURVE_POINTS)]
    return {
        **sender.facts,
        "link": name,
        "rate_bps": plan.profile.rate_bps,
        "frames": played.frames,
        "dropped": played.dropped,
        "tau_ms": _spread(played.tau_ms),
        "network_ms": _spread(played.network_ms),
        "network_p99_ms": _finite(played.quantile_ms(0.99)),
        "end_to_end_p50_ms": _finite(played.quantile_ms(0.5) + computing_ms),
        "end_to_end_p99_ms": _finite(played.quantile_ms(0.99) + computing_ms),
        "share_within": {f"{ms:g}": played.share_within(ms) for ms in BUDGETS_MS},
        "network_quantiles_ms": [_finite(ms) for ms in curve],
    }


def _needed(sender: Sender) -> Row:
    sizes = repeated(sender.clip.frame_bytes.tolist(), PLAYED_FRAMES)
    rate_hz = sender.contest.rate_hz
    return {
        **sender.facts,
        "kbit_per_frame": 8e-3 * float(sender.clip.frame_bytes[1:].mean()),
        "largest_kbit": 8e-3 * float(sender.clip.frame_bytes[1:].max()),
        "first_frame_kbit": 8e-3 * float(sender.clip.frame_bytes[0]),
        "uplink_bps_p99_within": {
            f"{ms:g}": needed_rate_bps(sizes, rate_hz, ms) for ms in BUDGETS_MS
        },
        "stage_ms": sender.stage_ms,
    }


def _spread(values: Any) -> dict[str, float]:
    return {
        "mean": float(np.mean(values)),
        "p50": float(np.quantile(values, 0.5)),
        "p99": float(np.quantile(values, 0.99)),
    }


def _finite(value: float) -> float | None:
    """JSON has no infinity: a quantile of frames that never came is null."""
    return value if np.isfinite(value) else None
