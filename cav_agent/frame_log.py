"""Records a drive: a line of JSON per picture, log lines, and metrics.

``DriveObserver`` is called with each event of the vehicle's frames, streams and fields. Frames are
counted when they have ended, however they ended.
"""

from __future__ import annotations

import json
from collections import Counter, deque
from collections.abc import Callable, Sequence
from statistics import median
from typing import Any, TextIO

import numpy as np
import structlog

from cav_agent.deadline import DeadlineController, Step
from cav_agent.frames import EndReason, FrameResult, Outcome, RetryReason
from cav_agent.handover import HandoverCause, ServedTile
from cav_agent.live.source import SourceProblem
from cav_agent.metrics import AgentMetrics
from cav_agent.pose_feed.fix import FeedProblem
from rfcore.field import RadianceField
from rfcore.localise.estimate import LocalisationState, PoseEstimate
from rfcore.metrics import psnr_of_mse
from rfcore.wire.address import Address
from rfcore.wire.notices import StreetNotice
from rfcore.wire.values import ClockKind

log = structlog.get_logger()

LOGGED_CRF = 4.0
"""A change of quality by less is not logged: 4 of CRF change the bits by 60 %."""

LOGGED_OFFSET_S = 0.1
"""A change of the pose feed's time offset by less is not logged."""

_LINK_REMEDY = "look at the server's log, and whether the link carries anything"
_REMEDIES: dict[str, str] = {
    EndReason.SUPERSEDED: "a lower --rate, smaller pictures or --effort fast",
    EndReason.TOO_LATE: "a higher --max-delay-ms, a lower --rate or --effort fast",
    EndReason.STOPPING: "let it drive longer",
    EndReason.NOT_CODED: "correct the drive or the field",
    EndReason.OVERSIZE: "smaller pictures or a higher --crf",
    EndReason.NO_WELCOME: _LINK_REMEDY,
    EndReason.NO_ANSWER: _LINK_REMEDY,
    EndReason.STREAM_LOST: _LINK_REMEDY,
    EndReason.SERVER_CLOSED: _LINK_REMEDY,
}
"""Remedies when no picture was acknowledged, by the reason of most; for other reasons a server
refused them."""

LATENCIES = 10_000
"""Pictures whose latencies are kept: more would grow for as long as the vehicle drives."""
JUDGED_FRAMES = 8
"""Answers of which the median time says whether the processors can keep the delay."""

KEPT_SHARE = 0.9
"""Share of the delay below which it counts as kept again."""


class DelayWatch:
    """Logs once that processors, not the link, take longer than ``max_delay_ms``, and its end."""

    def __init__(self, max_delay_ms: float) -> None:
        self._max_delay_ms = max_delay_ms
        self._frames: deque[dict[str, float]] = deque(maxlen=JUDGED_FRAMES)
        self._is_exceeded = False

    def acked(self, result: FrameResult) -> None:
        """Take a frame that was answered."""
        if result.latency_s is None or result.link_s is None or result.server is None:
            return
        stage_ms = {stage: 1e3 * spent_s for stage, spent_s in result.stage_s.items()}
        stage_ms.pop("read", None)
        latency_ms, link_ms = 1e3 * result.latency_s, 1e3 * result.link_s
        server_ms = result.server.total_ns / 1e6
        vehicle_ms = latency_ms - link_ms - server_ms
        waited_ms = vehicle_ms - sum(stage_ms.values())
        ends = {"all": latency_ms, "link": link_ms, "server": server_ms, "vehicle": vehicle_ms}
        self._frames.append(ends | {"wait": waited_ms} | stage_ms)
        if len(self._frames) == JUDGED_FRAMES:
            self._judge({key: median(f.get(key, 0.0) for f in self._frames) for key in ends})

    def _judge(self, took_ms: dict[str, float]) -> None:
        limit_ms, link_ms = self._max_delay_ms, took_ms["link"]
        if took_ms["all"] > limit_ms and link_ms < limit_ms / 2 and not self._is_exceeded:
            self._is_exceeded = True
            stages = set[str]().union(*self._frames) - set(took_ms)
            stage_ms = {s: median(f.get(s, 0.0) for f in self._frames) for s in stages}
            longest = sorted(stage_ms, key=lambda s: -stage_ms[s])[:3]
            vehicle = ", ".join(f"{stage} {stage_ms[stage]:.0f}" for stage in longest)
            log.warning(
                "processors exceed --max-delay-ms",
                problem=f"{took_ms['all']:.0f} ms a frame, {limit_ms:g} asked for: vehicle "
                f"{took_ms['vehicle']:.0f} ({vehicle}), server {took_ms['server']:.0f}, link "
                f"{link_ms:.0f}; quality is not lowered for it",
                remedy="a lower --rate, smaller pictures, --effort fast, or a higher --max-delay-ms"
                if took_ms["vehicle"] > took_ms["server"]
                else "fewer frames for the server (a lower --rate), smaller pictures, more "
                "processors there, or a higher --max-delay-ms",
            )
            self._frames.clear()
        elif took_ms["all"] < KEPT_SHARE * limit_ms and self._is_exceeded:
            self._is_exceeded = False
            log.info("--max-delay-ms is kept again", frame_ms=round(took_ms["all"]))
            self._frames.clear()


