"""What Prometheus sees of the agent. All names begin with ``rfedge_agent_``."""

from __future__ import annotations

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from cav_agent.frames import FrameResult
from rfcore.wire.conventions import FRAME_BUDGET_BUCKETS_S

__all__ = ["AgentMetrics"]


class AgentMetrics:
    """Counters and histograms on a registry of their own."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self._connected = Gauge(
            "rfedge_agent_connected", "1 while the server has welcomed us", registry=registry
        )
        self._lost = Counter(
            "rfedge_agent_connections_lost", "Streams that ended too early", registry=registry
        )
        self.frames = Counter(
            "rfedge_agent_frames",
            "Pictures by result (acked, nacked, dropped, lost) and reason",
            ["result", "reason"],
            registry=registry,
        )
        self.bytes = Counter(
            "rfedge_agent_sent_bytes",
            "Bytes by kind: payload (P slice), packet (whole message)",
            ["kind"],
            registry=registry,
        )
        self.stages = Histogram(
            "rfedge_agent_stage_seconds",
            "Time by stage; end_to_end is from the picture in memory to its Ack",
            ["stage"],
            buckets=FRAME_BUDGET_BUCKETS_S,
            registry=registry,
        )

    def connected(self, is_connected: bool) -> None:
        """Note that the server welcomed us, or was lost."""
        self._connected.set(is_connected)
        if not is_connected:
            self._lost.inc()

    def ended(self, result: FrameResult) -> None:
        """Count a picture that came to its end."""
        reason = result.reason.partition(":")[0][:40]
        self.frames.labels(str(result.outcome), reason).inc()
        if result.packet is not None:
            self.bytes.labels("payload").inc(len(result.packet.payload))
            self.bytes.labels("packet").inc(result.packet_bytes)
        for stage, spent_s in result.stage_s.items():
            self.stages.labels(stage).observe(spent_s)
        if result.server is not None and result.link_s is not None and result.latency_s is not None:
            self.stages.labels("link").observe(result.link_s)
            self.stages.labels("end_to_end").observe(result.latency_s)
