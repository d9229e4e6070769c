"""Our codec as one more coder of a clip: a field's renders, any references, whole wire messages.

A frame's bytes are those of the message that would go over the link: pose, digests, header and
slice. The sender's processor time holds the render, the choice of references, coding and the closed
loop. Pictures are what a receiver decoded from those very packets, not what the sender believes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from time import process_time_ns
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.h264.qp_map import QpMap
from rfcore.codec.photometric import Photometric
from rfcore.codec.references import INTRA, Reference, References, is_temporal, references_name
from rfcore.codec.sender.encoder import DeltaEncoder, FrameChoice
from rfcore.errors import InvalidInput
from rfcore.field import FULL, Quality, RadianceField, render_field_view
from rfcore.image import I420
from rfcore.views import FieldView
from rfcore.wire.head import FrameWriter
from rfcore.wire.messages import OUR_CONTRACT, CameraDescription, Frame, FrameAddress, Hello
from rfedge.evaluate.clips import CodedClip, Notes, luma_sse
from rfedge.evaluate.rivals import CodedPictures
from rfedge.offline import (
    CAMERA_ID,
    OFFLINE_VEHICLE,
    Arrival,
    FrameInput,
    decode_promised,
    encode_frames,
)

LIMITS = (1.0, 51.0)
CRFS = (17.0, 20.0, 23.0, 26.0, 29.0, 32.0, 35.0, 38.0)
COVERED = 0.5
WITHOUT_FIELD: References = (Reference.PREVIOUS,)
"""References of a coder without a field: each frame from the one before, the first alone."""
MESSAGE_TIME_NS = 1_700_000_000_000_000_000
"""When the first frame of a clip was taken; later ones are taken at the clip's rate."""


