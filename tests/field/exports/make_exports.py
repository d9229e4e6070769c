"""Make the files of this folder: the same splats, exported by other programs.

``python tests/field/exports/make_exports.py NODE_2 NODE_3 EXPORTER.py``: two folders in which npm
installed ``@playcanvas/splat-transform`` 2.7.1 and 3.7.0, and ``gsplat/exporter.py`` of gsplat
1.5.3, which needs torch.
"""

import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rfcore.field import write_ply
from rfcore.raster.gaussians import Gaussians

HERE = Path(__file__).parent
COUNT = 27


def source_splats() -> Gaussians:
    """Splats on a grid, so that each is found again in whatever order it is written."""
    rng = np.random.default_rng(47)
    steps = np.arange(-1.0, 2.0)
    means = np.stack(np.meshgrid(steps, 2 * steps, 4 + steps), axis=-1).reshape(-1, 3)
    return Gaussians(
        means.astype(np.float32),
        rng.normal(size=(COUNT, 4)).astype(np.float32),
        rng.uniform(-4, -1, (COUNT, 3)).astype(np.float32),
        np.linspace(-3, 12, COUNT).astype(np.float32),
        rng.uniform(-0.8, 0.8, (COUNT, 16, 3)).astype(np.float32),
    )


def main(node_2: Path, node_3: Path, exporter: Path) -> None:
    """Write every file."""
    import torch

    splats = source_splats()
    with TemporaryDirectory() as folder:
        ply = Path(folder) / "source.ply"
        write_ply(ply, splats, antialiased=True)

        def transform(node: Path, *words: str | Path) -> None:
            program = node / "node_modules" / ".bin" / "splat-transform"
            subprocess.run([program, "-q", "-w", "-g", "cpu", *words], check=True)

        transform(node_2, ply, HERE / "splat-transform-2.7.1.spz")
        transform(node_3, ply, HERE / "splat-transform-3.7.0.spz")
        transform(node_3, "--spz-version", "3", ply, HERE / "splat-transform-3.7.0.v3.spz")
        transform(node_3, ply, HERE / "splat-transform-3.7.0.compressed.ply")
        transform(node_3, ply, Path(folder) / "source.sog")
        transform(node_3, Path(folder) / "source.sog", HERE / "splat-transform-3.7.0.sog.ply")
    spec = spec_from_file_location("exporter", exporter)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    arrays = [
        *(splats.means, splats.log_scales, splats.quaternions, splats.opacity_logits),
        *(splats.sh[:, :1], splats.sh[:, 1:]),
    ]
    tensors = [torch.from_numpy(np.ascontiguousarray(array)) for array in arrays]
    module.export_splats(*tensors, format="ply", save_to=HERE / "gsplat-1.5.3.ply")
    tensors[5] = tensors[5][:, :0]
    module.export_splats(
        *tensors, format="ply_compressed", save_to=HERE / "gsplat-1.5.3.compressed.ply"
    )


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
