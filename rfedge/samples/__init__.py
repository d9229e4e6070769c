"""The sample street, its field, scene files and link profiles, wherever rfedge runs.

A checkout has them in ``samples/``; a wheel carries a copy inside this package (CMakeLists.txt).
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["sample_path"]

HERE = Path("samples")
PACKAGED = Path(__file__).parent
CHECKOUT = PACKAGED.parents[1] / "samples"


def sample_path(name: str) -> Path:
    """Return where the sample ``name`` is: a file or folder such as ``street``, ``links/drive.up``.

    That is ``samples/`` of the working folder if it has it, else of the checkout, else of the
    wheel. A sample that is nowhere (the images carry none) is named in the working folder, for the
    reader to report.
    """
    folders = (folder for folder in (HERE, CHECKOUT, PACKAGED) if (folder / name).exists())
    return next(folders, HERE) / name
