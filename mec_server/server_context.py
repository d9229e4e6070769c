"""What the streams of one server share."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass

from mec_server.admission import Admission
from mec_server.config import SessionLimits
from mec_server.metrics import ServerMetrics
from mec_server.quotas import Quotas
from mec_server.reconstruction import FieldSource, OpenCameras, Tools
from mec_server.recorder import Recorder
from mec_server.twin.state import Twin
from mec_server.workers import Workers

__all__ = ["ServerContext"]


@dataclass(frozen=True)
class ServerContext:
    """What the sessions of one server share.

    ``workers`` decode, ``opener`` makes ready for new vehicles: a crowd of them, or a decoder
    process that takes its time, shall not hold up frames.
    """

    fields: FieldSource
    held_field_ids: Callable[[], tuple[str, ...]]
    workers: Workers
    opener: Executor
    tools: Tools
    metrics: ServerMetrics
    limits: SessionLimits
    quotas: Quotas
    admission: Admission
    max_streams: int
    twin: Twin
    open_cameras: OpenCameras
    recorder: Recorder | None = None
