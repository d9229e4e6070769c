"""A folder of certificates and keys: there as a whole or not at all, keys for the owner's eyes."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from rfcore.errors import InvalidInput
from rfcore.files import whole_folder
from rfedge.certs.issue import Issued

__all__ = ["write_certificates"]


def write_certificates(folder: Path, issued: Sequence[Issued], *, replace: bool = False) -> None:
    """Write ``NAME.pem`` and ``NAME.key`` (mode 0600) of each into a new folder.

    ``replace``: a folder that holds nothing but certificates makes way, at the end. Raises
    ``InvalidInput`` when the folder is there and may not be replaced, ``OSError``.
    """
    if not replace and folder.exists():
        raise InvalidInput("out", f"{folder} exists; --replace makes all its certificates anew")
    if replace and folder.exists():
        _check_replaceable(folder)
    new, old = (folder.with_name(f"{folder.name}.{age}") for age in ("new", "old"))
    with whole_folder(new) as partial:
        partial.chmod(0o700)
        for one in issued:
            (partial / f"{one.name}.pem").write_bytes(one.certificate)
            _write_key(partial / f"{one.name}.key", one.key)
        partial.chmod(0o755)  # the keys guard themselves, and services of other users read ca.pem
    if folder.exists():
        folder.rename(old)
    new.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def _check_replaceable(folder: Path) -> None:
    if folder.is_symlink() or not (folder / "ca.pem").is_file():
        raise InvalidInput("out", f"{folder} is no folder that `rfedge certs init` made")
    strangers = sorted(p.name for p in folder.iterdir() if p.suffix not in (".pem", ".key"))
    if strangers:
        raise InvalidInput("out", f"{folder} also holds {', '.join(strangers)}; move it away")


def _write_key(path: Path, key: bytes) -> None:
    """Write a file that nobody else could ever have read."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with open(descriptor, "wb") as file:  # noqa: PTH123 (a descriptor, not a path)
        file.write(key)
