"""Reconstruction of one session's frames: render, convert, splice, decode; on worker threads.

Nothing here knows asyncio or gRPC. One ``CameraDecoder`` is used by one thread at a time, since a
session decodes one frame of a camera at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from mec_server.decoding.decoders import OpenDecoder
from mec_server.session import DecodeJob, DecodeOutcome, OpenJob
from rfcore.codec.decoder import DeltaDecoder
from rfcore.errors import CodecError, InvalidInput, PacketRejected, RejectReason
from rfcore.field import CodecPictureRenderer, Renderer
from rfcore.image import I420
from rfcore.native.yuv import field_view_from_view
from rfcore.views import FieldView, View
from rfcore.wire.messages import CameraDescription, StageTimes

__all__ = [
    "CameraDecoder",
    "Decoder",
    "FieldSource",
    "OpenCameras",
    "Reconstruction",
    "Tools",
    "open_cameras",
]

ClockNs = Callable[[], int]


class FieldSource(Protocol):
    """Opens fields."""

    def open(self, field_id: str) -> Renderer:
        """Return the field; raise ``UnknownField`` or ``InvalidData``."""


@dataclass(frozen=True)
class Tools:
    """A clock for the times of stages, and what opens H.264 decoders."""

    clock_ns: ClockNs
    open_decoder: OpenDecoder


@dataclass(frozen=True)
class Reconstruction:
    """A frame, identical to the one in the vehicle's closed loop, and its ``outcome``.

    ``render``: what the field shows there, at the frame's quality; ``None`` where nothing was
    rendered, as for a camera that is lost, and where a device did and kept the colours.
    """

    picture: I420
    outcome: DecodeOutcome
    render: View | None = None


class Decoder(Protocol):
    """Reconstructs the frames of one camera."""

    def reconstruct(self, job: DecodeJob) -> Reconstruction:
        """Return the frame of ``job``; raise ``PacketRejected`` and stay good for the next."""

    def close(self) -> None:
        """Give back what it holds."""


OpenCameras = Callable[[OpenJob, FieldSource, Tools], dict[str, Decoder]]


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

    def close(self) -> None:
        """Close the decoder; waits for a frame that is being decoded."""
        self._decoder.close()

    def reconstruct(self, job: DecodeJob) -> Reconstruction:
        """Return the frame of ``job``; raise ``PacketRejected`` and stay good for the next."""
        try:
            return self._reconstruct(job)
        except CodecError as error:  # costs this frame, not the stream
            raise PacketRejected(RejectReason.DECODER_FAILED, str(error)) from error

    def _reconstruct(self, job: DecodeJob) -> Reconstruction:
        started_ns = self._clock_ns()
        render, view = self._render(job)
        rendered_ns = self._clock_ns()
        decoded = self._decoder.decode_checked(self._state, job.packet, view)
        self._state = decoded.state
        times = StageTimes(
            render_ns=rendered_ns - started_ns,
            splice_ns=decoded.stage_ns.get("splice", 0),
            decode_ns=decoded.stage_ns.get("decode", 0),
        )
        digest = decoded.state.kept[0].digest
        outcome = DecodeOutcome(digest, times, decoded.exact)
        return Reconstruction(decoded.frame, outcome, render)

    def _render(self, job: DecodeJob) -> tuple[View | None, FieldView]:
        """Return what the field shows at the frame's pose, where the CPU has it, and that as the
        codec holds it; nothing of either if the camera is lost."""
        camera = job.frame.camera(self._camera.intrinsics)
        if camera is None:
            return None, FieldView.nothing(self._camera.intrinsics)
        renderer, quality = self._renderers[job.field_id], job.frame.quality
        try:
            if isinstance(renderer, CodecPictureRenderer) and renderer.is_on_device:
                return None, renderer.field_view(camera, quality)
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
