"""``rfedge scene poses``: a folder of pictures into a dataset, by structure from motion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional

__all__ = ["ScenePoses"]


@dataclass(frozen=True)
class ScenePoses:
    """Find the poses of pictures with COLMAP, in a new world or in a dataset's own."""

    images: Annotated[Path, Positional]
    """Folder of pictures (PNG, JPEG, WebP), in order of their names."""
    out: Path
    """The folder to make: pictures, points and transforms.json."""
    register_to: Path | None = None
    """A dataset whose world the poses shall be in; its poses and cameras are held."""
    camera: Literal["dataset", "estimate"] = "dataset"
    """With --register-to: take the dataset's camera, or estimate the intrinsics."""
    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP camera model of the new pictures, where it is not the dataset's camera."""
    parameters: tuple[float, ...] = ()
    """Its known parameters in COLMAP's order, which are held; default: estimated."""
    matching: Literal["exhaustive", "sequential"] = "exhaustive"
    """Match all pairs, or neighbours in a long drive."""
    max_side_px: int = 1600
    """Longest side at which features are looked for."""
    features: int = 8192
    """At most so many features a picture."""
    threads: int = 2
    """Threads."""
    seed: int = 1
    """Seed of the robust estimators."""

    def run(self) -> None:
        """Place the pictures and write the dataset; say which ones could not be placed."""
        from rfcore.errors import BackendUnavailable

        try:
            import pycolmap  # noqa: F401
        except ImportError as error:
            raise BackendUnavailable("pycolmap is missing: pip install 'rfedge[colmap]'") from error
        from rfedge.poses import PoseSettings, pose_dataset
        from rfedge.poses.settings import Matching, SharedCamera

        settings = PoseSettings(
            matching=Matching(self.matching),
            camera=SharedCamera(self.camera),
            model=self.camera_model,
            parameters=self.parameters,
            max_side_px=self.max_side_px,
            features=self.features,
            threads=self.threads,
            seed=self.seed,
        )
        print(pose_dataset(self.images, self.out, self.register_to, settings))
