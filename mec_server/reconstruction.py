"""Reconstruction of one stream's frames: render, convert, splice, decode; on worker threads.

``StreamDecoders`` opens the decoders of a stream for its Hello, runs them on the server's workers
and closes them with the stream; it is used from the event loop. ``CameraDecoder`` does the work for
one camera; one thread uses it at a time, since a session decodes one frame of a camera at a time.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

from mec_server.decoding.decoders import OpenDecoder
from mec_server.event_loop import Workers
from mec_server.ledger.ledger import Hold
from mec_server.metrics import BackgroundTask, OpeningResult, ServerMetrics
from mec_server.recorder import Recorder, SessionRecording
from mec_server.session import DecodeJob, OpenJob, PrepareJob, RenderTooLate
from rfcore.camera import Camera
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.splice import PictureDecoder
from rfcore.codec.packet import DeltaPacket
from rfcore.codec.prediction import Prediction
from rfcore.errors import CodecError, InvalidInput, PacketRejected, RejectReason, RfedgeError
from rfcore.field import Quality, Renderer, codec_renderer
from rfcore.image import I420
from rfcore.native.yuv import field_view_from_view
from rfcore.views import FieldView, View
from rfcore.wire.messages import CameraDescription, StageTimes

ClockNs = Callable[[], int]


class FieldSource(Protocol):
    """Opens fields."""

    def open(self, field_id: str) -> Renderer:
        """Return the field; raise ``UnknownField`` or ``InvalidData``."""


@dataclass(frozen=True)
class Tools:
    """The clock that stages are timed by, and the function that opens H.264 decoders."""

    clock_ns: ClockNs
    open_decoder: OpenDecoder


@dataclass(frozen=True)
class Reconstruction:
    """A picture, identical to the one in the vehicle's closed loop, and its ``digest``.

    ``times``: of the stages. ``exact``: false when the two renders differed by rounding, and the
    pictures with them. ``render``: the field's view there, at the frame's quality; None where
    nothing was rendered, as for a camera that is lost, and where a device kept the colours.
    """

    picture: I420
    digest: bytes
    times: StageTimes
    exact: bool = True
    render: View | None = None


class Decoder(Protocol):
    """Reconstructs the frames of one camera."""

    def prepare(self, job: PrepareJob) -> None:
        """Do what can be done before the frame of ``job`` comes; raise ``PacketRejected``."""

    def reconstruct(self, job: DecodeJob) -> Reconstruction:
        """Return the frame of ``job``; raise ``PacketRejected`` and stay good for the next."""

    def close(self) -> None:
        """Release the decoder process and the field."""


OpenCameras = Callable[[OpenJob, FieldSource, Tools], dict[str, Decoder]]


@dataclass(frozen=True)
class Place:
    """All that a render depends on; ``camera`` is None while it is lost."""

    camera: Camera | None
    field_id: str
    quality: Quality


@dataclass(frozen=True, eq=False)
class Prepared:
    """Render and references made for the next frame before it came, in ``took_ns``."""

    place: Place
    render: View | None
    view: FieldView
    prediction: Prediction
    took_ns: int


class CameraDecoder:
    """Reconstructs the frames of one camera against this server's own renders."""

    def __init__(
        self,
        camera: CameraDescription,
        renderers: Mapping[str, Renderer],
        exact: bool,
        tools: Tools,
    ) -> None:
        self._camera = camera
        self._renderers = renderers
        self._clock_ns = tools.clock_ns
        self._decoder = DeltaDecoder(camera.codec, exact, tools.clock_ns, tools.open_decoder)
        self._state = self._decoder.start()
        self._before: DeltaPacket | None = None
        self._prepared: Prepared | None = None

    def close(self) -> None:
        """Close the decoder; waits for a frame that is being decoded."""
        self._decoder.close()

    def prepare(self, job: PrepareJob) -> None:
        """Render where the next frame was taken, and make the references that the last one had.

        Raises ``PacketRejected`` for a pose that cannot be rendered. What was prepared before is
        dropped.
        """
        started_ns, self._prepared = self._clock_ns(), None
        if job.ahead.pose is None:
            return
        camera = Camera(self._camera.intrinsics, job.ahead.pose)
        place = Place(camera, job.field_id, job.ahead.quality)
        render, view = self._render(place)
        made = self._decoder.prepared(self._state, view, job.ahead.base_digest, self._before)
        self._prepared = Prepared(place, render, view, made, self._clock_ns() - started_ns)

    def reconstruct(self, job: DecodeJob) -> Reconstruction:
        """Return the frame of ``job``; raise ``PacketRejected`` and stay good for the next."""
        try:
            return self._reconstruct(job)
        except CodecError as error:  # costs this frame, not the stream
            raise PacketRejected(RejectReason.DECODER_FAILED, str(error)) from error

    def _reconstruct(self, job: DecodeJob) -> Reconstruction:
        started_ns = self._clock_ns()
        ahead, self._prepared = self._prepared, None
        camera = job.frame.camera(self._camera.intrinsics)
        place = Place(camera, job.field_id, job.frame.quality)
        if ahead is not None and ahead.place != place:
            ahead = None
        render, view = self._render(place) if ahead is None else (ahead.render, ahead.view)
        rendered_ns = self._clock_ns()
        made = None if ahead is None else ahead.prediction
        decoded = self._decoder.decode_checked(self._state, job.packet, view, made)
        self._state, self._before = decoded.state, job.packet.packet
        times = StageTimes(
            render_ns=rendered_ns - started_ns,
            splice_ns=decoded.stage_ns.get("splice", 0),
            decode_ns=decoded.stage_ns.get("decode", 0),
            ahead_ns=0 if ahead is None else ahead.took_ns,
        )
        digest = decoded.state.kept[0].digest
        return Reconstruction(decoded.frame, digest, times, decoded.exact, render)

    def _render(self, place: Place) -> tuple[View | None, FieldView]:
        """Return the field's view there, and its form for the codec.

        The view is None where only a device has it, and where the camera is lost.
        """
        camera, quality = place.camera, place.quality
        if camera is None:
            return None, FieldView.nothing(self._camera.intrinsics)
        renderer = self._renderers[place.field_id]
        try:
            quicker = codec_renderer(renderer)
            if quicker is not None and quicker.is_on_device:
                return None, quicker.field_view(camera, quality)
            render = renderer.render(camera, quality)
            return render, field_view_from_view(render, camera)
        except InvalidInput as error:
            raise PacketRejected(RejectReason.INVALID_ARGUMENT, str(error)) from error


