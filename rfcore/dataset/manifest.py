"""A list of a directory's files with their SHA-256, so that damage is noticed before use.

``manifest.json`` is ``{"sha256": {"train/000.jpg": "<hex>", ...}}`` with paths relative to it;
other keys say how the directory was made and are not read.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from rfcore.errors import DatasetError
from rfcore.files import write_whole

MANIFEST_NAME = "manifest.json"


def write_manifest(directory: Path, about: Mapping[str, Any] | None = None) -> Path:
    """List every file under ``directory`` with its SHA-256; return the manifest's path.

    ``about`` stands before the list: what made the directory.
    """
    files = sorted(path for path in directory.rglob("*") if path.is_file())
    target = directory / MANIFEST_NAME
    digests = {
        path.relative_to(directory).as_posix(): _sha256(path) for path in files if path != target
    }
    write_whole(target, json.dumps({**(about or {}), "sha256": digests}, indent=1) + "\n")
    return target


def verify_manifest(directory: Path) -> None:
    """Raise ``DatasetError`` naming the first file that is missing or not as it was listed."""
    for name, digest in _listed(directory / MANIFEST_NAME).items():
        path = directory / name
        if not path.is_file():
            raise DatasetError(f"{path}: listed in {MANIFEST_NAME} but missing; restore it")
        found = _sha256(path)
        if found != digest:
            raise DatasetError(
                f"{path}: damaged, its sha256 is {found[:16]}... and should be {digest[:16]}...; "
                "restore it"
            )


def _listed(manifest: Path) -> dict[str, str]:
    try:
        digests = json.loads(manifest.read_bytes())["sha256"]
        items = {str(name): str(digest) for name, digest in digests.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DatasetError(f"{manifest}: not a readable manifest ({error!r})") from error
    for name in items:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise DatasetError(f"{manifest}: '{name}' leaves the directory")
    return items


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
