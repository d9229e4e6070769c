"""Packages that only an extra of rfedge installs, and the one message for when they are missing.

A module imports them where others import numpy, guarded::

    with needs("eval"):
        from scipy.interpolate import PchipInterpolator

The extras are the tables of ``[project.optional-dependencies]`` in pyproject.toml.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from rfcore.errors import BackendUnavailable


@contextmanager
def needs(extra: str) -> Iterator[None]:
    """Around imports: raise ``BackendUnavailable``, saying what to install, if one fails."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise BackendUnavailable(_message(str(error.name), "is missing", extra)) from error
    except ImportError as error:
        problem = f"cannot be loaded ({error})"
        raise BackendUnavailable(_message(str(error.name), problem, extra)) from error


def require(extra: str, *packages: str) -> None:
    """Raise ``BackendUnavailable`` unless all ``packages`` of an extra are there.

    Nothing is imported: for what takes long to load, or must be configured before it is.
    """
    for package in packages:
        if find_spec(package) is None:
            raise BackendUnavailable(_message(package, "is missing", extra))


def _message(name: str, problem: str, extra: str) -> str:
    return f"{name.partition('.')[0]} {problem}: pip install 'rfedge[{extra}]'"
