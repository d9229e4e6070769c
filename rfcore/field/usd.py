"""3D Gaussians as OpenUSD: one ``ParticleField3DGaussianSplat`` (schema UsdVol, from 26.03 on).

Written, not read. z is up and a unit is a metre. Opacities and scales are linear; harmonics are in
the order of ``rfcore.harmonics``, those of a splat together. The schema has no word for splats that
are drawn antialiased.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rfcore.camera import Vec3
from rfcore.extras import needs
from rfcore.field.similarity import Similarity, moved
from rfcore.field.stored_splats import linear_parts
from rfcore.files import write_whole
from rfcore.raster.gaussians import Gaussians
from rfcore.vertical import Z_UP, upright_from

PRIM = "/Splats"
CUTOFF = 3.0
"""Standard deviations that a splat's extent reaches."""


def write_usd(path: Path, gaussians: Gaussians, *, up: Vec3) -> None:
    """Write ``path``, a .usdc or .usda, whole or not at all; ``up`` becomes z.

    Raises ``BackendUnavailable`` without usd-core.
    """
    with needs("usd"):
        from pxr import Usd, UsdGeom, UsdVol, Vt

    if up != Z_UP:
        gaussians = moved(gaussians, Similarity(upright_from(up)))
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, PRIM).GetPrim()
    stage.SetDefaultPrim(prim)
    xyzw, scales, opacities = linear_parts(gaussians)
    reach = CUTOFF * scales.max(axis=1, keepdims=True)
    extent = [(gaussians.means - reach).min(axis=0), (gaussians.means + reach).max(axis=0)]
    vectors, quaternions = Vt.Vec3fArray.FromNumpy, Vt.QuatfArray.FromNumpy
    for name, value in (
        ("positions", vectors(gaussians.means)),
        ("orientations", quaternions(xyzw.astype(np.float32))),
        ("scales", vectors(scales.astype(np.float32))),
        ("opacities", Vt.FloatArray.FromNumpy(opacities.astype(np.float32))),
        ("extent", vectors(np.array(extent, np.float32))),
        ("radiance:sphericalHarmonicsDegree", gaussians.sh_degree),
        ("radiance:sphericalHarmonicsCoefficients", vectors(gaussians.sh.reshape(-1, 3))),
        ("projectionModeHint", "perspective"),
        ("sortingModeHint", "zDepth"),
    ):
        prim.GetAttribute(name).Set(value)
    with TemporaryDirectory() as folder:
        made = Path(folder) / f"splats{path.suffix}"
        stage.Export(str(made))
        write_whole(path, made.read_bytes())