class DriveObserver:
    """Turns the events of a drive into metrics, log lines and, if given, the frame log.

    ``frame_log``: a file that gets a line of JSON per picture. ``notice_takers`` are called with
    each notice of the street. ``max_delay_ms``: what the drive's frames may take, if it is limited.
    """

    def __init__(
        self,
        metrics: AgentMetrics,
        servers: Sequence[Address],
        frame_log: TextIO | None = None,
        notice_takers: Sequence[Callable[[StreetNotice], None]] = (),
        max_delay_ms: float | None = None,
    ) -> None:
        self._metrics = metrics
        self._delay_watch = None if max_delay_ms is None else DelayWatch(max_delay_ms)
        self._notice_takers = tuple(notice_takers)
        self._servers = tuple(servers)
        self._frame_log = frame_log
        self._unacknowledged: Counter[tuple[str, str]] = Counter()
        self._problem = ""
        self._latency_ms: deque[float] = deque(maxlen=LATENCIES)
        self._logged_crf: float | None = None
        self._pose_state: LocalisationState | None = None
        self._feed_offset_s: float | None = None
        self._luma_mse_sum, self._measured = 0.0, 0

    def ended(self, result: FrameResult) -> None:
        """A captured picture came to its end."""
        self._metrics.ended(result)
        self._take_quality(result)
        if result.outcome is not Outcome.ACKED:
            self._unacknowledged[str(result.outcome), str(result.reason)] += 1
            self._problem = result.problem or self._problem
        self._log_pose(result)
        if self._frame_log is not None:
            self._frame_log.write(json.dumps(log_line(result)) + "\n")
        _log_failure(result)
        self._log_quality(result)
        if self._delay_watch is not None:
            self._delay_watch.acked(result)

    def quality(self) -> dict[str, float]:
        """Return the luma PSNR of the mean squared error of all acknowledged pictures, and
        percentiles of the time from capture to Ack of the last ``LATENCIES``, if any."""
        if not self._luma_mse_sum:
            return {}
        p50_ms, p99_ms = np.percentile(self._latency_ms, (50, 99))
        return {
            "psnr_db": _psnr_db(self._luma_mse_sum / self._measured),
            "latency_p50_ms": round(float(p50_ms), 1),
            "latency_p99_ms": round(float(p99_ms), 1),
        }

    def _take_quality(self, result: FrameResult) -> None:
        encoded = result.encoded
        if result.outcome is Outcome.ACKED and encoded and encoded.luma_mse is not None:
            self._luma_mse_sum += encoded.luma_mse
            self._measured += 1
            self._latency_ms.append(1e3 * (result.latency_s or 0.0))

    def explanation(self) -> str:
        """Return why no picture of a drive was acknowledged, and what to do."""
        if not self._unacknowledged:
            return (
                "no picture was taken: the last lines above (no connection, waiting) say what the "
                "vehicle waited for"
            )
        counts = self._unacknowledged.most_common()
        ends = ", ".join(f"{count} {outcome} ({reason})" for (outcome, reason), count in counts)
        problem = f"; last problem: {self._problem}" if self._problem else ""
        remedy = _REMEDIES.get(counts[0][0][1], "see the server's log for what it refused")
        return f"no picture was acknowledged: {ends}{problem}; what helps: {remedy}"

    def connected(self, is_connected: bool) -> None:
        """A server welcomed the vehicle, or its stream was lost."""
        self._metrics.connected.set(is_connected)
        if not is_connected:
            self._metrics.connections_lost.inc()

    def retrying(self, reason: RetryReason) -> None:
        """Something failed and will be tried again."""
        self._metrics.retries.labels(reason).inc()

    def noticed(self, notice: StreetNotice) -> None:
        """A server sent a notice of the street."""
        self._metrics.notices.labels(notice.kind).inc()
        for take in self._notice_takers:
            take(notice)

    def message_unknown(self) -> None:
        """A server sent a message that this agent does not know."""
        self._metrics.unknown_messages.inc()

    def handed_over(self, served: ServedTile, cause: HandoverCause) -> None:
        """``served`` takes the vehicle's pictures now."""
        self._metrics.handovers.labels(cause).inc()
        server = str(self._servers[served.server])
        log.info("handed over", server=server, tile=served.tile.name, cause=str(cause))

    def field_fetched(self, size_bytes: int) -> None:
        """An archive was fetched."""
        self._metrics.field_bytes.inc(size_bytes)

    def field_ready(self, field: RadianceField, pictures: int) -> None:
        """A field was opened and can be coded against."""
        self._metrics.field_info.labels(field.field_id[:16], field.metadata.kind).set(1)
        log.info("ready", pictures=pictures, field=field.field_id, isa=field.isa)

    def coded_under_deadline(self, controller: DeadlineController, step: Step | None) -> None:
        """A frame was coded under a deadline; ``step`` is the change of rung that followed."""
        self._metrics.rung.set(controller.position)
        if controller.late:
            self._metrics.deadline_missed.inc()
        if step is not None:
            direction = "down" if step.down else "up"
            self._metrics.rung_steps.labels(direction).inc()
            log.info(
                f"stepped {direction}",
                before=step.before.rung.name,
                rung=step.after.rung.name,
                slowness=round(step.slowness, 2),
            )

    def feed_fixes(self, fixes: int) -> None:
        """Count fixes of the pose feed that are used."""
        self._metrics.feed_fixes.inc(fixes)

    def feed_problem(self, problem: FeedProblem, text: str, begins: bool) -> None:
        """Something is wrong with the pose feed: counted each time, logged when it begins."""
        self._metrics.feed_problems.labels(problem).inc()
        if begins:
            log.warning("pose feed", reason=str(problem), problem=text)

    def source_open(self, camera_id: str, clock: ClockKind) -> None:
        """Frames of a live source come, their times from ``clock``."""
        self._metrics.source_open.set(1)
        for kind in ClockKind:
            self._metrics.capture_clock.labels(kind).set(kind is clock)
        log.info("source open", camera=camera_id, capture_clock=str(clock))

    def source_lost(self, camera_id: str, problem: SourceProblem, text: str, begins: bool) -> None:
        """A live source was lost, or could not be opened again: counted each time, logged once."""
        self._metrics.source_open.set(0)
        self._metrics.source_losses.labels(problem).inc()
        if begins:
            log.warning("source lost", camera=camera_id, reason=str(problem), problem=text)

    def source_frames(self, taken: int, dropped: int) -> None:
        """Count frames of live sources that were taken over, or dropped before coding."""
        self._metrics.source_frames.labels("taken").inc(taken)
        self._metrics.source_frames.labels("dropped").inc(dropped)

    def source_damaged(self, camera_id: str, count: int) -> None:
        """Count and log frames of a live source that were damaged or rest on lost ones."""
        self._metrics.source_frames.labels("damaged").inc(count)
        log.warning("camera pictures lost on the way", camera=camera_id, left_out=count)

    def _log_pose(self, result: FrameResult) -> None:
        """Log when the camera was found or lost, and how late the feed is if that changed."""
        fix = None if result.encoded is None else result.encoded.fix
        if fix is None:
            return
        if fix.state is not self._pose_state:
            self._pose_state = fix.state
            log.info("pose", state=str(fix.state), picture=result.capture.picture.name)
        offset_s, logged_s = fix.feed_offset_s, self._feed_offset_s
        if offset_s is None or (
            logged_s is not None and abs(offset_s - logged_s) < LOGGED_OFFSET_S
        ):
            return
        self._feed_offset_s = offset_s
        log.info("pose feed's time offset", seconds=round(offset_s, 3))

    def _log_quality(self, result: FrameResult) -> None:
        """Log when rate control lowered or raised the quality by much."""
        encoded, budget = result.encoded, result.budget
        if encoded is None or encoded.crf is None or budget is None:
            return
        before, crf = self._logged_crf, encoded.crf
        if before is not None and abs(crf - before) < LOGGED_CRF:
            return
        self._logged_crf = crf
        if before is None:
            return
        rate_bps = budget.rate_bps
        log.info(
            "quality falls" if crf > before else "quality rises",
            session=result.session_id,
            crf=round(crf, 1),
            crf_before=round(before, 1),
            target_bytes=round(budget.target_bytes),
            proven_mbps=None if rate_bps is None else round(rate_bps / 1e6, 3),
        )


