"""Radiance fields as data: what they are made of, and the files that hold them."""

from rfcore.field.interface import (
    Bounds,
    FieldMetadata,
    RadianceField,
    Renderer,
    codec_renderer,
    render_field_view,
)
from rfcore.field.ngp import NgpField
from rfcore.field.quality import FULL, Quality
from rfcore.field.splat_file import read_splat_file
from rfcore.field.splat_ply import write_ply
from rfcore.field.splats import SplatField
from rfcore.field.store import FieldStore, load_field, save_field

__all__ = [
    "FULL",
    "Bounds",
    "FieldMetadata",
    "FieldStore",
    "NgpField",
    "Quality",
    "RadianceField",
    "Renderer",
    "SplatField",
    "codec_renderer",
    "load_field",
    "read_splat_file",
    "render_field_view",
    "save_field",
    "write_ply",
]
