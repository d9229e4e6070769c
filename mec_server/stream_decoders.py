"""The decoders of one stream: opened for its Hello, run on the server's workers, closed with it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from mec_server.decode_jobs import DecodeJob, OpenJob
from mec_server.reconstruction import Decoder, Reconstruction
from mec_server.recorder import Recording
from mec_server.server_context import ServerContext

__all__ = ["FrameResult", "StreamDecoders"]


@dataclass(frozen=True)
class FrameResult:
    """A reconstructed frame, and the seconds for which it kept a worker busy."""

    reconstruction: Reconstruction
    worker_s: float


class StreamDecoders:
    """Decodes the frames of one stream; used from the event loop only."""

    def __init__(self, server: ServerContext) -> None:
        self._server = server
        self._vehicle_id = ""
        self._opening: asyncio.Future[dict[str, Decoder]] | None = None
        self._decoders: dict[str, Decoder] = {}
        self._closed = False

    async def open(self, job: OpenJob) -> None:
        """Open fields and decoders for ``job``, on a thread that delays no frames.

        Raises what ``OpenCameras`` raises.
        """
        server = self._server
        self._opening = asyncio.get_running_loop().run_in_executor(
            server.opener, server.open_cameras, job, server.fields, server.tools
        )
        self._decoders = await asyncio.shield(self._opening)
        self._vehicle_id = job.hello.vehicle_id

    def submit(
        self, job: DecodeJob, finished: Callable[[DecodeJob, FrameResult | Exception], None]
    ) -> None:
        """Decode a frame on a worker, then call ``finished`` on the loop; never after ``close``."""

        def done(outcome: FrameResult | Exception | None) -> None:
            if outcome is not None and not self._closed:
                finished(job, outcome)

        self._server.workers.submit(partial(self._reconstruct, job), done)

    def close(self) -> None:
        """Close the decoders on threads, those that are still being opened included."""
        self._closed = True
        if self._opening is not None:
            self._opening.add_done_callback(_close_decoders)

    def _reconstruct(self, job: DecodeJob) -> FrameResult | None:
        """Runs on a worker; frames of a stream that is over are not decoded any more."""
        if self._closed:
            return None
        started_s = time.perf_counter()
        reconstruction = self._decoders[job.frame.camera_id].reconstruct(job)
        worker_s = time.perf_counter() - started_s
        recorder = self._server.recorder
        if recorder is not None:
            recorder.save(Recording(self._vehicle_id, job.frame, reconstruction.picture))
        return FrameResult(reconstruction, worker_s)


def _close_decoders(opening: asyncio.Future[dict[str, Decoder]]) -> None:
    if opening.cancelled() or opening.exception() is not None:
        return
    loop = asyncio.get_running_loop()
    for decoder in opening.result().values():
        loop.run_in_executor(None, decoder.close)
