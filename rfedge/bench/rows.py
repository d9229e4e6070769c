"""What a benchmark row is: a flat or once nested mapping, ready for JSON or a table."""

from __future__ import annotations

from typing import Any, Literal

__all__ = ["Row", "Rows", "flattened"]

Row = dict[str, Any]

Rows = Literal["all", "native", "modes"]
"""Which rows to run: ``native`` leaves out what only the slow reference fills in, ``modes`` are
the specialisations of the renderer instead."""


def flattened(row: Row) -> Row:
    """Return a row whose nested values stand beside the others, as ``outer.inner``."""
    flat: Row = {}
    for name, value in row.items():
        if isinstance(value, dict):
            flat.update({f"{name}.{inner}": ms for inner, ms in value.items()})
        else:
            flat[name] = value
    return flat
