"""Measure how long frames take over links, on a virtual clock.

Ours and low-delay x264 are coded to the same quality (the CRF is searched in steps of a half), then
sent over constant rates and over recorded links. A clip is sent again and again without its first
frame, captured at its rate. At most ``WINDOW`` frames are under way, as in the product; a frame
that is dropped before it is coded counts as late.

``play``: as if nothing had to be computed, what an uplink alone makes of the frames. ``tau`` is a
message's own transmission time; the network latency adds waiting behind earlier frames and the
link's propagation. A frame that finds too many under way is dropped.

``show``: from capture to shown, with the pose ahead of its frame and without. Either end works at
one frame at a time, for as long as that very frame took when it was measured, and frames wait for
it: a mean would hide what a slow frame does to those behind it. A vehicle begins with the newest
frame that was captured, and older ones are dropped; it hears that a frame is shown after the link's
delay.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from lab.latency import EvalLatency
from lab.latency.report import NeededRow, PlayedRow, ShownRow, latency_parts
from rfcore.codec.sender.ladder import Rung
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, load_field
from rfcore.link.plan import DirectionPlan
from rfcore.link.shaper import LinkProfile
from rfcore.link.traces import read_mahimahi
from rfedge.evaluate.clips import ONE_RUN, Clip, ClipCoder, CodedClip, Drive, DriveName, read_drive
from rfedge.evaluate.field_coder import FieldCoder, render_clip
from rfedge.evaluate.ladder.measure import measure_frames, time_renders
from rfedge.evaluate.rivals import x264_lowdelay
from rfedge.evaluate.runner import Run, coded_clip, program_version
from rfedge.jobs import CellStore

WINDOW = 2
"""Frames of one camera under way (``mec_server.config.SessionLimits``)."""
CAPTURED = 1e-9
"""Share of a frame's period by which rounding may miss the moment of its capture."""
BUDGETS_MS = (5.0, 10.0)
"""Network latencies a digital twin asks for (the paper: 5 to 10 ms)."""
REQUIREMENT = 0.99999
"""Share of frames that must be so quick (the paper)."""
SHOWN_WITHIN_MS = (50.0, 100.0, 200.0)
"""Time from capture to shown."""
FRAMES_FOR_REQUIREMENT = math.ceil(math.log(0.05) / math.log(REQUIREMENT))
"""Frames in time without a single late one before 99.999 % may be claimed with 95 % confidence."""
F64 = NDArray[np.float64]
T = TypeVar("T")


@dataclass(frozen=True)
class FrameWork:
    """The bytes of one frame on the link, and its processor time at both ends."""

    size_bytes: int
    sender_ms: float
    receiver_ms: float
    ahead: AheadWork | None = None


@dataclass(frozen=True)
class AheadWork:
    """The bytes of a pose ahead of its frame on the link, the sender's time until it is known, and
    the receiver's that needs nothing else."""

    size_bytes: int
    located_ms: float
    receiver_ms: float


@dataclass(frozen=True)
class Latencies:
    """``latency_ms`` [N] of the frames that were sent; ``dropped`` ones never come."""

    latency_ms: F64
    dropped: int

    @property
    def frames(self) -> int:
        """Number of frames that were captured."""
        return len(self.latency_ms) + self.dropped

    def share_within(self, budget_ms: float) -> float:
        """Return the share of all captured frames that came within ``budget_ms``."""
        return float((self.latency_ms <= budget_ms).sum() / self.frames)

    def quantile_ms(self, share: float) -> float:
        """Return the latency that ``share`` of the captured frames stay within, or infinity."""
        late = np.full(self.dropped, np.inf)
        return float(np.quantile(np.concatenate([self.latency_ms, late]), share, method="higher"))


@dataclass(frozen=True)
class ShownLatencies(Latencies):
    """Times from capture to shown; ``sender_busy`` and ``receiver_busy``: the share of the time for
    which either end computed."""

    sender_busy: float
    receiver_busy: float


@dataclass(frozen=True)
class Played(Latencies):
    """A clip over a link, from sending to arrival; ``tau_ms`` [N]: transmission alone."""

    tau_ms: F64

    @property
    def network_ms(self) -> F64:
        """Waiting, transmission and the link's delay."""
        return self.latency_ms


