"""A field of your own: a class that renders what a camera sees, in place of an archive.

rfedge encode samples/street/transforms_drive_empty.json --field examples.own_field:Plane \
    --out out/plane.rfv
rfedge decode out/plane.rfv --field examples.own_field:Plane --out out/plane

Replace the ray casting by your renderer: a checkpoint on a GPU, another splatting, a mesh. Vehicle
and server need the same class (`cav-agent --field`, `mec-server --field`).
"""

import hashlib
from pathlib import Path

import numpy as np

from rfcore.camera import Camera
from rfcore.field import Quality
from rfcore.views import View

ASPHALT, SKY = (0.35, 0.35, 0.37), (0.75, 0.82, 0.9)


class Plane:
    """Grey ground at z = 0 under a pale sky."""

    exact = True
    """The picture takes only operations that IEEE 754 fixes: the same bytes on every machine."""

    field_id = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
    """Both ends name the field by it. Digest what decides the picture, as a checkpoint's file."""

    def render(self, camera: Camera, quality: Quality) -> View:  # noqa: ARG002
        """Cast a ray through the centre of every pixel."""
        k = camera.intrinsics
        x, y = np.arange(k.width_px) + 0.5, np.arange(k.height_px) + 0.5
        across, down = np.meshgrid((x - k.cx_px) / k.fx_px, (y - k.cy_px) / k.fy_px)
        rises = np.array(camera.world_from_cam.rotation_matrix())[2]  # of a ray, in metres up
        up = rises[0] * across + rises[1] * down + rises[2]
        depth = np.where(up < 0, -camera.world_from_cam.translation_m[2] / np.minimum(up, -1e-9), 0)
        hit = (depth > 0)[..., None]
        return View(
            colour=np.where(hit, ASPHALT, SKY).astype(np.float32),
            depth=depth.astype(np.float32),
            opacity=hit[..., 0].astype(np.float32),
        )
