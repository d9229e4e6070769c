"""A field's file, by path or by the name it was imported under."""

from __future__ import annotations

from pathlib import Path

from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, SplatField, load_field

__all__ = ["FOLDER", "open_field", "open_splats"]

FOLDER = Path("out/fields")
"""Where ``rfedge field import`` puts what it reads."""


def open_field(name: Path, *, threads: int, isa: str | None = None) -> RadianceField:
    """Load ``name``, or ``out/fields/NAME.rff``; raise ``FieldFormatError`` or ``InvalidInput``."""
    named = FOLDER / f"{name}.rff"
    known = not name.exists() and len(name.parts) == 1 and named.exists()
    return load_field(named if known else name, threads=threads, isa=isa)


def open_splats(name: Path, *, threads: int) -> SplatField:
    """Load a field that must be made of splats; raise ``InvalidInput`` for another kind."""
    field = open_field(name, threads=threads)
    if not isinstance(field, SplatField):
        raise InvalidInput("field", f"{name} is of kind '{field.metadata.kind}', not splats")
    return field
