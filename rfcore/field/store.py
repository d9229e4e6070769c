"""Reads and writes field files of every kind, and directories of them addressed by field id.

``decode_field`` turns an archive's bytes into a field that renders, ``encode_field`` does the
reverse; ``READERS`` lists the kinds of field.

A colour layer (``rfcore.field.layer``) and a delta (``rfcore.field.delta``) need their base field,
which ``open_base`` opens by its id, or which is found in the file's folder.

In a directory (``FieldStore``) a file named ``<field id>.rff`` is listed by its name, any other
``.rff`` file by its SHA-256, so that a file like ``street.rff`` can simply be put there. Contents
are checked when a field is added or loaded.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from rfcore.errors import FieldFormatError, InvalidInput, UnknownField, named
from rfcore.field.archive import Archive, decode_archive, encode_archive, read_file
from rfcore.field.delta import delta_field
from rfcore.field.folder import FIELD_ID, SUFFIX, FieldFolder
from rfcore.field.interface import (
    DELTA,
    LAYER,
    NGP,
    SPLATS,
    FieldMetadata,
    RadianceField,
    base_of,
    bounds_of_header,
    metadata_of_header,
)
from rfcore.field.layer import layered_field
from rfcore.field.ngp import NgpField, ngp_of_archive
from rfcore.field.splat_archive import splats_of_archive, splats_of_beginning
from rfcore.field.splats import SplatField
from rfcore.files import DECODED_BYTES, write_whole
from rfcore.geodesy import Anchor, anchor_values
from rfcore.raster.renderers import is_opencl

OpenBase = Callable[[str], RadianceField]
"""Opens the base of a layer or delta by its id; raises ``UnknownField``."""


@dataclass(frozen=True)
class FieldFile:
    """A checked archive, and the settings of the field to be made from it."""

    archive: Archive
    metadata: FieldMetadata
    field_id: str
    threads: int
    isa: str | None
    max_bytes: int
    open_base: OpenBase


def _layer(file: FieldFile) -> RadianceField:
    base = _base(file)
    return _named(file, layered_field(file.archive, base, file.metadata))


def _delta(file: FieldFile) -> RadianceField:
    base = _base(file)
    return _named(file, delta_field(file.archive, base, file.metadata, file.max_bytes))


def _base(file: FieldFile) -> SplatField:
    """Return the base field of a layer or a delta."""
    kind, base_id = file.archive.kind, base_of(file.archive)
    if base_id is None or FIELD_ID.fullmatch(base_id) is None:
        raise InvalidInput(f"{kind}.base", f"{base_id!r} is no field id")
    base = file.open_base(base_id)
    if not isinstance(base, SplatField):
        raise InvalidInput(f"{kind}.base", f"{base_id} is a field of {base.metadata.kind}")
    return base


def _named(file: FieldFile, field: SplatField) -> SplatField:
    field.field_id = file.field_id
    return field


def _splats(file: FieldFile) -> RadianceField:
    gaussians, levels = splats_of_archive(file.archive, file.max_bytes)
    field = SplatField(
        gaussians,
        file.metadata,
        levels=levels,
        threads=file.threads,
        isa=file.isa,
        archive=file.archive,
    )
    field.field_id = file.field_id
    stated = bounds_of_header(file.archive.metadata)
    if stated is not None and stated != field.bounds:
        raise InvalidInput("field.bounds", f"{stated} are not those of the means, {field.bounds}")
    return field


def _ngp(file: FieldFile) -> RadianceField:
    numbers = ngp_of_archive(file.archive, file.max_bytes)
    isa = None if is_opencl(file.isa) else file.isa  # hash grids have no kernels for devices
    field = NgpField(numbers, file.metadata, threads=file.threads, isa=isa)
    field.field_id = file.field_id
    stated = bounds_of_header(file.archive.metadata)
    if stated != field.bounds:
        raise InvalidInput("field.bounds", f"{stated} are not those of the grid, {field.bounds}")
    return field


READERS: Mapping[str, Callable[[FieldFile], RadianceField]] = {
    SPLATS: _splats,
    NGP: _ngp,
    LAYER: _layer,
    DELTA: _delta,
}
"""Functions that make the field of a file, by the archive's kind."""