def show(frames: Sequence[FrameWork], rate_hz: float, link: DirectionPlan) -> ShownLatencies:
    """Capture a frame every ``1 / rate_hz`` seconds, send what can be sent over ``link``, show it.

    ``frames`` must not be empty.
    """
    machine = link.unbounded().link()
    answer_s = link.profile.delay_s
    heard_s = [0.0] * WINDOW
    """Time at which the vehicle heard of each frame it sent, in the order of sending."""
    sender_free_s = receiver_free_s = 0.0
    latency_ms: list[float] = []
    sent: list[FrameWork] = []
    next_frame = 0
    while next_frame < len(frames):
        begin_s = max(next_frame / rate_hz, sender_free_s, heard_s[-WINDOW])
        newest = min(len(frames) - 1, int(begin_s * rate_hz + CAPTURED))
        work, receiver_ms = frames[newest], frames[newest].receiver_ms
        ahead, begun_s = work.ahead, math.inf
        if ahead is not None:
            located_s = begin_s + ahead.located_ms / 1e3
            machine.pop_due(located_s)
            pose_s = machine.push(-1 - newest, ahead.size_bytes, located_s).due_s
            begun_s = max(pose_s, receiver_free_s)
        sender_free_s = begin_s + work.sender_ms / 1e3
        machine.pop_due(sender_free_s)
        arrived_s = machine.push(newest, work.size_bytes, sender_free_s).due_s
        if ahead is not None and begun_s < arrived_s:  # else the frame finds nothing begun
            receiver_free_s = begun_s + ahead.receiver_ms / 1e3
            receiver_ms -= ahead.receiver_ms
        receiver_free_s = max(arrived_s, receiver_free_s) + receiver_ms / 1e3
        heard_s.append(receiver_free_s + answer_s)
        latency_ms.append(1e3 * (receiver_free_s - newest / rate_hz))
        sent.append(work)
        next_frame = newest + 1
    lasted_ms = 1e3 * max(receiver_free_s, len(frames) / rate_hz)
    return ShownLatencies(
        np.array(latency_ms),
        len(frames) - len(sent),
        sum(work.sender_ms for work in sent) / lasted_ms,
        sum(work.receiver_ms for work in sent) / lasted_ms,
    )


def repeated(frames: Sequence[T], count: int) -> list[T]:
    """Return ``count`` frames: the clip without its first one, which a stream sends once, again and
    again."""
    steady = list(frames)[1:]
    if not steady:
        raise InvalidInput("frames", "a clip needs at least two frames")
    return [steady[k % len(steady)] for k in range(count)]


def play(frame_bytes: Sequence[int], rate_hz: float, link: DirectionPlan) -> Played:
    """Send a frame of each size, one every ``1 / rate_hz`` seconds, over ``link``."""
    machine = link.unbounded().link()
    due: list[float] = []
    tau, network = [], []
    dropped = 0
    for index, size in enumerate(frame_bytes):
        now = index / rate_hz
        machine.pop_due(now)
        due = [at for at in due if at > now]
        if len(due) >= WINDOW:
            dropped += 1
            continue
        delivery = machine.push(index, size, now)
        due.append(delivery.due_s)
        tau.append(1e3 * (delivery.end_s - delivery.start_s))
        network.append(1e3 * (delivery.due_s - now))
    return Played(np.array(network), dropped, np.array(tau))


def needed_rate_bps(
    frame_bytes: Sequence[int], rate_hz: float, budget_ms: float, share: float = 0.99
) -> float:
    """Return the lowest constant rate, to 0.5 %, at which ``share`` of the frames come in time."""

    def in_time(rate_bps: float) -> bool:
        plan = DirectionPlan(LinkProfile(rate_bps))
        return play(frame_bytes, rate_hz, plan).quantile_ms(share) <= budget_ms

    return _lowest(in_time, 1e4, 1e10)


def _lowest(holds: Callable[[float], bool], low: float, high: float) -> float:
    """Return the lowest value for which ``holds``, which is monotonic, by halving in logarithms."""
    if not holds(high):
        raise InvalidInput("budget", f"not even {high:g} bit/s are enough")
    while high > 1.005 * low:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


RATES_MBPS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
CRF_STEP = 0.5
FIRST_CRF, LOWEST_CRF, HIGHEST_CRF = 27.0, 14.0, 44.0
PLAYED_FRAMES = 3000
CURVE_POINTS = 101
TIMED = 3
"""Times that a frame's work is measured; the least counts: what else the machine does adds to it.
"""


EndsMs = list[tuple[float, ...]]
"""Processor time of each frame at the sender and at the receiver; ours with all of
``FrameTimes``."""
AHEAD_BYTES = 15
"""A pose ahead as a message, usually."""


