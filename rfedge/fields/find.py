"""A field's file, by path or by name: the one resolver of every command that takes a field.

A name is what the field was imported under (``out/fields/NAME.rff``) or a sample's
(``samples/fields/NAME.rff``), in this order. A file of that path comes before both.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, SplatField, load_field

__all__ = ["IMPORTED", "SAMPLES", "field_path", "open_field", "open_splats"]

IMPORTED = Path("out/fields")
"""Where ``rfedge field import`` puts what it reads."""
SAMPLES = Path("samples/fields")
SUFFIX = ".rff"


def field_path(name: Path | str) -> Path:
    """Return the file of a field; raise ``InvalidInput`` listing what was tried and what exists."""
    tried = list(_candidates(Path(name)))
    found = next((path for path in tried if path.is_file()), None)
    if found is not None:
        return found
    names = sorted({path.stem for folder in (IMPORTED, SAMPLES) for path in folder.glob("*.rff")})
    raise InvalidInput(
        "field",
        f"'{name}' is no field: there is no file {', '.join(map(str, tried))}; "
        f"names known here: {', '.join(names) or 'none (rfedge field import makes one)'}",
    )


def open_field(name: Path | str, *, threads: int = 1, isa: str | None = None) -> RadianceField:
    """Load a field by path or name.

    Raises ``InvalidInput`` as ``field_path`` does and ``FieldFormatError`` for a damaged file.
    """
    return load_field(field_path(name), threads=threads, isa=isa)


def open_splats(name: Path | str, *, threads: int) -> SplatField:
    """Load a field that must be made of splats; raise ``InvalidInput`` for another kind."""
    field = open_field(name, threads=threads)
    if not isinstance(field, SplatField):
        raise InvalidInput("field", f"{name} is of kind '{field.metadata.kind}', not splats")
    return field


def _candidates(name: Path) -> Iterator[Path]:
    yield name
    if len(name.parts) == 1:
        file = name if name.suffix == SUFFIX else Path(f"{name}{SUFFIX}")
        yield from (folder / file for folder in (IMPORTED, SAMPLES))
