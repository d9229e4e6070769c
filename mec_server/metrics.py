"""What Prometheus sees of the server. All names begin with ``rfedge_server_``."""

from __future__ import annotations

from collections.abc import Iterable

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from rfcore.wire.conventions import FRAME_BUDGET_BUCKETS_S
from rfcore.wire.messages import Ack, Nack, ServerMessage

__all__ = ["ServerMetrics"]


class ServerMetrics:
    """Counters and histograms on a registry of their own."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self.sessions = Gauge("rfedge_server_sessions", "Streams that are open", registry=registry)
        self.frames = Counter(
            "rfedge_server_frames",
            "Frames by result (acked, nacked) and reject reason",
            ["result", "reason"],
            registry=registry,
        )
        self.bytes = Counter(
            "rfedge_server_received_bytes",
            "Bytes by kind: payload (P slice), packet (whole message)",
            ["kind"],
            registry=registry,
        )
        self.stages = Histogram(
            "rfedge_server_stage_seconds",
            "Time by stage: queue, render, splice, decode, total, end_to_end (capture to picture)",
            ["stage"],
            buckets=FRAME_BUDGET_BUCKETS_S,
            registry=registry,
        )
        self.recording = Gauge(
            "rfedge_server_recording", "1 while pictures are recorded, 0 after the disk refused",
            registry=registry,
        )  # fmt: skip

    def answered(self, messages: Iterable[ServerMessage]) -> None:
        """Count the frames that ``messages`` answer."""
        for message in messages:
            if isinstance(message, Ack):
                self.frames.labels("acked", "").inc()
                for stage in ("queue", "render", "splice", "decode", "total"):
                    spent_s = getattr(message.times, f"{stage}_ns") / 1e9
                    self.stages.labels(stage).observe(spent_s)
            elif isinstance(message, Nack):
                self.frames.labels("nacked", str(message.reason)).inc(message.count)
