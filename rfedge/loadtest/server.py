"""``mec-server`` without a part of its work, for load tests of the rest.

``python -m rfedge.loadtest.server transport|receiver FIELDS WORKERS --ready-file FILE``

Streams, sessions, queues, workers, metrics, logs and the twin are the server's own. In transport
mode a worker compares CRCs and shows a grey picture; in receiver mode it decodes against renders
that are kept, so that each pose is rendered once.
"""

from __future__ import annotations

import asyncio
import sys
from collections import OrderedDict
from pathlib import Path

from mec_server.config import AdmissionLimits, ServerBudget, ServerConfig
from mec_server.reconstruction import (
    Decoder,
    FieldSource,
    OpenCameras,
    Reconstruction,
    Tools,
    open_cameras,
)
from mec_server.server import serve
from mec_server.session import DecodeJob, OpenJob, PrepareJob
from rfcore.camera import Camera
from rfcore.field import Quality, Renderer
from rfcore.image import I420
from rfcore.views import View
from rfcore.wire.messages import CameraDescription, StageTimes
from rfcore.wire.settings import configure_logs
from rfedge.loadtest.plan import Mode

MAX_KEPT = 64
"""Renders of 640x360 are 4.6 MB each."""


class PassingDecoder:
    """Shows a grey picture for every frame."""

    def __init__(self, camera: CameraDescription) -> None:
        self._grey = I420.filled((camera.intrinsics.width_px, camera.intrinsics.height_px))

    def prepare(self, job: PrepareJob) -> None:
        """Prepare nothing."""

    def reconstruct(self, job: DecodeJob) -> Reconstruction:
        """Return grey; the frame's CRC was checked when it was read."""
        digest = job.frame.packet.reconstruction_digest
        return Reconstruction(self._grey, digest, StageTimes())

    def close(self) -> None:
        """Nothing is held."""


class KeptRenders:
    """A field that keeps its renders, for sessions that all ask for the same poses."""

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer
        self._views: OrderedDict[tuple[Camera, Quality], View] = OrderedDict()

    def render(self, camera: Camera, quality: Quality) -> View:
        """Return the view, rendered now or before."""
        view = self._views.get((camera, quality))
        if view is None:
            view = self._views[camera, quality] = self._renderer.render(camera, quality)
            while len(self._views) > MAX_KEPT:
                self._views.popitem(last=False)
        return view


class KeptFields:
    """The fields of a server, each opened once, with its kept renders."""

    def __init__(self, fields: FieldSource) -> None:
        self._fields = fields
        self._kept: dict[str, KeptRenders] = {}

    def open(self, field_id: str) -> Renderer:
        """Return a field; raise what the server's own source raises."""
        if field_id not in self._kept:
            self._kept[field_id] = KeptRenders(self._fields.open(field_id))
        return self._kept[field_id]


def passing(job: OpenJob, fields: FieldSource, tools: Tools) -> dict[str, Decoder]:
    """Return decoders that do nothing, in place of ``mec_server.reconstruction.open_cameras``."""
    del fields, tools
    return {camera.camera_id: PassingDecoder(camera) for camera in job.hello.cameras}


def with_kept_renders() -> OpenCameras:
    """Return ``open_cameras`` with one set of kept renders for all sessions."""
    kept: list[KeptFields] = []

    def opened(job: OpenJob, fields: FieldSource, tools: Tools) -> dict[str, Decoder]:
        if not kept:
            kept.append(KeptFields(fields))
        return open_cameras(job, kept[0], tools)

    return opened


def main(arguments: list[str]) -> None:
    """Serve until SIGTERM."""
    mode, fields, workers, _, ready_file = arguments
    config = ServerConfig(
        fields=Path(fields),
        listen="127.0.0.1:0",
        workers=int(workers),
        admission=AdmissionLimits(load=0.0),
        server_budget=ServerBudget(decoders=100_000),  # so that no vehicle is refused
        ready_file=Path(ready_file),
        address_connections=0,  # every vehicle of the test is at one address
    )
    configure_logs(sys.stderr)
    opened = passing if Mode(mode) is Mode.TRANSPORT else with_kept_renders()
    asyncio.run(serve(config, opened))


if __name__ == "__main__":
    main(sys.argv[1:])
