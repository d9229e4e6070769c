"""Reads certificates back, for people."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from cryptography import x509

from rfcore.errors import InvalidData, InvalidInput

__all__ = ["Says", "read_certificates"]


@dataclass(frozen=True)
class Says:
    """Until when a certificate is good, and its subject alternative names (an authority's none)."""

    until: datetime
    names: tuple[str, ...]


def read_certificates(folder: Path) -> dict[str, Says]:
    """Read every ``*.pem`` in ``folder``, by name. Raises ``InvalidInput``, ``InvalidData``."""
    paths = sorted(folder.glob("*.pem"))
    if not paths:
        raise InvalidInput("folder", f"{folder} holds no certificates")
    return {path.name: _says(path) for path in paths}


def _says(path: Path) -> Says:
    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
    except ValueError as error:
        raise InvalidData(f"{path} is no certificate") from error
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return Says(certificate.not_valid_after_utc, ())
    return Says(certificate.not_valid_after_utc, tuple(str(name.value) for name in names))
