"""Splats as OpenUSD, read back with usd-core."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdVol

from rfcore.camera import Pose
from rfcore.field.similarity import Similarity, moved
from rfcore.field.usd import write_usd
from tests.field.some import make_gaussians


@pytest.mark.parametrize("name", ["a.usdc", "a.usda"])
@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)])
def test_usd_core_reads_the_splats_that_were_written(tmp_path, name, up):
    splats = make_gaussians(30, 2)
    write_usd(tmp_path / name, splats, up=up)
    stage = Usd.Stage.Open(str(tmp_path / name))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    prim = stage.GetDefaultPrim()
    assert prim.IsA(UsdVol.ParticleField3DGaussianSplat)
    if up[1]:  # y becomes z
        splats = moved(splats, Similarity(Pose((0, 0, 0), (0.5**0.5, 0.5**0.5, 0, 0))))
    values = {a.GetName(): a.Get() for a in prim.GetAuthoredAttributes()}
    turns = splats.quaternions / np.linalg.norm(splats.quaternions, axis=1, keepdims=True)
    wanted = {
        "positions": splats.means,
        "scales": np.exp(splats.log_scales),
        "opacities": 1 / (1 + np.exp(-splats.opacity_logits)),
        "radiance:sphericalHarmonicsCoefficients": splats.sh.reshape(-1, 3),
    }
    for key, array in wanted.items():
        np.testing.assert_allclose(values[key], array, rtol=1e-5, atol=1e-5, err_msg=key)
    found = np.array([[q.GetReal(), *q.GetImaginary()] for q in values["orientations"]])
    np.testing.assert_allclose(found, turns, atol=1e-5)
    assert values["radiance:sphericalHarmonicsDegree"] == 2
    low, high = np.array(values["extent"])
    assert (low < splats.means).all()
    assert (high > splats.means).all()