def encode_field(field: RadianceField) -> bytes:
    """Return the bytes of the field's archive; equal fields give equal bytes."""
    return encode_archive(field.archive())


def _no_base(field_id: str) -> RadianceField:
    raise UnknownField(f"it needs its base, field {field_id}: put both in one folder")


def decode_field(
    data: bytes,
    source: str = "field",
    *,
    threads: int = 1,
    isa: str | None = None,
    max_bytes: int = DECODED_BYTES,
    open_base: OpenBase = _no_base,
) -> RadianceField:
    """Return the field of an archive.

    Raises ``FieldFormatError`` naming ``source`` if it is damaged or takes more than ``max_bytes``
    of memory, and for a layer what ``open_base`` raises.
    """
    archive = decode_archive(data, source)
    if archive.kind not in READERS:
        known = ", ".join(READERS)
        raise FieldFormatError(f"{source}: holds a field of kind '{archive.kind}', not {known}")
    try:
        kind = SPLATS if archive.kind in (LAYER, DELTA) else archive.kind
        metadata = metadata_of_header(kind, archive.metadata)
        field_id = hashlib.sha256(data).hexdigest()
        file = FieldFile(archive, metadata, field_id, threads, isa, max_bytes, open_base)
        return READERS[archive.kind](file)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise FieldFormatError(f"{source}: {error}") from error


def decode_beginning(
    data: bytes,
    field_id: str,
    *,
    threads: int = 1,
    isa: str | None = None,
    max_bytes: int = DECODED_BYTES,
) -> SplatField:
    """Return the part of the field ``field_id`` that the first bytes of its archive hold.

    ``splat_archive.detail_ends`` says how many bytes each level of detail needs. The digest of each
    array is checked; the field's id can only be checked once the archive is complete. Raises
    ``FieldFormatError`` if it is damaged, too large, or too short to draw anything.
    """
    archive = decode_archive(data, field_id, whole=False)
    try:
        metadata = metadata_of_header(SPLATS, archive.metadata)
        gaussians, levels, beginning = splats_of_beginning(archive, max_bytes)
        field = SplatField(
            gaussians, metadata, levels=levels, threads=threads, isa=isa, beginning=beginning
        )
        field.field_id = field_id
        field.bounds = bounds_of_header(archive.metadata) or field.bounds
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise FieldFormatError(f"field {field_id}: {error}") from error
    return field


def load_field(
    path: Path, *, threads: int = 1, isa: str | None = None, max_bytes: int = DECODED_BYTES
) -> RadianceField:
    """Read a field archive; raise ``FieldFormatError`` naming the file and what is wrong.

    >>> from rfcore.camera import Camera, Intrinsics, Pose
    >>> field = load_field(Path("samples/fields/street.rff"), threads=2)
    >>> field.primitives
    280000
    >>> camera = Camera(Intrinsics(64, 36, 50.0, 50.0, 32.0, 18.0), Pose.identity())
    >>> view = field.render(camera)
    >>> view.colour.shape, view.depth.shape
    ((36, 64, 3), (36, 64))
    """
    data = read_file(path, max_bytes)

    def beside(field_id: str) -> RadianceField:
        paths = FieldFolder(path.parent).look().paths
        if field_id not in paths:
            raise UnknownField(
                f"{path}: needs its base {field_id}, which is not in {path.parent}; put it there"
            )
        return load_checked(
            paths[field_id], field_id, threads=threads, isa=isa, max_bytes=max_bytes
        )

    return decode_field(
        data, str(path), threads=threads, isa=isa, max_bytes=max_bytes, open_base=beside
    )