@dataclass(frozen=True)
class Sender:
    """A method at one quality: its frames, what both ends compute for them stage by stage, and what
    each frame takes."""

    clip: Clip
    method: str
    coded: CodedClip
    stage_ms: dict[str, float]
    work: Sequence[FrameWork]

    @property
    def facts(self) -> dict[str, Any]:
        """The values that every row has of the sender."""
        return {
            "scene": self.clip.scene,
            "hz": self.clip.rate_hz,
            "method": self.method,
            "crf": self.coded.point,
            "psnr_db": self.coded.psnr_db(),
        }


def run_latency(job: EvalLatency, console: Console) -> dict[str, Any]:
    """Code what is not there yet, play it, write the result and print its rows."""
    names = [DriveName.parse(text) for text in job.drives]
    links = list(_links(job.traces))
    run = Run.begin("latency", job, [job.field, *job.traces], console)
    field = load_field(job.field)
    run.tell(
        f"{2 * len(names)} clips to code at about 5 CRFs each, {len(links)} links to play them over"
    )
    began_s = monotonic()
    senders = [s for name in names for s in _senders(job, name, field, run)]
    run.tell(f"coded in {monotonic() - began_s:.0f} s")
    rows = [_row(sender, name, plan) for sender in senders for name, plan in links]
    slow = ("4 Mbit/s, 20 ms", DirectionPlan(LinkProfile(4e6, delay_s=0.02)))
    shown = [
        row
        for sender in senders
        for name, plan in (*links, slow)
        for row in _shown(sender, name, plan)
    ]
    content = {
        "field_id": field.field_id,
        "field_psnr_db": {s.clip.scene: s.clip.field_psnr_db for s in senders},
        "frames": {s.clip.scene: s.clip.frames_digest for s in senders},
        "traces": {path.stem: hashlib.sha256(path.read_bytes()).hexdigest() for path in job.traces},
        "played_frames": PLAYED_FRAMES,
        "requirement": {"share": REQUIREMENT, "frames_needed": FRAMES_FOR_REQUIREMENT},
        "needed": [_needed(sender) for sender in senders],
        "rows": rows,
        "shown": shown,
    }
    return run.finish(content, latency_parts)


def _links(traces: Sequence[Path]) -> Iterator[tuple[str, DirectionPlan]]:
    for rate_mbps in RATES_MBPS:
        yield f"{rate_mbps:g} Mbit/s", DirectionPlan(LinkProfile(1e6 * rate_mbps))
    for path in traces:
        trace = read_mahimahi(path)
        yield path.stem, DirectionPlan(LinkProfile(trace.mean_rate_bps), (trace,))


def _senders(job: EvalLatency, name: DriveName, field: RadianceField, run: Run) -> Iterator[Sender]:
    drive = read_drive(name, ONE_RUN if job.quick else None)
    rendered, clip = render_clip(field, drive.cameras), drive.clip()
    ours = FieldCoder(
        rendered, f"rfedge-{job.effort}", program_version("lab/latency"), effort=job.effort
    )
    coded = at_quality(clip, ours, job.quality_db, run.store)
    stages, ends_ms = _own_times(job, drive, field, coded.point)
    yield Sender(clip, ours.name, coded, stages, _work(coded, ends_ms))
    rival = x264_lowdelay(job.preset)
    coded = at_quality(clip, rival, job.quality_db, run.store)
    ends_ms = _least(rival.frames_ms(clip.frames, clip.rate_hz, coded.point) for _ in range(TIMED))
    encode_ms, decode_ms = np.quantile(ends_ms[1:], 0.25, axis=0).tolist()
    stages = {"sender encode": encode_ms, "receiver decode": decode_ms}
    yield Sender(clip, rival.name, coded, stages, _work(coded, ends_ms))
    run.tell(f"  {name.scene} {name.rate_hz:g} Hz")


def _own_times(
    job: EvalLatency, drive: Drive, field: RadianceField, crf: float
) -> tuple[dict[str, float], EndsMs]:
    """Return the milliseconds of both ends, stage by stage, from the ladder's measurement of the
    full rung, and those of each frame."""
    rung = Rung(effort=job.effort)
    measured = [
        measure_frames(drive, time_renders(field, drive, rung.quality), rung, crf)
        for _ in range(TIMED)
    ]
    row = measured[0][0]
    ours = {f"sender {name}": ms for name, ms in row["sender_stage_ms"].items()}
    ours |= {f"receiver {name}": ms for name, ms in row["receiver_stage_ms"].items()}
    return ours, _least(ends_ms for _, ends_ms in measured)


