"""The decoders of one stream: opened for its Hello, run on the server's workers, closed with it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from mec_server.config import SessionLimits
from mec_server.connections import Connections
from mec_server.event_loop import Workers
from mec_server.learner import UnrecordedTrials
from mec_server.ledger.entry import EntryControl
from mec_server.ledger.ledger import Hold
from mec_server.ledger.peer_log import LogLimiter
from mec_server.metrics import BackgroundTask, OpeningResult, ServerMetrics
from mec_server.reconstruction import Decoder, FieldSource, OpenCameras, Reconstruction, Tools
from mec_server.recorder import Recorder, SessionRecording
from mec_server.session import DecodeJob, OpenJob, RenderTooLate
from mec_server.twin.state import Twin
from rfcore.camera import Camera
from rfcore.codec.h264.splice import PictureDecoder
from rfcore.errors import PacketRejected, RfedgeError

__all__ = ["FrameResult", "ServerContext", "StreamDecoders"]


@dataclass(frozen=True)
class ServerContext:
    """The parts of one server that its streams share."""

    fields: FieldSource
    held_field_ids: Callable[[], tuple[str, ...]]
    workers: Workers
    """Threads that decode frames."""
    background: Workers
    """One that decodes those of identities whose work came to nothing lately, and gives way to the
    threads above where processors are scarce: a render cannot be interrupted."""
    opener: Workers
    """One thread that opens fields and decoders for new vehicles: a crowd of them, or a decoder
    process that is slow to start, must not delay the frames of others."""
    tools: Tools
    metrics: ServerMetrics
    limits: SessionLimits
    entry: EntryControl
    log_limiter: LogLimiter
    connections: Connections
    twin: Twin
    expect_picture: Callable[[str, Camera], None]
    """Called when the decoding of a picture with a pose begins: with its field's id and camera."""
    open_cameras: OpenCameras
    recorder: Recorder | None = None
    trials: UnrecordedTrials | None = None


class OpeningCancelled(RfedgeError):
    """The stream is over; its decoders are not wanted any more."""


@dataclass(frozen=True)
class FrameResult:
    """A reconstructed frame, or why there is none; and for how long it kept a worker busy."""

    reconstruction: Reconstruction | PacketRejected
    worker_s: float


class StreamDecoders:
    """Decodes the frames of one stream; used from the event loop only.

    Streams of the same ``owner`` share one turn at the workers and at the opener.
    """

    def __init__(self, server: ServerContext, session_id: str) -> None:
        self._server = server
        self._session_id = session_id
        self._owner = ""
        self._recording: SessionRecording | None = None
        self._decoders: dict[str, Decoder] = {}
        self._held: Hold | None = None
        self._closed = False

    async def open(self, owner: str, job: OpenJob, held: Hold) -> None:
        """Open fields and decoders for ``job``, on a thread that delays no frames.

        ``held``, what they are charged as, is released when the last of them is closed.
        Cancelled, it opens no more decoders and closes those that are open. Raises what
        ``OpenCameras`` raises.
        """
        opened: asyncio.Future[None] = asyncio.get_running_loop().create_future()

        def done(outcome: dict[str, Decoder] | Exception) -> None:
            self._count_opening(outcome)
            if isinstance(outcome, dict) and outcome:
                self._decoders, self._held = outcome, held
                if self._closed:
                    self._close_decoders()
            else:
                held.release()
            if opened.done():
                return
            if isinstance(outcome, Exception):
                opened.set_exception(outcome)
            else:
                opened.set_result(None)

        self._server.opener.submit(owner, partial(self._open_cameras, job), done)
        try:
            await opened
        except asyncio.CancelledError:
            self._closed = True
            raise
        self._owner = owner

    def submit(
        self,
        job: DecodeJob,
        expected_s: float,
        finished: Callable[[DecodeJob, FrameResult | Exception], None],
        *,
        in_background: bool = False,
    ) -> None:
        """Decode a frame on a worker, then call ``finished`` on the loop; never after ``close``.

        ``expected_s``: for how long it will keep the worker busy. One that would end after its
        deadline is rejected (``RenderTooLate``) when its turn comes, before anything is rendered.
        """

        def done(outcome: FrameResult | Exception | None) -> None:
            if outcome is not None and not self._closed:
                finished(job, outcome)

        workers = self._server.background if in_background else self._server.workers
        workers.submit(self._owner, partial(self._reconstruct, job, expected_s), done)

    def close(self) -> None:
        """Close the decoders on threads, those that are still being opened included."""
        self._closed = True
        self._close_decoders()

    def _open_cameras(self, job: OpenJob) -> dict[str, Decoder]:
        """Runs on the opener; the decoders of a stream that is over are not opened any more."""
        server = self._server

        def open_decoder(size_px: tuple[int, int]) -> PictureDecoder:
            self._check_wanted()
            return server.tools.open_decoder(size_px)

        self._check_wanted()
        if server.recorder is not None:
            self._recording = server.recorder.session(self._session_id, job.hello)
        tools = replace(server.tools, open_decoder=open_decoder)
        return server.open_cameras(job, server.fields, tools)

    def _check_wanted(self) -> None:
        if self._closed:
            raise OpeningCancelled("the stream ended before its decoders were open")

    def _count_opening(self, outcome: dict[str, Decoder] | Exception) -> None:
        metrics = self._server.metrics
        if isinstance(outcome, OpeningCancelled) or self._closed:
            metrics.count_opening(OpeningResult.CANCELLED)
        elif isinstance(outcome, Exception):
            metrics.count_opening(OpeningResult.FAILED)
        else:
            metrics.count_opening(OpeningResult.OPENED)
        if isinstance(outcome, Exception) and not isinstance(outcome, RfedgeError):
            metrics.task_failed(BackgroundTask.OPENING, outcome)

    def _close_decoders(self) -> None:
        decoders, self._decoders = self._decoders, {}
        held, self._held = self._held, None
        if held is None:
            return
        loop = asyncio.get_running_loop()
        closing = [
            loop.run_in_executor(None, self._close_decoder, decoder)
            for decoder in decoders.values()
        ]
        asyncio.gather(*closing).add_done_callback(lambda _: held.release())

    def _close_decoder(self, decoder: Decoder) -> None:
        try:
            decoder.close()
        except Exception as error:
            self._server.metrics.task_failed(BackgroundTask.CLOSING, error)

    def _reconstruct(self, job: DecodeJob, expected_s: float) -> FrameResult | None:
        """Runs on a worker; frames of a stream that is over are not decoded any more."""
        if self._closed:
            return None
        started_s = time.perf_counter()
        try:
            self._check_deadline(job, expected_s)
            reconstruction = self._decoders[job.frame.camera_id].reconstruct(job)
        except PacketRejected as error:
            return FrameResult(error, time.perf_counter() - started_s)
        worker_s = time.perf_counter() - started_s
        if self._recording is not None:
            self._recording.save(job.frame, job.field_id, reconstruction.picture)
        return FrameResult(reconstruction, worker_s)

    def _check_deadline(self, job: DecodeJob, expected_s: float) -> None:
        waited_s = time.monotonic() - job.received_s
        deadline_s = self._server.entry.render_deadline_s
        if waited_s + expected_s > deadline_s:
            raise RenderTooLate(waited_s, expected_s, deadline_s)
