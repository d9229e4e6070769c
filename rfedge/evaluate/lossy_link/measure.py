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
from dataclasses import asdict, dataclass, field, replace
from statistics import fmean
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
from rfcore.field import RadianceField, load_field
from rfcore.link.lossy import LossyLink, PacketLoss
from rfcore.link.plan import DirectionPlan, LinkPlan
from rfcore.link.shaper import Connection, LinkProfile
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
from rfedge.evaluate.clips import Drive, luma_mse, psnr_of_mse, read_drive
from rfedge.evaluate.field_coder import RenderedClip, render_clip
from rfedge.evaluate.lossy_link import EvalLossyLink
from rfedge.evaluate.runner import Run, program_version
from rfedge.report.tables import Table, columns, shown
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


@dataclass(frozen=True)
class LossyLinkRow:
    """One drive over one link."""

    loss_percent: float = field(metadata=shown("loss %", "g"))
    rate_mbps: float = field(metadata=shown("link Mbit/s", "g"))
    shown_hz: float = field(metadata=shown("shown Hz", ".1f"))
    sent_mbps: float = field(metadata=shown("sent Mbit/s", ".2f"))
    age_p50_ms: float = field(metadata=shown("age p50 ms", ".0f"))
    age_p99_ms: float = field(metadata=shown("p99", ".0f"))
    frozen_percent: float = field(metadata=shown("frozen %", ".1f"))
    psnr_db: float = field(metadata=shown("PSNR dB", ".1f"))
    """Luma PSNR of the shown pictures, by their mean squared error."""
    streams_lost: int = field(default=0, metadata=shown("streams lost"))


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
        "Frozen: time in gaps that W3C's webrtc-stats call freezes. No picture is damaged."
    )
    rows = rows_of(LossyLinkRow, result["rows"])
    yield Table("A drive over lossy links", columns(LossyLinkRow), rows)


def run_lossy_link(job: EvalLossyLink, console: Console) -> dict[str, Any]:
    """Drive over every link, write the result and print its rows."""
    run = Run.begin("lossy-link", job, [job.field], console)
    renderer = load_field(job.field)
    drive = read_drive(job.drive, None, (renderer, job.field))
    rendered = render_clip(renderer, drive.cameras)
    seconds = QUICK_S if job.quick else job.seconds
    rows: list[LossyLinkRow] = []
    for loss_percent, rate_mbps in itertools.product(job.losses, job.rates_mbps):
        key = {
            "verb": "lossy-link",
            "field": renderer.field_id,
            "frames": drive.digest,
            "hz": drive.name.rate_hz,
            "loss_percent": loss_percent,
            "rate_mbps": rate_mbps,
            "seconds": seconds,
            "program": program_version("cav_agent", "rfedge/evaluate/lossy_link"),
            **{name: getattr(job, name) for name in _OPTIONS},
        }

        def measured(loss: float = loss_percent, rate: float = rate_mbps) -> list[dict[str, Any]]:
            plan = _plan(job, loss, rate)
            driven = LossyDrive(job, drive, renderer, rendered, plan)
            return [asdict(driven.row(seconds, loss, rate))]

        (row,) = rows_of(LossyLinkRow, run.store.rows(key, measured))
        rows.append(row)
        run.tell(f"{loss_percent:g} % lost, {rate_mbps:g} Mbit/s: age {row.age_p50_ms:.0f} ms")
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
        "link": {"rtt_ms": job.rtt_ms, "loss_burst": job.loss_burst, "seed": job.seed},
        "max_delay_ms": job.max_delay_ms,
        "vehicle_ms": job.vehicle_ms,
        "server_ms": job.server_ms,
        "rows": rows,
    }
    return run.finish(content, lossy_link_parts)


_OPTIONS = ("rtt_ms", "loss_burst", "max_delay_ms", "vehicle_ms", "server_ms", "seed")


def _plan(job: EvalLossyLink, loss_percent: float, rate_mbps: float) -> LinkPlan:
    profile = LinkProfile(1e6 * rate_mbps, job.rtt_ms / 2e3)
    up, down = (DirectionPlan(profile, seed=f"{job.seed}/{way}") for way in ("up", "down"))
    return LinkPlan(up, down).with_loss(PacketLoss(loss_percent, job.loss_burst))


class LossyDrive:
    """A vehicle, a server that answers after a while, and a link between them."""

    def __init__(
        self,
        job: EvalLossyLink,
        drive: Drive,
        renderer: RadianceField,
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

    def row(self, seconds: float, loss_percent: float, rate_mbps: float) -> LossyLinkRow:
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
