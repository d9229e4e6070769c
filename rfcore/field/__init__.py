"""Radiance fields as data: what they are made of, and the files that hold them."""

from rfcore.field.ply import read_ply, write_ply
from rfcore.field.splats import FieldMetadata, SplatField, load_field, save_field
from rfcore.field.store import FieldStore

__all__ = [
    "FieldMetadata",
    "FieldStore",
    "SplatField",
    "load_field",
    "read_ply",
    "save_field",
    "write_ply",
]
