"""Find the sample street, its field, scene files and link profiles, wherever rfedge runs.

A checkout has them in ``samples/``; a wheel carries a copy inside this package (CMakeLists.txt).
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["sample_path"]

HERE = Path("samples")
PACKAGED = Path(__file__).parent
CHECKOUT = PACKAGED.parents[1] / "samples"


def sample_path(name: str) -> Path:
    """Return the path of a sample, a file or folder such as ``street`` or ``links/drive.up``.

    It is looked for in ``samples/`` of the working folder, then of the checkout, then of the wheel.
    The path of a sample that is nowhere (images carry none) is in the working folder, so that the
    reader's error names a place where the user can put it.
    """
    folders = (folder for folder in (HERE, CHECKOUT, PACKAGED) if (folder / name).exists())
    return next(folders, HERE) / name
