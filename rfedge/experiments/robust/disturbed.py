"""Pose noise, its refinement, and bits at one quality, which say what a disturbance costs.

Noise is independent from frame to frame, normal in each axis of translation and rotation, in the
camera's own axes. Both ends render at the noisy pose, since it is the one that is sent; or the
sender first aligns the frame with the field's render there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rfcore.camera import Camera, Pose
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, render_field_view
from rfcore.image import I420
from rfcore.motion import quaternion_from_vector
from rfcore.views import FieldView
from rfedge.experiments.clips import CodedClip

__all__ = ["NOISES", "PoseNoise", "kbit_at", "noisy_cameras", "refined_cameras"]


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviations, per axis."""

    position_m: float = 0.0
    rotation_deg: float = 0.0

    def __str__(self) -> str:
        return f"{100 * self.position_m:g} cm, {self.rotation_deg:g} deg"


NOISES = (
    PoseNoise(),
    PoseNoise(0.02, 0.02),
    PoseNoise(0.05, 0.05),
    PoseNoise(0.1, 0.1),
    PoseNoise(0.2, 0.5),
)
"""From none to what a receiver of satellites alone gives."""


def noisy_cameras(cameras: Sequence[Camera], noise: PoseNoise, seed: int) -> list[Camera]:
    """Return ``cameras`` with their poses disturbed, the same way for every size of noise."""
    rng = np.random.default_rng(seed)
    disturbed = []
    for camera in cameras:
        shift, turn = rng.normal(size=3), rng.normal(size=3)
        x, y, z = (float(v) for v in noise.position_m * shift)
        a, b, c = (float(v) for v in np.deg2rad(noise.rotation_deg) * turn)
        step = Pose((x, y, z), quaternion_from_vector((a, b, c)))
        disturbed.append(Camera(camera.intrinsics, camera.world_from_cam.compose(step)))
    return disturbed


def refined_cameras(
    field: RadianceField, frames: Sequence[I420], measured: Sequence[Camera]
) -> list[Camera]:
    """Return where aligning each frame with the field puts its camera; measured where it fails.

    Each frame by itself, without search and track: what one alignment makes of noise.
    """
    from rfcore.localise.structure import Pyramid
    from rfcore.localise.track import TrackSettings, begun

    def refined(frame: I420, camera: Camera) -> Camera:
        def render_at(pose: Pose) -> FieldView:
            return render_field_view(field, Camera(camera.intrinsics, pose).rounded())

        levels = Pyramid(frame.y)
        track = begun(0, camera.world_from_cam, None, levels, render_at, TrackSettings())
        return camera if track is None else track.view.camera

    return [refined(frame, camera) for frame, camera in zip(frames, measured, strict=True)]


def kbit_at(clips: Sequence[CodedClip], quality_db: float) -> float:
    """Return kilobits a frame at a luma PSNR, log(bits) linear in dB between the clips' points,
    the first frame left out. Raises ``InvalidInput`` when they do not span the quality."""
    points = sorted((clip.psnr_db(), math.log(8e-3 * clip.bytes_per_frame())) for clip in clips)
    qualities = [db for db, _ in points]
    if not qualities[0] <= quality_db <= qualities[-1]:
        raise InvalidInput(
            "quality_db",
            f"{quality_db} dB is outside the {qualities[0]:.2f}..{qualities[-1]:.2f} dB reached",
        )
    return math.exp(float(np.interp(quality_db, qualities, [bits for _, bits in points])))