def _log_failure(result: FrameResult) -> None:
    """Log a frame that was coded in vain, or coarser than asked for to fit the limit.

    A picture that was dropped before it was encoded is only counted.
    """
    encoded, packet = result.encoded, result.packet
    if encoded is None or packet is None:
        return
    frame = {"session": result.session_id, "epoch": packet.epoch, "seq": packet.sequence}
    if encoded.tries > 1 and result.budget is None:
        size_bytes = len(packet.payload)
        event = "slice above the limit coded again"
        log.warning(event, **frame, tries=encoded.tries, payload_bytes=size_bytes)
    if result.outcome is not Outcome.ACKED:
        event = f"frame {result.outcome}"
        log.warning(event, **frame, reason=str(result.reason), problem=result.problem)


def log_line(result: FrameResult) -> dict[str, Any]:
    """Return the frame log's line of a picture; what the picture did not get to is null."""
    return {
        "name": result.capture.picture.name,
        "index": result.capture.index,
        "camera": result.capture.camera_id,
        "instant": result.capture.instant or None,
        "capture_time_ns": result.capture.capture_time_ns,
        "capture_clock": result.capture.clock and str(result.capture.clock),
        "result": str(result.outcome),
        "reason": str(result.reason),
        "problem": result.problem,
        **_coding_of(result),
        "server_digest": result.server_digest.hex() or None,
        "stage_ms": _stage_ms(result),
        "latency_ms": None if result.latency_s is None else result.latency_s * 1e3,
    }


