"""The agent's Prometheus metrics. All names of its own begin with ``rfedge_agent_``.

An agent is one vehicle and one target of Prometheus, so ``instance`` tells vehicles apart. Their
names appear only in ``rfedge_agent_info``, and only when asked for. Values of labels come from
closed sets (enumerations, stages, references), but for the ids of fields.
"""

from __future__ import annotations

from prometheus_client import CollectorRegistry

from cav_agent.deadline import Step
from cav_agent.frames import EncodedFrame, FrameResult
from cav_agent.handover import HandoverCause
from rfcore.codec.references import references_name
from rfcore.wire.instruments import Instruments

__all__ = ["AgentMetrics"]


class AgentMetrics:
    """Counters and histograms on a registry of their own."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self.instruments = make = Instruments(registry)
        make.process()
        self._connected = make.gauge(
            "rfedge_agent_connected", "1 while the server has welcomed this vehicle."
        )
        self._lost = make.counter(
            "rfedge_agent_connections_lost", "Streams that ended before the drive did."
        )
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
        self._rung = make.gauge(
            "rfedge_agent_rung",
            "Rungs of the ladder above the present one: 0 is the best; without a deadline 0.",
        )
        self._steps = make.counter(
            "rfedge_agent_rung_steps",
            "Changes of rung, down to a faster one or up to a better one.",
            ("direction",),
        )
        self._late = make.counter(
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

        self._fields = make.gauge(
            "rfedge_agent_field_info",
            "1; a radiance field that is ready: the first 16 digits of its id, and its kind.",
            ("field", "kind"),
        )
        self._handovers = make.counter(
            "rfedge_agent_handovers",
            "Moves to another server or tile: tile (by position or version), server_lost.",
            ("cause",),
        )

    def identify(self, vehicle_id: str, camera_id: str) -> None:
        """Export the names of vehicle and camera, for operators who want them."""
        self.instruments.info(
            "rfedge_agent_info",
            "1; the vehicle and its camera. Only with --metrics-per-vehicle.",
            {"vehicle": vehicle_id, "camera": camera_id},
        )

    def field_ready(self, field_id: str, kind: str) -> None:
        """Note a field that was made ready to code frames against."""
        self._fields.labels(field_id[:16], kind).set(1)

    def handed_over(self, cause: HandoverCause) -> None:
        """Count a handover."""
        self._handovers.labels(cause).inc()

    def coded_under_deadline(self, position: int, step: Step | None, late: bool) -> None:
        """Note the rung after a frame under a deadline, and whether the frame kept it."""
        self._rung.set(position)
        if step is not None:
            self._steps.labels("down" if step.down else "up").inc()
        if late:
            self._late.inc()

    def connected(self, is_connected: bool) -> None:
        """Note that a server welcomed the vehicle, or that its stream was lost."""
        self._connected.set(is_connected)
        if not is_connected:
            self._lost.inc()

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
