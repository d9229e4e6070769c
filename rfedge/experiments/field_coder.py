"""Our codec as one more coder of a clip: a field's renders, any references, whole wire messages.

A frame's bytes are those of the message that would go over the link: pose, digests, header and
slice. The sender's processor time holds the render, the choice of references, x264 and the closed
loop. Pictures are what a receiver decoded from those very packets, not what the sender believes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import process_time_ns

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.photometric import Photometric
from rfcore.codec.references import References, is_temporal, references_name
from rfcore.codec.sender.encoder import DeltaEncoder, Encoded, FrameChoice
from rfcore.errors import CodecError, InvalidInput
from rfcore.field import RadianceField, render_field_view
from rfcore.image import I420
from rfcore.views import FieldView
from rfcore.wire.convert import client_message_to_bytes
from rfcore.wire.messages import Frame
from rfedge.experiments.clips import CodedClip, luma_mse, luma_sse
from rfedge.experiments.picture_quality import luma_ssim

__all__ = ["FieldCoder", "SeenClip", "see_clip"]

CRFS = (17.0, 20.0, 23.0, 26.0, 29.0, 32.0, 35.0, 38.0)
COVERED = 0.5
MESSAGE_CAMERA = "front"
MESSAGE_TIME_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class SeenClip:
    """A field seen from every pose of a clip, as both ends hold it, and what rendering took.

    ``covered``: bool [H, W] a frame, where the field shows anything (opacity above 1/2).
    """

    views: tuple[FieldView, ...]
    covered: tuple[NDArray[np.bool_], ...]
    field_id: str
    render_cpu_ms: float

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The camera of each view."""
        return tuple(view.camera for view in self.views)

    @property
    def renders(self) -> tuple[I420, ...]:
        """The picture of each view."""
        return tuple(view.render for view in self.views)


def see_clip(field: RadianceField, cameras: Sequence[Camera]) -> SeenClip:
    """Render ``field`` from every camera, its pose rounded as a vehicle does before it renders."""
    cameras = [camera.rounded() for camera in cameras]
    field.render(cameras[0])  # what is made lazily is not held against the first frame
    began_ns = process_time_ns()
    views = tuple(render_field_view(field, camera) for camera in cameras)
    cpu_ms = (process_time_ns() - began_ns) / 1e6
    covered = tuple(view.covers(COVERED) for view in views)
    return SeenClip(views, covered, field.field_id, cpu_ms)


class FieldCoder:
    """Codes the clip a field was seen along. ``references`` None leaves them to the encoder.

    With ``foregrounds``, bool [H, W] a frame, the notes have the luma's squared error there.
    """

    def __init__(
        self,
        seen: SeenClip,
        name: str,
        version: str,
        *,
        preset: str,
        references: References | None = None,
        photometric: Photometric | None = None,
        points: Sequence[float] = CRFS,
        foregrounds: Sequence[NDArray[np.bool_]] = (),
    ) -> None:
        self.name = name
        self.version = version
        self.points = tuple(points)
        self._seen = seen
        self._preset = preset
        self._foregrounds = foregrounds
        self._choice = FrameChoice(references=references, photometric=photometric)
        # Temporal references exist from the second frame on.
        temporal = references is not None and is_temporal(references)
        self._first_choice = FrameChoice(photometric=photometric) if temporal else self._choice

    def code(self, frames: Sequence[I420], rate_hz: float, point: float) -> CodedClip:
        """Code and decode ``frames`` at CRF ``point``; ``rate_hz`` changes nothing here.

        The clip may be the beginning of the one that was seen. Raises ``InvalidInput`` for a longer
        one, ``CodecError`` if a receiver does not see what the sender promised.
        """
        del rate_hz
        seen = len(self._seen.views)
        if not 0 < len(frames) <= seen:
            raise InvalidInput("frames", f"{len(frames)} are outside the 1..{seen} that were seen")
        config = CodecConfig(*frames[0].size_px, preset=self._preset, crf=point)
        began_ns = process_time_ns()
        encoder = DeltaEncoder(config)
        coded = self._coded(encoder, frames)
        cpu_ms = (process_time_ns() - began_ns) / 1e6
        cpu_ms += self._seen.render_cpu_ms * len(frames) / seen
        decoded = self._decoded(encoder, coded)
        pairs = list(zip(decoded, frames, strict=True))
        notes: dict[str, tuple[float | str, ...]] = {
            "references": tuple(references_name(made.packet.references) for made in coded),
            "slice_bytes": tuple(len(made.packet.payload) for made in coded),
        }
        if self._foregrounds:
            masked = zip(pairs, self._foregrounds, strict=False)
            notes["foreground_sse"] = tuple(luma_sse(*pair, mask) for pair, mask in masked)
        return CodedClip(
            point,
            np.array([self._message_bytes(k, made) for k, made in enumerate(coded)]),
            np.array([luma_mse(*pair) for pair in pairs]),
            np.array([luma_ssim(ours.y, theirs.y) for ours, theirs in pairs]),
            cpu_ms,
            notes,
        )

    def _coded(self, encoder: DeltaEncoder, frames: Sequence[I420]) -> list[Encoded]:
        state = encoder.start(1)
        coded = []
        for index, frame in enumerate(frames):
            choice = self._choice if index else self._first_choice
            made = encoder.encode(state, frame, self._seen.views[index], choice)
            state = made.state
            coded.append(made)
        return coded

    def _decoded(self, encoder: DeltaEncoder, coded: Sequence[Encoded]) -> list[I420]:
        decoder = DeltaDecoder(encoder.header)
        state = decoder.start(1)
        pictures = []
        for index, made in enumerate(coded):
            decoded = decoder.decode(state, made.packet, self._seen.views[index])
            state = decoded.state
            if decoded.frame.digest() != made.reconstruction.digest():
                raise CodecError(f"frame {index} decodes to another picture than was promised")
            pictures.append(decoded.frame)
        return pictures

    def _message_bytes(self, index: int, made: Encoded) -> int:
        pose = self._seen.views[index].camera.world_from_cam
        message = Frame(MESSAGE_CAMERA, MESSAGE_TIME_NS, pose, b"", made.packet)
        return len(client_message_to_bytes(message))
