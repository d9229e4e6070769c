"""Drives over lossy links on a virtual clock: real pictures, session, rate control and coder.

What is modelled is TCP (``rfcore.link.lossy``) and the times that both ends compute. A stream that
the session gives up is opened again over a new connection. No picture is damaged: TCP delivers
every byte, late. A freeze is a gap between pictures of at least max(3 d, d + 150 ms), d their mean
distance (W3C webrtc-stats, ``freezeCount``).
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache
from statistics import fmean, median
from typing import Any

import numpy as np
from rich.console import Console

from cav_agent.config import AgentLimits
from cav_agent.frames import Capture, EncodedFrame, EncodeJob
from cav_agent.pipeline import Pipeline
from cav_agent.rate_control import RateControl
from cav_agent.session import AgentSession, LinkState
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.field import Renderer, load_field
from rfcore.link.lossy import LossyLink, PacketLoss
from rfcore.link.plan import DirectionPlan, LinkPlan
from rfcore.link.shaper import Connection, LinkProfile
from rfcore.metrics import psnr_of_mse
from rfcore.views import PosedPicture
from rfcore.wire.messages import (
    OUR_CONTRACT,
    Ack,
    CameraDescription,
    Credit,
    Frame,
    Hello,
    StageTimes,
    Welcome,
)
from rfedge.evaluate.clips import Drive, luma_mse, read_drive
from rfedge.evaluate.field_coder import RenderedClip, render_clip
from rfedge.evaluate.lossy_link import EvalLossyLink
from rfedge.evaluate.runner import Run, program_version
from rfedge.report.tables import Column, Table
from rfedge.results import Result, rows_of

CAMERA = "front"
WINDOW = 2
"""Frames of one camera under way (``mec_server.config.SessionLimits``)."""
SETTLING_S = 3.0
ANSWER_BYTES = 160
FRAMING_BYTES = 14
"""HTTP/2 and gRPC around a message."""
REOPEN_RTTS = 3
"""Handshake, Hello and Welcome of a stream that is opened again."""
QUICK_S = 8.0
MAX_KEPT = 64
"""Renders of 640x360 are 4.6 MB each."""


@dataclass(frozen=True)
class LossyLinkRow:
    """One drive over one link."""

    loss_percent: float
    rate_mbps: float
    shown_hz: float
    sent_mbps: float
    age_p50_ms: float
    age_p99_ms: float
    frozen_percent: float
    psnr_db: float
    """Luma PSNR of the shown pictures, by their mean squared error."""
    streams_lost: int = 0
    seed: int | None = None
    """Seed of the losses; None: a result of one seed, which its ``link`` names."""


class _KeptRenders:
    """A field that keeps its last renders: a drive is played forth and back."""

    def __init__(self, renderer: Renderer) -> None:
        self.render = lru_cache(MAX_KEPT)(renderer.render)


def _spread(heading: str, name: str, form: str) -> Column:
    """Return a column of the median over the drives of a link, with the range."""

    def text(drives: Sequence[LossyLinkRow]) -> str:
        values = [getattr(drive, name) for drive in drives]
        middle = format(median(values), form)
        ends = f" ({min(values):{form}}..{max(values):{form}})"
        return middle + (ends if len(values) > 1 else "")

    return Column(heading, text)


COLUMNS = (
    Column("loss %", lambda drives: drives[0].loss_percent, "g"),
    Column("link Mbit/s", lambda drives: drives[0].rate_mbps, "g"),
    _spread("age p50 ms", "age_p50_ms", ".0f"),
    _spread("age p99 ms", "age_p99_ms", ".0f"),
    _spread("frozen %", "frozen_percent", ".0f"),
    Column("shown Hz", lambda drives: median(drive.shown_hz for drive in drives), ".1f"),
    Column("PSNR dB", lambda drives: median(drive.psnr_db for drive in drives), ".1f"),
    Column("sent Mbit/s", lambda drives: median(drive.sent_mbps for drive in drives), ".2f"),
    Column("streams lost", lambda drives: sum(drive.streams_lost for drive in drives)),
)


@dataclass(frozen=True)
class Picture:
    """A picture that the server has decoded."""

    captured_s: float
    shown_s: float
    sent_bytes: int
    mse: float


def lossy_link_parts(result: Result) -> Iterator[Table | str]:
    """Yield what each link makes of the drive."""
    frames, link = result["frames"], result["link"]
    width, height = frames["size_px"]
    yield (
        f"`{frames['drive']}`, {width}x{height} px at {frames['hz']:g} Hz, "
        f"{result['seconds']:g} s, played forth and back, over TCP (CUBIC), round trip "
        f"{link['rtt_ms']:g} ms; `cav-agent --max-delay-ms {result['max_delay_ms']:g}`. Age: from "
        f"capture to decoded, with {result['vehicle_ms']:g} ms at the vehicle and "
        f"{result['server_ms']:g} at the server. "
        "Frozen: time in gaps between shown pictures of at least max(3 d, d + 150 ms), d their "
        "mean distance (freezes in W3C's webrtc-stats). No picture is damaged. Drives over each "
        f"link that loses packets: {link.get('seeds', 1)}; of several, median (lowest..highest)."
    )
    drives: dict[tuple[float, float], list[LossyLinkRow]] = {}
    for row in rows_of(LossyLinkRow, result["rows"]):
        drives.setdefault((row.loss_percent, row.rate_mbps), []).append(row)
    title = (
        f"1 camera of {width}x{height} px at {frames['hz']:g} Hz, "
        f"kept within {result['max_delay_ms']:g} ms by its quality"
    )
    yield Table(title, COLUMNS, list(drives.values()))


def run_lossy_link(job: EvalLossyLink, console: Console) -> dict[str, Any]:
    """Drive over every link, write the result and print its rows."""
    run = Run.begin("lossy-link", job, [job.field], console)
    renderer = load_field(job.field)
    drive = read_drive(job.drive, None, (renderer, job.field))
    kept = [replace(picture, read=cache(picture.read)) for picture in drive.pictures]
    drive, renders = replace(drive, pictures=kept), _KeptRenders(renderer)
    rendered = render_clip(renderer, drive.cameras)
    seconds = QUICK_S if job.quick else job.seconds
    rows: list[LossyLinkRow] = []
    seeds = range(job.seed, job.seed + job.seeds)
    for loss_percent, rate_mbps, seed in itertools.product(job.losses, job.rates_mbps, seeds):
        if loss_percent == 0 and seed > job.seed:
            continue  # without losses all drives are one
        key = {
            "verb": "lossy-link",
            "field": renderer.field_id,
            "frames": drive.digest,
            "hz": drive.name.rate_hz,
            "loss_percent": loss_percent,
            "rate_mbps": rate_mbps,
            "seconds": seconds,
            "seed": seed,
            "program": program_version("cav_agent", "rfedge/evaluate/lossy_link"),
            **{name: getattr(job, name) for name in _OPTIONS},
        }

        def measured(
            loss: float = loss_percent, rate: float = rate_mbps, seed: int = seed
        ) -> list[dict[str, Any]]:
            plan = _plan(job, loss, rate, seed)
            driven = LossyDrive(job, drive, renders, rendered, plan)
            return [asdict(driven.row(seconds, loss, rate, seed))]

        (row,) = rows_of(LossyLinkRow, run.store.rows(key, measured))
        rows.append(row)
        run.tell(
            f"{loss_percent:g} % lost, {rate_mbps:g} Mbit/s, seed {seed}: "
            f"age p99 {row.age_p99_ms:.0f} ms"
        )
    k = drive.cameras[0].intrinsics
    content = {
        "field_id": renderer.field_id,
        "frames": {
            "drive": job.drive,
            "hz": drive.name.rate_hz,
            "size_px": [k.width_px, k.height_px],
            "sha256": drive.digest,
        },
        "seconds": seconds,
        "link": {
            "rtt_ms": job.rtt_ms,
            "loss_burst": job.loss_burst,
            "seed": job.seed,
            "seeds": job.seeds,
        },
        "max_delay_ms": job.max_delay_ms,
        "vehicle_ms": job.vehicle_ms,
        "server_ms": job.server_ms,
        "rows": rows,
    }
    return run.finish(content, lossy_link_parts)


_OPTIONS = ("rtt_ms", "loss_burst", "max_delay_ms", "vehicle_ms", "server_ms")


def _plan(job: EvalLossyLink, loss_percent: float, rate_mbps: float, seed: int) -> LinkPlan:
    profile = LinkProfile(1e6 * rate_mbps, job.rtt_ms / 2e3)
    up, down = (DirectionPlan(profile, seed=f"{seed}/{way}") for way in ("up", "down"))
    return LinkPlan(up, down).with_loss(PacketLoss(loss_percent, job.loss_burst))


class LossyDrive:
    """A vehicle, a server that answers after a while, and a link between them."""

    def __init__(
        self,
        job: EvalLossyLink,
        drive: Drive,
        renderer: Renderer,
        rendered: RenderedClip,
        plan: LinkPlan,
    ) -> None:
        self._drive, self._rendered = drive, rendered
        self._vehicle_s, self._server_s = job.vehicle_ms / 1e3, job.server_ms / 1e3
        self._reopen_s = REOPEN_RTTS * job.rtt_ms / 1e3
        self._up: LossyLink[Any] = plan.uplink.lossy_link(plan.downlink)
        self._down: LossyLink[Any] = plan.downlink.lossy_link(plan.uplink)
        k = drive.cameras[0].intrinsics
        config = CodecConfig(k.width_px, k.height_px)
        self._pipeline = Pipeline(renderer, config, lambda: 0)
        camera = CameraDescription(CAMERA, k, self._pipeline.header, drive.name.rate_hz)
        hello = Hello("cav-1", (camera,), ("0" * 64,), OUR_CONTRACT)
        control = RateControl(job.max_delay_ms / 1e3)
        self._session = AgentSession(hello, AgentLimits(), control)
        self._decoder = DeltaDecoder(self._pipeline.header)
        self._state = self._decoder.start()
        self._connection = Connection()
        self._answered = self._lost = 0
        self._events: list[tuple[float, int, Any]] = []
        self._order = itertools.count()
        self.shown: list[Picture] = []

    def row(self, seconds: float, loss_percent: float, rate_mbps: float, seed: int) -> LossyLinkRow:
        """Drive, and return the figures after the first seconds."""
        self.run(seconds)
        length_s = seconds - SETTLING_S
        shown = [p for p in self.shown if SETTLING_S <= p.captured_s < seconds]
        ages_ms = 1e3 * np.array([p.shown_s - p.captured_s for p in shown] or [math.nan])
        return LossyLinkRow(
            loss_percent,
            rate_mbps,
            len(shown) / length_s,
            8e-6 * sum(p.sent_bytes for p in shown) / length_s,
            float(np.percentile(ages_ms, 50)),
            float(np.percentile(ages_ms, 99)),
            100 * frozen_s([p.shown_s for p in shown], length_s) / length_s,
            psnr_of_mse(fmean(p.mse for p in shown)) if shown else math.nan,
            self._lost,
            seed,
        )

    def run(self, seconds: float) -> None:
        """Capture pictures for so long, and wait until all have ended."""
        session, rate_hz = self._session, self._drive.name.rate_hz
        for number in range(int(seconds * rate_hz)):
            self._at(number / rate_hz, self._capture(number))
        self._opened(0.0)
        end_s = seconds + 10.0
        while (now := self._next_s()) < end_s:
            for link, arrive in ((self._up, self._server_takes), (self._down, self._vehicle_takes)):
                for delivery in link.pop_due(now):
                    for connection, item in delivery.item:
                        if connection is self._connection:
                            arrive(item, now)
            while self._events and self._events[0][0] <= now:
                self._happen(heapq.heappop(self._events)[2], now)
            session.handle_timer(now)
            if session.broken is not None and session.state is not LinkState.DISCONNECTED:
                self._lost += 1
                session.connection_lost(session.broken, now)
                self._connection = Connection()
                self._at(now + self._reopen_s, None)
            job = session.job_to_start(now)
            if job is not None:
                self._at(now + self._vehicle_s, self._coded(job))
            for outgoing in session.messages_to_send(now):
                size_bytes = len(outgoing.data) + FRAMING_BYTES
                item = (self._connection, (outgoing.message, size_bytes))
                self._up.push(item, size_bytes, now, self._connection)
            session.take_results()

    def _next_s(self) -> float:
        times = (
            self._up.next_event_at(),
            self._down.next_event_at(),
            self._session.get_timer() if self._session.broken is None else None,
            self._events[0][0] if self._events else None,
        )
        return min((at_s for at_s in times if at_s is not None), default=math.inf)

    def _at(self, at_s: float, event: Any) -> None:
        heapq.heappush(self._events, (at_s, next(self._order), event))

    def _happen(self, event: Any, now: float) -> None:
        match event:
            case Capture():
                self._session.offer(event)
            case EncodedFrame():
                self._session.encoded(event, now)
            case (connection, Frame() as frame, size_bytes, captured_s):
                if connection is self._connection:
                    self._answer(frame, size_bytes, captured_s, now)
            case None:
                self._opened(now)

    def _opened(self, now: float) -> None:
        """Open a stream; the server's answer is there, since its round trip has passed."""
        self._answered = 0
        self._state = self._decoder.start()
        self._session.connected(now)
        self._session.messages_to_send(now)
        self._session.receive(Welcome("s", exact=True), now)
        self._session.receive(Credit(CAMERA, WINDOW), now)

    def _capture(self, number: int) -> Capture:
        pictures: Sequence[PosedPicture] = self._drive.pictures
        turn = 2 * len(pictures) - 2 or 1
        index = min(number % turn, turn - number % turn)
        captured_s = number / self._drive.name.rate_hz
        picture = replace(pictures[index], camera=pictures[index].camera.rounded())
        return Capture(CAMERA, index, picture, captured_s, round(1e9 * captured_s))

    def _coded(self, job: EncodeJob) -> EncodedFrame:
        return replace(self._pipeline.encode(job), stage_s={"encode": self._vehicle_s})

    def _server_takes(self, item: tuple[Any, int], now: float) -> None:
        message, size_bytes = item
        if isinstance(message, Frame):
            event = (self._connection, message, size_bytes, message.capture_time_ns / 1e9)
            self._at(now + self._server_s, event)

    def _answer(self, frame: Frame, size_bytes: int, captured_s: float, now: float) -> None:
        """Decode a frame and acknowledge it."""
        number = round(captured_s * self._drive.name.rate_hz)
        index = self._capture(number).index
        decoded = self._decoder.decode(self._state, frame.packet, self._rendered.views[index])
        self._state = decoded.state
        mse = luma_mse(decoded.frame, self._drive.frames[index])
        self.shown.append(Picture(captured_s, now, size_bytes, mse))
        self._answered += 1
        ack = Ack(frame.address, StageTimes(), frame.packet.reconstruction_digest)
        credit = Credit(CAMERA, WINDOW + self._answered)
        item = (self._connection, (ack, credit))
        self._down.push(item, ANSWER_BYTES, now, self._connection)

    def _vehicle_takes(self, item: tuple[Ack, Credit], now: float) -> None:
        for message in item:
            self._session.receive(message, now)


def frozen_s(shown_s: Sequence[float], length_s: float) -> float:
    """Return the time in gaps that are freezes; all of it without pictures."""
    gaps = np.diff(sorted(shown_s))
    if not len(gaps):
        return length_s
    mean_s = float(gaps.mean())
    return float(gaps[gaps >= max(3 * mean_s, mean_s + 0.15)].sum())
