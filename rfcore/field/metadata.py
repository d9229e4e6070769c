"""A field's metadata in the JSON header of its archive, readable without its arrays.

``bounds`` stands beside the values of ``FieldMetadata``; ``kind`` is the archive's own. Archives
written before 0.2 lack ``held_out_ssim``, ``antialiased`` and ``bounds``: not measured, not
antialiased, and not stated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from rfcore.camera import TileOrigin
from rfcore.errors import InvalidInput
from rfcore.field.interface import Bounds, FieldMetadata

__all__ = ["bounds_of_header", "metadata_of_header", "stored_metadata"]


def stored_metadata(metadata: FieldMetadata, bounds: Bounds) -> dict[str, Any]:
    """Return what the header says of a field."""
    values = asdict(metadata)
    del values["kind"]
    return {**values, "bounds": {"low_m": list(bounds.low_m), "high_m": list(bounds.high_m)}}


def metadata_of_header(kind: str, stored: Mapping[str, Any]) -> FieldMetadata:
    """Return the metadata of a header.

    Raises ``InvalidInput`` for a value of the wrong type or out of range, and ``KeyError``,
    ``TypeError`` or ``AttributeError`` where the header is of another shape.
    """
    for key in ("name", "training_digest"):
        if not isinstance(stored[key], str):
            raise InvalidInput(f"field.{key}", f"{stored[key]!r} is not text")
    antialiased = stored.get("antialiased", False)
    if not isinstance(antialiased, bool):
        raise InvalidInput("field.antialiased", f"{antialiased!r} is neither true nor false")
    return FieldMetadata(
        name=stored["name"],
        tile_origin=TileOrigin(**{axis: float(v) for axis, v in stored["tile_origin"].items()}),
        training_digest=stored["training_digest"],
        held_out_psnr_db=_measured(stored, "held_out_psnr_db"),
        held_out_ssim=_measured(stored, "held_out_ssim"),
        antialiased=antialiased,
        kind=kind,
    )


def bounds_of_header(stored: Mapping[str, Any]) -> Bounds | None:
    """Return the bounds a header states, ``None`` if it states none; raises as above."""
    if "bounds" not in stored:
        return None
    return Bounds(_corner(stored["bounds"]["low_m"]), _corner(stored["bounds"]["high_m"]))


def _corner(values: Any) -> tuple[float, float, float]:
    east_m, north_m, up_m = (float(value) for value in values)
    return east_m, north_m, up_m


def _measured(stored: Mapping[str, Any], key: str) -> float | None:
    value = stored.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InvalidInput(f"field.{key}", f"{value!r} is not a number")
    return float(value)
