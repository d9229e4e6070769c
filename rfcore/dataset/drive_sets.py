"""Tell public sets of drives by their files, and open them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rfcore.dataset import argoverse, boreas, comma2k19, log_123d, nuscenes
from rfcore.dataset.drive_set import DriveSet

SETS: dict[str, tuple[str, Callable[[Path], DriveSet]]] = {
    argoverse.POSES: (argoverse.POSES, argoverse.ArgoverseLog),
    nuscenes.TABLE: (f"*/{nuscenes.TABLE}", nuscenes.NuScenes),
    log_123d.SYNC: (log_123d.SYNC, log_123d.Log123D),
    boreas.POSES: (f"applanix/{boreas.POSES}", boreas.BoreasDrive),
    comma2k19.POSITIONS: (f"global_pose/{comma2k19.POSITIONS}", comma2k19.CommaSegment),
}
"""Where the file lies that a set is recognised by, and what reads the set, by that file's name."""


def drive_set_files(folder: Path) -> list[Path]:
    """Return the files by which sets of drives in a folder are recognised."""
    return [
        file
        for name, (pattern, _) in SETS.items()
        for file in sorted({*folder.glob(pattern), *folder.glob(name)})
        if file.is_file()
    ]


def open_drive_set(file: Path) -> DriveSet | None:
    """Open the set of drives that a file is of, None if it is of none."""
    if file.name not in SETS or not file.is_file():
        return None
    return SETS[file.name][1](file)


def without_choice(path: Path) -> tuple[Path, str]:
    """Return the path of ``PATH#NAME`` and the name; "" where no file is called by such a path."""
    text = str(path)
    at = -1 if path.exists() else text.find("#")
    while at >= 0:
        if Path(text[:at]).exists():
            return Path(text[:at]), text[at + 1 :]
        at = text.find("#", at + 1)
    return path, ""
