"""Certificates of one deployment: an authority and those it vouches for."""

from __future__ import annotations

from rfcore.errors import BackendUnavailable

__all__ = ["require_cryptography"]


def require_cryptography() -> None:
    """Raise ``BackendUnavailable`` with what to install; only this package needs it."""
    try:
        import cryptography  # noqa: F401
    except ImportError as error:
        raise BackendUnavailable("cryptography is missing: pip install 'rfedge[ops]'") from error