def anchored_file(path: Path, anchor: Anchor, out: Path) -> str:
    """Write the field of ``path`` with another anchor to ``out``; return its id."""
    archive = decode_archive(read_file(path))
    stated = {**archive.metadata, "anchor": anchor_values(anchor)}
    out.parent.mkdir(parents=True, exist_ok=True)
    field = decode_field(encode_archive(replace(archive, metadata=stated)))
    return save_field(field, out)


def save_field(field: RadianceField, path: Path) -> str:
    """Write a field's archive, whole or not at all, and return the field's id.

    A field that was loaded is written as it was; ``SplatField.compressed`` makes the small form.

    >>> import numpy as np
    >>> from tempfile import TemporaryDirectory
    >>> from rfcore.raster.gaussians import Gaussians, gaussian_shapes
    >>> shapes = gaussian_shapes(count=100, sh_degree=1)
    >>> splats = Gaussians(**{name: np.ones(shape, np.float32) for name, shape in shapes.items()})
    >>> field = SplatField(splats, FieldMetadata("wall")).compressed()
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "wall.rff"
    ...     field_id = save_field(field, path)
    ...     load_field(path).field_id == field_id == field.field_id
    True
    """
    data = encode_field(field)
    write_whole(path, data)
    return hashlib.sha256(data).hexdigest()


class FieldStore:
    """The fields of one directory, which is created if missing. Processes may share it."""

    def __init__(self, directory: Path) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self._directory = directory
        self._folder = FieldFolder(directory)

    def ids(self) -> tuple[str, ...]:
        """Return the ids of the fields, sorted."""
        return tuple(sorted(self._files()))

    def path(self, field_id: str) -> Path:
        """Return the file of a field; raise ``UnknownField`` listing the fields that exist."""
        files = self._files()
        if field_id not in files:
            here = named(sorted(files), "nothing")
            raise UnknownField(f"field {field_id!r} is not in {self._directory}; it holds {here}")
        return files[field_id]

    def load(
        self,
        field_id: str,
        *,
        threads: int = 1,
        isa: str | None = None,
        max_bytes: int = DECODED_BYTES,
    ) -> RadianceField:
        """Load a field; raise ``UnknownField``, or ``FieldFormatError`` if it is damaged."""
        path = self.path(field_id)

        def base(of_id: str) -> RadianceField:
            return load_checked(
                self.path(of_id), of_id, threads=threads, isa=isa, max_bytes=max_bytes
            )

        return load_checked(
            path, field_id, threads=threads, isa=isa, max_bytes=max_bytes, open_base=base
        )

    def add(self, source: bytes | Path, field_id: str | None = None) -> str:
        """Add an archive and return its id; the file appears whole or not at all.

        If ``field_id`` is given, the SHA-256 is compared before anything is parsed. Raises
        ``FieldFormatError`` for a damaged archive, which is not added, and ``UnknownField`` for a
        layer whose base is not in the store.
        """
        data = read_file(source) if isinstance(source, Path) else source
        name = str(source) if isinstance(source, Path) else "field"
        found = _checked_id(data, field_id, name)
        decode_field(data, name, open_base=self.load)
        write_whole(self._directory / f"{found}{SUFFIX}", data)
        return found

    def _files(self) -> Mapping[str, Path]:
        return self._folder.look().paths


def load_checked(
    path: Path,
    field_id: str,
    *,
    threads: int = 1,
    isa: str | None = None,
    max_bytes: int = DECODED_BYTES,
    open_base: OpenBase = _no_base,
) -> RadianceField:
    """Load the field of a file whose SHA-256 is ``field_id``, compared before anything is parsed.

    Raises ``FieldFormatError``, and for a layer what ``open_base`` raises.
    """
    data = read_file(path, max_bytes)
    _checked_id(data, field_id, str(path))
    return decode_field(
        data, str(path), threads=threads, isa=isa, max_bytes=max_bytes, open_base=open_base
    )


def _checked_id(data: bytes, expected: str | None, source: str) -> str:
    found = hashlib.sha256(data).hexdigest()
    if expected not in (None, found):
        raise FieldFormatError(f"{source}: its sha256 is {found}, not the field id {expected}")
    return found
