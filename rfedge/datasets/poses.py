"""From a folder of pictures to a dataset with poses."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from rfcore.dataset.picture_file import SUFFIXES
from rfcore.dataset.read import read_source, refuse_video
from rfcore.dataset.write import WrittenPicture, write_transforms
from rfcore.errors import DatasetError
from rfcore.files import whole_folder
from rfedge.datasets.colmap_features import PoseSettings
from rfedge.datasets.colmap_solve import Solution, Tell, solve_poses

__all__ = ["pose_dataset"]

MIN_PICTURES = 3


def _nobody(_: str) -> None:
    """Tell nobody."""


def pose_dataset(
    images: Path,
    out: Path,
    register_to: Path | None,
    settings: PoseSettings,
    tell: Tell = _nobody,
) -> str:
    """Write ``out`` with the pictures that could be placed; return one line about it.

    ``tell`` is called with what is being done. Raises ``DatasetError`` when nothing can be
    placed, ``InvalidInput`` when ``out`` exists.
    """
    paths = _pictures(images, 1 if register_to is not None else MIN_PICTURES)
    known = read_source(register_to).pictures if register_to is not None else ()
    with whole_folder(out) as folder, TemporaryDirectory(dir=folder) as work:
        root = Path(work)
        (root / "new").mkdir()
        for path in paths:
            shutil.copyfile(path, root / "new" / path.name)
        names = [f"new/{path.name}" for path in paths]
        solution = solve_poses(root, names, known, settings, tell)
        _write(folder, root, names, solution)
    return _summary(out, solution)


def _pictures(images: Path, at_least: int) -> Sequence[Path]:
    refuse_video(images)
    found = sorted(images.glob("*"))
    paths = [path for path in found if path.suffix in SUFFIXES]
    if not paths:
        for path in found:
            refuse_video(path)
    if len(paths) < at_least:
        raise DatasetError(
            f"{images}: holds {len(paths)} pictures ({', '.join(SUFFIXES[:4])}), "
            f"at least {at_least} are needed"
        )
    return paths


def _write(folder: Path, root: Path, names: Sequence[str], solution: Solution) -> None:
    (folder / "images").mkdir()
    written = []
    for name in names:
        if name in solution.placed:
            camera, pose = solution.placed[name]
            target = f"images/{Path(name).name}"
            (root / name).rename(folder / target)
            written.append(WrittenPicture(target, camera, pose))
    write_transforms(folder, written, solution.points if len(solution.points.xyz_m) else None)


def _summary(out: Path, solution: Solution) -> str:
    line = f"{out}: {len(solution.placed)} pictures placed, {len(solution.points.xyz_m):,} points"
    if not solution.lost:
        return line
    return f"{line}; not placed: {', '.join(Path(name).name for name in solution.lost)}"
