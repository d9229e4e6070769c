"""What the streams of one server share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mec_server.config import SessionLimits
from mec_server.event_loop import Workers
from mec_server.ledger.entry import EntryControl
from mec_server.ledger.peer_log import LogLimiter
from mec_server.metrics import ServerMetrics
from mec_server.reconstruction import FieldSource, OpenCameras, Tools
from mec_server.recorder import Recorder
from mec_server.twin.state import Twin

__all__ = ["ServerContext"]


@dataclass(frozen=True)
class ServerContext:
    """The parts of one server that its streams use."""

    fields: FieldSource
    held_field_ids: Callable[[], tuple[str, ...]]
    workers: Workers
    """Threads that decode frames."""
    opener: Workers
    """One thread that opens fields and decoders for new vehicles: a crowd of them, or a decoder
    process that is slow to start, must not delay the frames of others."""
    tools: Tools
    metrics: ServerMetrics
    limits: SessionLimits
    entry: EntryControl
    log_limiter: LogLimiter
    twin: Twin
    open_cameras: OpenCameras
    recorder: Recorder | None = None