def _coding_of(result: FrameResult) -> dict[str, Any]:
    encoded, packet = result.encoded, result.packet
    return {
        "epoch": packet.epoch if packet else None,
        "sequence": packet.sequence if packet else None,
        "references": [r.name.lower() for r in packet.references] if packet else None,
        "payload_bytes": len(packet.payload) if packet else None,
        "tries": encoded.tries if encoded else None,
        "rung": encoded.rung.name if encoded else None,
        "crf": encoded.crf if encoded else None,
        "psnr_db": _psnr_db(encoded.luma_mse) if encoded and encoded.luma_mse else None,
        "relit": packet.relit if packet else None,
        "light_field": encoded.field_id or None if encoded else None,
        "pose": _pose_of(encoded.fix) if encoded and encoded.fix else None,
        "target_bytes": result.budget.target_bytes if result.budget else None,
        "packet_bytes": result.packet_bytes if packet else None,
        "render_digest": packet.render_digest.hex() if packet else None,
        "reconstruction_digest": packet.reconstruction_digest.hex() if packet else None,
    }


def _psnr_db(luma_mse: float) -> float:
    return round(psnr_of_mse(luma_mse), 2)


def _pose_of(fix: PoseEstimate) -> dict[str, Any]:
    correction = fix.correction
    return {
        "state": str(fix.state),
        "agreement": fix.agreement,
        "inliers": fix.inliers,
        "renders": fix.renders,
        "correction_m": correction.metres if correction else None,
        "correction_deg": correction.degrees if correction else None,
        "feed_offset_s": fix.feed_offset_s,
    }


def _stage_ms(result: FrameResult) -> dict[str, float]:
    stage_ms = {stage: spent_s * 1e3 for stage, spent_s in result.stage_s.items()}
    if result.server is not None:
        for stage in ("queue", "ahead", "render", "splice", "decode", "total"):
            stage_ms[f"server_{stage}"] = getattr(result.server, f"{stage}_ns") / 1e6
    if result.link_s is not None:
        stage_ms["link"] = result.link_s * 1e3
    return stage_ms