def _least(measured: Iterable[Sequence[tuple[float, ...]]]) -> EndsMs:
    """Return, frame by frame, the least that either end took."""
    return list(map(tuple, np.min(np.array(list(measured)), axis=0).tolist()))


def _work(coded: CodedClip, ends_ms: EndsMs) -> list[FrameWork]:
    sizes = coded.frame_bytes.tolist()
    return [
        FrameWork(size, ms[0], ms[1], AheadWork(AHEAD_BYTES, ms[2], ms[3]) if ms[2:] else None)
        for size, ms in zip(sizes, ends_ms, strict=True)
    ]


def at_quality(clip: Clip, coder: ClipCoder, quality_db: float, store: CellStore) -> CodedClip:
    """Return the clip at the highest CRF, in steps of a half, that is not below ``quality_db``."""
    low, high = LOWEST_CRF, HIGHEST_CRF
    crf = FIRST_CRF
    while high - low > CRF_STEP:
        good = coded_clip(clip, coder, crf, store).psnr_db() >= quality_db
        low, high = (crf, high) if good else (low, crf)
        crf = low + CRF_STEP * max(1, round((high - low) / 2 / CRF_STEP))
    return coded_clip(clip, coder, low, store)


def _row(sender: Sender, name: str, plan: DirectionPlan) -> PlayedRow:
    sizes = repeated(sender.coded.frame_bytes.tolist(), PLAYED_FRAMES)
    played = play(sizes, sender.clip.rate_hz, plan)
    curve = [played.quantile_ms(share) for share in np.linspace(0, 1, CURVE_POINTS)]
    return PlayedRow(
        **sender.facts,
        link=name,
        rate_bps=plan.profile.rate_bps,
        frames=played.frames,
        dropped=played.dropped,
        tau_ms=_spread(played.tau_ms),
        network_ms=_spread(played.network_ms),
        network_p99_ms=_finite(played.quantile_ms(0.99)),
        share_within={f"{ms:g}": played.share_within(ms) for ms in BUDGETS_MS},
        network_quantiles_ms=[_finite(ms) for ms in curve],
    )


def _shown(sender: Sender, name: str, plan: DirectionPlan) -> Iterator[ShownRow]:
    """Yield the row of a link; of ours one without poses ahead and one with them."""
    plain = [replace(work, ahead=None) for work in sender.work]
    yield _shown_row(sender, plain, name, plan)
    if plain != list(sender.work):
        yield _shown_row(sender, sender.work, name, plan)


def _shown_row(
    sender: Sender, work: Sequence[FrameWork], name: str, plan: DirectionPlan
) -> ShownRow:
    shown = show(repeated(work, PLAYED_FRAMES), sender.clip.rate_hz, plan)
    width_px, height_px = sender.clip.frames[0].size_px
    return ShownRow(
        **sender.facts,
        width_px=width_px,
        height_px=height_px,
        link=name,
        rate_bps=plan.profile.rate_bps,
        frames=shown.frames,
        dropped=shown.dropped,
        sent_ms=_spread(shown.latency_ms),
        shown_p50_ms=_finite(shown.quantile_ms(0.5)),
        shown_p99_ms=_finite(shown.quantile_ms(0.99)),
        share_within={f"{ms:g}": shown.share_within(ms) for ms in SHOWN_WITHIN_MS},
        sender_busy_percent=100 * shown.sender_busy,
        receiver_busy_percent=100 * shown.receiver_busy,
        pose_ahead=work[0].ahead is not None,
    )


def _needed(sender: Sender) -> NeededRow:
    sizes = repeated(sender.coded.frame_bytes.tolist(), PLAYED_FRAMES)
    rate_hz = sender.clip.rate_hz
    return NeededRow(
        **sender.facts,
        kbit_per_frame=8e-3 * sender.coded.bytes_per_frame(),
        largest_kbit=8e-3 * float(sender.coded.frame_bytes[1:].max()),
        first_frame_kbit=8e-3 * float(sender.coded.frame_bytes[0]),
        uplink_bps_p99_within={f"{ms:g}": needed_rate_bps(sizes, rate_hz, ms) for ms in BUDGETS_MS},
        stage_ms=sender.stage_ms,
    )


def _spread(values: Any) -> dict[str, float]:
    return {
        "mean": float(np.mean(values)),
        "p50": float(np.quantile(values, 0.5)),
        "p99": float(np.quantile(values, 0.99)),
    }


def _finite(value: float) -> float | None:
    """JSON has no infinity: a quantile of frames that never came is null."""
    return value if np.isfinite(value) else None