def open_cameras(job: OpenJob, fields: FieldSource, tools: Tools) -> dict[str, Decoder]:
    """Return a decoder for each camera of a Hello, to be closed one by one.

    Raises ``InvalidInput`` for a codec header that our encoder would not have made, ``CodecError``
    if there is no decoder to be had, and what ``fields`` raises.
    """
    renderers = {field_id: fields.open(field_id) for field_id in job.hello.field_ids}
    decoders: dict[str, Decoder] = {}
    for index, camera in enumerate(job.hello.cameras):
        try:
            decoders[camera.camera_id] = CameraDecoder(camera, renderers, job.exact, tools)
        except Exception as error:
            for opened in decoders.values():
                opened.close()
            if not isinstance(error, InvalidInput):
                raise
            name = f"hello.cameras[{index}].{error.field}"
            raise InvalidInput(name, error.problem) from error
    return decoders


@dataclass(frozen=True)
class DecodingParts:
    """The parts of a server that decode the frames of all streams."""

    fields: FieldSource
    workers: Workers
    """Threads that decode frames."""
    background: Workers
    """One thread for frames of identities whose frames were rejected lately; it gives way to the
    threads above where processors are scarce, since a render cannot be interrupted."""
    opener: Workers
    """One thread that opens fields and decoders for new vehicles: a crowd of them, or a decoder
    process that is slow to start, must not delay the frames of others."""
    tools: Tools
    metrics: ServerMetrics
    render_deadline_s: float
    open_cameras: OpenCameras = open_cameras
    recorder: Recorder | None = None


class OpeningCancelled(RfedgeError):
    """The stream is over; its decoders are not wanted any more."""


Finished = Callable[[DecodeJob, Reconstruction | Exception, float], None]
"""Takes the outcome of a job (``PacketRejected``, or an unexpected exception) and the seconds for
which it kept a worker busy."""