@dataclass(frozen=True)
class RenderedClip:
    """A field rendered at every pose of a clip, as both ends hold it, and what that took.

    ``covered``: bool [H, W] a frame, where the field shows anything (opacity above 1/2).
    """

    views: tuple[FieldView, ...]
    covered: tuple[NDArray[np.bool_], ...]
    field_id: str
    render_cpu_ms: float
    quality: Quality = FULL

    def of_run(self, run: slice) -> RenderedClip:
        """Return the renders of the frames ``run`` alone."""
        views, covered = self.views[run], self.covered[run]
        render_cpu_ms = self.render_cpu_ms * len(views) / len(self.views)
        return replace(self, views=views, covered=covered, render_cpu_ms=render_cpu_ms)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The camera of each view."""
        return tuple(view.camera for view in self.views)

    @property
    def renders(self) -> tuple[I420, ...]:
        """The picture of each view."""
        return tuple(view.render for view in self.views)

    @property
    def digest(self) -> str:
        """Digest of every picture, depth and camera: everything a result depends on."""
        cameras = hashlib.sha256(repr(self.cameras).encode()).hexdigest()
        arrays = ((*view.render.planes, view.depth) for view in self.views)
        return f"{_digest(chain.from_iterable(arrays))}-{cameras[:8]}"


def render_clip(
    field: RadianceField, cameras: Sequence[Camera], quality: Quality = FULL
) -> RenderedClip:
    """Render ``field`` from every camera, its pose rounded as a vehicle does before it renders.

    Processor time is that of all threads over the clip, without what a first render makes once.
    """
    cameras = [camera.rounded() for camera in cameras]
    field.render(cameras[0], quality)
    began_ns = process_time_ns()
    views = tuple(render_field_view(field, camera, quality) for camera in cameras)
    cpu_ms = (process_time_ns() - began_ns) / 1e6
    covered = tuple(view.covers(COVERED) for view in views)
    return RenderedClip(views, covered, field.field_id, cpu_ms, quality)


def _digest(arrays: Iterable[NDArray[Any]]) -> str:
    total = hashlib.sha256()
    for array in arrays:
        total.update(np.ascontiguousarray(array).data)
    return total.hexdigest()[:16]


class FieldCoder:
    """Codes the clip that a field was rendered along; ``version`` names the program that does.

    ``references``, ``photometric`` and ``relight`` None leave them to the encoder.

    ``qp_maps``, one a frame, code parts finer or coarser. With ``foregrounds``, bool [H, W] a
    frame, the notes have the luma's squared error there. They have the references, the bytes of
    the slice, whether the render was relit (1 or 0), and the digest of the whole message.
    """

    def __init__(
        self,
        rendered: RenderedClip,
        name: str,
        version: str,
        *,
        effort: str,
        references: References | None = None,
        photometric: Photometric | None = None,
        relight: bool | None = None,
        points: Sequence[float] = CRFS,
        foregrounds: Sequence[NDArray[np.bool_]] = (),
        qp_maps: Sequence[QpMap] = (),
    ) -> None:
        self.name = name
        self.points = tuple(points)
        self.limits = LIMITS
        self._program = version
        self._rendered = rendered
        self._effort = effort
        self._foregrounds = foregrounds
        self._qp_maps = qp_maps
        if references == WITHOUT_FIELD:
            photometric = ()
        self._choice = FrameChoice(references, photometric=photometric, relight=relight)
        first = references
        if references is not None and is_temporal(references):  # from the second frame on
            first = INTRA if references == WITHOUT_FIELD else None
        relight = None if relight is None else False
        self._first_choice = FrameChoice(first, photometric=photometric, relight=relight)
        self._renders = references != WITHOUT_FIELD

    @cached_property
    def version(self) -> str:
        """The program, the options of the encoder, and what the field shows along the clip."""
        choice = self._choice
        references = "chosen"
        if choice.references is not None:
            references = references_name(choice.references)
        light = "chosen" if choice.photometric is None else str(tuple(choice.photometric))
        light += "" if choice.relight is None else f", relit {choice.relight}"
        return (
            f"{self._program}; effort {self._effort}, references {references}, light {light}, "
            f"views {self._rendered.digest}, foregrounds {_digest(self._foregrounds)}, "
            f"qp {_digest(qp_map.offsets for qp_map in self._qp_maps)}"
        )

    def of_run(self, run: slice) -> FieldCoder:
        """Return the coder of the frames ``run`` alone."""
        part = copy(self)
        part._rendered, part._foregrounds = self._rendered.of_run(run), self._foregrounds[run]
        part._qp_maps = self._qp_maps[run]
        return part

    def code(self, frames: Sequence[I420], rate_hz: float, point: float) -> CodedClip:
        """Code and decode ``frames`` at CRF ``point``, taken at ``rate_hz``.

        The clip may be the beginning of the one that was rendered. Raises ``InvalidInput`` for a
        longer one, ``CodecError`` if a receiver does not see what the sender promised.
        """
        return self.pictures(frames, rate_hz, point).measured(point, frames)

    def pictures(self, frames: Sequence[I420], rate_hz: float, point: float) -> CodedPictures:
        """Return what ``code`` measures; takes and raises the same."""
        count = len(self._rendered.views)
        if not 0 < len(frames) <= count:
            raise InvalidInput("frames", f"{len(frames)} are outside the 1..{count} rendered")
        config = CodecConfig(*frames[0].size_px, effort=self._effort, crf=point)
        began_ns = process_time_ns()
        encoder = DeltaEncoder(config)
        coded = list(encode_frames(encoder, self._inputs(frames)))
        cpu_ms = (process_time_ns() - began_ns) / 1e6
        render_cpu_ms = self._renders * self._rendered.render_cpu_ms * len(frames) / count
        began_ns = process_time_ns()
        decoded = [picture for _, picture in decode_promised(DeltaDecoder(encoder.header), coded)]
        receiver_cpu_ms = (process_time_ns() - began_ns) / 1e6
        writer = MessageWriter(encoder.header, rate_hz, self._rendered.quality)
        messages = [writer.message(frame.arrival) for frame in coded]
        sizes = [len(message) for message in messages]
        both_ms = cpu_ms + render_cpu_ms, receiver_cpu_ms + render_cpu_ms
        packets = [coded_frame.encoded.packet for coded_frame in coded]
        notes: dict[str, Notes] = {
            "references": tuple(references_name(packet.references) for packet in packets),
            "slice_bytes": tuple(len(packet.payload) for packet in packets),
            "relit": tuple(float(packet.relit) for packet in packets),
            "message": tuple(map(_digest_of, messages)),
        }
        if self._foregrounds:
            masked = zip(decoded, frames, self._foregrounds, strict=False)
            notes["foreground_sse"] = tuple(luma_sse(*each) for each in masked)
        return CodedPictures(sizes, decoded, *both_ms, notes)

    def _inputs(self, frames: Sequence[I420]) -> Iterator[FrameInput]:
        for index, frame in enumerate(frames):
            choice = self._choice if index else self._first_choice
            if self._qp_maps:
                choice = replace(choice, qp_map=self._qp_maps[index])
            yield FrameInput(frame, self._rendered.views[index], choice)


class MessageWriter:
    """Makes the whole messages that carry the packets of a clip from a vehicle."""

    def __init__(self, header: StreamHeader, rate_hz: float, quality: Quality = FULL) -> None:
        self._header, self._rate_hz, self._quality = header, rate_hz, quality
        self._writer: FrameWriter | None = None
        self._last: FrameAddress | None = None

    def message(self, arrival: Arrival, after: int | None = None) -> bytes:
        """Return the message of a packet, sent after the one of sequence ``after``.

        Without ``after`` that is the one that was written last.
        """
        camera, packet = arrival.view.camera, arrival.packet
        if self._writer is None:
            front = CameraDescription(CAMERA_ID, camera.intrinsics, self._header, self._rate_hz)
            self._writer = FrameWriter(Hello(OFFLINE_VEHICLE, (front,), ("0" * 64,), OUR_CONTRACT))
        time_ns = MESSAGE_TIME_NS + round(1e9 * packet.sequence / self._rate_hz)
        frame = Frame(CAMERA_ID, time_ns, camera.world_from_cam, "", packet, self._quality)
        last = self._last
        if after is not None:
            last = FrameAddress(CAMERA_ID, packet.epoch, after)
        self._last = frame.address
        return self._writer.message(frame, last)


def _digest_of(message: bytes) -> str:
    return hashlib.sha256(message).hexdigest()[:16]
