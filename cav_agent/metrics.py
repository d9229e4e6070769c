"""The agent's Prometheus metrics. All names of its own begin with ``rfedge_agent_``.

An agent is one vehicle and one target of Prometheus, so ``instance`` tells vehicles apart. Their
names appear only in ``rfedge_agent_info``, and only when asked for. Values of labels come from
closed sets (enumerations, stages, references), except for the ids of fields.
"""

from __future__ import annotations

from prometheus_client import CollectorRegistry

from cav_agent.frames import EncodedFrame, FrameResult, RetryReason
from cav_agent.pose_feed.fix import FeedProblem
from rfcore.codec.references import references_name
from rfcore.localise.estimate import LocalisationState, PoseEstimate
from rfcore.wire.instruments import Instruments
from rfcore.wire.notices import NOTICE_KINDS


class AgentMetrics:
    """Counters, gauges and histograms on one registry."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self.instruments = make = Instruments(registry)
        make.process()
        make.devices()
        self.connected = make.gauge(
            "rfedge_agent_connected", "1 while the server has welcomed this vehicle."
        )
        self.connections_lost = make.counter(
            "rfedge_agent_connections_lost", "Streams that ended before the drive did."
        )
        self.retries = make.counter(
            "rfedge_agent_retries",
            "What failed and is tried again: stream, refused, field_gone, field, tiles.",
            ("reason",),
        )
        for reason in RetryReason:
            self.retries.labels(reason)
        self.unknown_messages = make.counter(
            "rfedge_agent_unknown_messages",
            "Messages of a newer server that this agent does not know, and ignores.",
        )
        self.notices = make.counter(
            "rfedge_agent_notices",
            "Notices of the street that servers sent, by their subject: object, map, light.",
            ("kind",),
        )
        for kind in NOTICE_KINDS:
            self.notices.labels(kind)
        self._frames = make.counter(
            "rfedge_agent_frames",
            "Captured pictures by result (acked, nacked, dropped, lost) and reason.",
            ("result", "reason"),
        )
        self._sent = make.counter(
            "rfedge_agent_sent_bytes", "Bytes of coded frames sent: pose, header and payload."
        )
        self._payload = make.counter(
            "rfedge_agent_payload_bytes",
            "Bytes of P slices sent, by the reference pictures they predict from.",
            ("references",),
        )
        self._recoded = make.counter(
            "rfedge_agent_recoded_frames",
            "Frames coded again at a higher CRF because their P slice was above the limit.",
        )
        self._pose_state = make.gauge(
            "rfedge_agent_pose_state",
            "1 for the present state of the camera's pose (lost, localising, tracking), else 0; "
            "only with --localise.",
            ("state",),
        )
        self._poses = make.counter(
            "rfedge_agent_pose_frames", "Coded frames by what was known of their pose.", ("state",)
        )
        for state in LocalisationState:
            self._poses.labels(state)
        self._inliers = make.gauge(
            "rfedge_agent_pose_inliers", "Feature matches that agreed with the last pose searched."
        )
        self._agreement = make.gauge(
            "rfedge_agent_pose_agreement",
            "Standard deviations of chance by which the last tracked frame resembles its render.",
        )
        self._correction = make.gauge(
            "rfedge_agent_pose_correction_metres",
            "How far the last tracked pose is from the sensor's measurement of its time.",
        )
        self._feed_offset = make.gauge(
            "rfedge_agent_pose_feed_offset_seconds",
            "What to add to the pose feed's times to get the camera's, as found by tracking.",
        )
        self._crf = make.gauge("rfedge_agent_crf", "CRF of the last coded frame, 1 (best) to 51.")
        self._target = make.gauge(
            "rfedge_agent_target_bytes",
            "Bytes the last frame's P slice was to take; 0 without --max-delay-ms.",
        )
        self._rate = make.gauge(
            "rfedge_agent_proven_bytes_per_second",
            "Throughput that the last answers prove, minimum round-trip time counted as sending; "
            "0 without --max-delay-ms.",
        )
        self.rung = make.gauge(
            "rfedge_agent_rung",
            "Rungs of the ladder above the present one: 0 is the best; without a deadline 0.",
        )
        self.rung_steps = make.counter(
            "rfedge_agent_rung_steps",
            "Changes of rung, down to a faster one or up to a better one.",
            ("direction",),
        )
        self.deadline_missed = make.counter(
            "rfedge_agent_deadline_missed_frames",
            "Frames that took longer than --deadline-ms from the picture to the packet.",
        )
        self._stages = make.seconds(
            "rfedge_agent_stage_seconds",
            "Time of a frame by stage; link is from sending to Ack without the server's own time.",
            ("stage",),
        )
        self._latency = make.seconds(
            "rfedge_agent_capture_to_ack_seconds",
            "From the picture in the camera to its Ack.",
        )
        self.field_info = make.gauge(
            "rfedge_agent_field_info",
            "1; a radiance field that is ready: the first 16 digits of its id, and its kind.",
            ("field", "kind"),
        )
        self.handovers = make.counter(
            "rfedge_agent_handovers",
            "Moves to another server or tile: tile (by position or version), server_lost.",
            ("cause",),
        )
        self.source_open = make.gauge(
            "rfedge_agent_source_open",
            "1 while frames of the live source come; only with --source.",
        )
        self.capture_clock = make.gauge(
            "rfedge_agent_capture_clock",
            "1 for what the live source's times of capture rest on: sender_report, arrival.",
            ("clock",),
        )
        self.source_frames = make.counter(
            "rfedge_agent_source_frames",
            "Frames of the live source by what became of them: taken over, or dropped because a "
            "newer one came first, the rate is lower, or their time went back, or damaged: lost on "
            "the way, or predicted from such a one.",
            ("result",),
        )
        self.source_losses = make.counter(
            "rfedge_agent_source_losses",
            "Times that the live source was lost or did not open: ended, silent, wrong_size.",
            ("reason",),
        )
        self.field_bytes = make.counter(
            "rfedge_agent_field_bytes", "Bytes of field archives and layers that were fetched."
        )
        self.feed_fixes = make.counter(
            "rfedge_agent_pose_feed_fixes", "Poses of the vehicle's own sensors that are used."
        )
        self.feed_problems = make.counter(
            "rfedge_agent_pose_feed_problems",
            "What was wrong with the pose feed, by reason; the log has each once.",
            ("reason",),
        )
        for problem in FeedProblem:
            self.feed_problems.labels(problem)

    def identify(self, vehicle_id: str, camera_id: str) -> None:
        """Export the names of vehicle and camera, for operators who want them."""
        self.instruments.info(
            "rfedge_agent_info",
            "1; the vehicle and its camera. Only with --metrics-per-vehicle.",
            {"vehicle": vehicle_id, "camera": camera_id},
        )

    def ended(self, result: FrameResult) -> None:
        """Count a picture that came to its end."""
        self._frames.labels(str(result.outcome), str(result.reason)).inc()
        if result.encoded is not None:
            self._encoded(result.encoded, result.packet_bytes)
        if result.budget is not None:
            self._target.set(result.budget.target_bytes)
            self._rate.set((result.budget.rate_bps or 0.0) / 8)
        for stage, spent_s in result.stage_s.items():
            self._stages.labels(stage).observe(spent_s)
        if result.server is not None and result.link_s is not None and result.latency_s is not None:
            self._stages.labels("link").observe(result.link_s)
            self._latency.observe(result.latency_s)

    def _encoded(self, encoded: EncodedFrame, packet_bytes: int) -> None:
        packet = encoded.packet
        self._payload.labels(references_name(packet.references)).inc(len(packet.payload))
        self._sent.inc(packet_bytes)
        if encoded.tries > 1:
            self._recoded.inc()
        if encoded.crf is not None:
            self._crf.set(encoded.crf)
        if encoded.fix is not None:
            self._fixed(encoded.fix)

    def _fixed(self, fix: PoseEstimate) -> None:
        for state in LocalisationState:
            self._pose_state.labels(state).set(state is fix.state)
        self._poses.labels(fix.state).inc()
        if fix.inliers is not None:
            self._inliers.set(fix.inliers)
        if fix.state is LocalisationState.TRACKING:
            self._agreement.set(fix.agreement)
        if fix.correction is not None:
            self._correction.set(fix.correction.metres)
        if fix.feed_offset_s is not None:
            self._feed_offset.set(fix.feed_offset_s)