class StreamDecoders:
    """Decodes the frames of one stream; used from the event loop only.

    Streams of the same ``owner`` take one turn together at the workers and at the opener.
    """

    def __init__(self, parts: DecodingParts, session_id: str) -> None:
        self._parts = parts
        self._session_id = session_id
        self._owner = ""
        self._recording: SessionRecording | None = None
        self._decoders: dict[str, Decoder] = {}
        self._held: Hold | None = None
        self._closed = False

    async def open(self, owner: str, job: OpenJob, held: Hold) -> None:
        """Open fields and decoders for ``job``, on a thread that delays no frames.

        ``held``, which the decoders are charged as, is released when the last of them is closed.
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

        self._parts.opener.submit(owner, partial(self._open_cameras, job), done)
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
        finished: Finished,
        *,
        in_background: bool = False,
    ) -> None:
        """Decode a frame on a worker, then call ``finished`` on the loop; never after ``close``.

        ``expected_s``: how long the frame will keep the worker busy. One that would end after its
        deadline is rejected (``RenderTooLate``) when its turn comes, before it is rendered.
        """

        def done(outcome: tuple[Reconstruction | PacketRejected, float] | Exception | None) -> None:
            if self._closed or outcome is None:
                return
            if isinstance(outcome, Exception):
                finished(job, outcome, 0.0)
            else:
                finished(job, *outcome)

        workers = self._parts.background if in_background else self._parts.workers
        workers.submit(self._owner, partial(self._reconstruct, job, expected_s), done)

    @property
    def has_room(self) -> bool:
        """Whether a worker is free for what is not urgent."""
        return self._parts.workers.has_room

    def prepare(
        self, job: PrepareJob, finished: Callable[[PrepareJob, float | Exception], None]
    ) -> None:
        """Prepare for a frame on a worker, then call ``finished`` on the loop with the seconds for
        which that kept the worker busy, or an unexpected exception; never after ``close``."""

        def done(outcome: float | Exception) -> None:
            if not self._closed:
                finished(job, outcome)

        self._parts.workers.submit(self._owner, partial(self._prepare, job), done)

    def close(self) -> None:
        """Close the decoders on threads, those that are still being opened included."""
        self._closed = True
        self._close_decoders()

    def _open_cameras(self, job: OpenJob) -> dict[str, Decoder]:
        """Runs on the opener; the decoders of a stream that is over are not opened any more."""
        parts = self._parts

        def open_decoder(size_px: tuple[int, int]) -> PictureDecoder:
            self._check_wanted()
            return parts.tools.open_decoder(size_px)

        self._check_wanted()
        if parts.recorder is not None:
            self._recording = parts.recorder.session(self._session_id, job.hello)
        tools = replace(parts.tools, open_decoder=open_decoder)
        return parts.open_cameras(job, parts.fields, tools)

    def _check_wanted(self) -> None:
        if self._closed:
            raise OpeningCancelled("the stream ended before its decoders were open")

    def _count_opening(self, outcome: dict[str, Decoder] | Exception) -> None:
        metrics = self._parts.metrics
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
            self._parts.metrics.task_failed(BackgroundTask.CLOSING, error)

    def _reconstruct(
        self, job: DecodeJob, expected_s: float
    ) -> tuple[Reconstruction | PacketRejected, float] | None:
        """Return the outcome of a frame and how long it kept the worker, which this runs on, busy.

        Frames of a stream that is over are not decoded any more.
        """
        if self._closed:
            return None
        started_s = time.perf_counter()
        try:
            self._check_deadline(job, expected_s)
            reconstruction = self._decoders[job.frame.camera_id].reconstruct(job)
        except PacketRejected as error:
            return error, time.perf_counter() - started_s
        worker_s = time.perf_counter() - started_s
        if self._recording is not None:
            self._recording.save(job.frame, job.field_id, reconstruction.picture)
        return reconstruction, worker_s

    def _prepare(self, job: PrepareJob) -> float:
        """Return for how long it kept the worker busy; a pose that cannot be rendered is refused
        with its frame."""
        started_s = time.perf_counter()
        if not self._closed:
            with suppress(PacketRejected):
                self._decoders[job.ahead.camera_id].prepare(job)
        return time.perf_counter() - started_s

    def _check_deadline(self, job: DecodeJob, expected_s: float) -> None:
        waited_s = time.monotonic() - job.received_s
        deadline_s = self._parts.render_deadline_s
        if waited_s + expected_s > deadline_s:
            raise RenderTooLate(waited_s, expected_s, deadline_s)
