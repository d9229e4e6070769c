"""Arguments that several commands share: placeholders, fields by path or name, sizes, durations.

A placeholder replaces the name of a type (PATH, STR) in a verb's help::

    field: Annotated[Path, Positional, FIELD]

Every command that takes a field resolves it by ``field_path``: as a path, or as the name of an
imported field (``out/fields/NAME.rff``) or of a sample's field (``samples/fields/NAME.rff``), in
this order.

Every ``--help`` imports this module, which therefore imports nothing heavy.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from rfcore.errors import InvalidInput
from rfcore.files import DECODED_BYTES
from rfcore.named_class import is_named_class
from rfedge.samples import sample_path

if TYPE_CHECKING:
    from rfcore.dataset import Dataset
    from rfcore.field import RadianceField, SplatField
    from rfcore.wire.nats import NatsServers
    from rfcore.wire.tls import TlsFiles

FIELD = arg(metavar="FIELD")
"""The path of an archive, or the name of a field, or MODULE:CLASS (``rfcore.field.own``)."""
DATASET = arg(metavar="DATASET")
"""A dataset's folder, or the file that describes it (docs/how-to/data.md)."""
ADDRESS = arg(metavar="HOST:PORT")
SIZE = arg(metavar="WIDTHxHEIGHT")
FOLDER = arg(metavar="FOLDER")
RENDERER = arg(metavar="cpu|opencl[:DEVICE]")
RFF = arg(metavar="FILE.rff")
PLY = arg(metavar="FILE.ply")
SPLATS = arg(metavar="FILE.ply|.spz|.glb")
JSON = arg(metavar="FILE.json")
Up = Literal["z", "y", "-y"]
"""An axis that points up (``rfedge.fields.viewpoints.UPS``)."""

ASSUMED_HZ = 10.0
"""Rate of a drive whose pictures have no times, where none is stated."""
RATE = arg(metavar="HZ")
IMPORTED = Path("out/fields")
"""Folder of the fields that ``rfedge field import`` writes."""
SAMPLES = sample_path("fields")
SUFFIX = ".rff"
PICTURES = (".gif", ".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")


def field_path(name: Path | str) -> Path:
    """Return the file of a field; raise ``InvalidInput`` with the tried and the known names."""
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


def field_source(name: Path | str) -> Path:
    """Return the file of a field, or ``MODULE:CLASS`` as it was given; raises as ``field_path``."""
    return Path(name) if is_named_class(str(name)) else field_path(name)


def is_field_file(path: Path) -> bool:
    """Return whether a file begins as a field's archive."""
    from rfcore.field.archive import MAGIC

    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def open_field(name: Path | str, *, threads: int = 1, isa: str | None = None) -> RadianceField:
    """Load a field by path or name, or make the one that a user's class renders.

    Raises ``InvalidInput`` as ``field_path`` and ``own_field`` do and ``FieldFormatError`` for a
    damaged file.
    """
    from rfcore.field import load_field
    from rfcore.field.own import own_field

    if is_named_class(str(name)):
        return own_field(str(name))

    return load_field(field_path(name), threads=threads, isa=isa, max_bytes=max_field_bytes())


def open_drive(
    path: Path, field: RadianceField | None = None, field_name: str | None = None
) -> Dataset:
    """Read a dataset around a field's origin; say on stderr what was done to its pictures.

    Lenses are undistorted as ``rfedge train --undistort`` does, so a field trained so can be seen
    from its own pictures. With ``field_name``, what the user called the field, a warning says where
    it does not show what the pictures do; raises ``InvalidInput`` where it is far from them all.
    """
    from rfcore.dataset import Distortion, read_dataset
    from rfcore.field.place import check_place, coarseness

    origin = field.metadata.tile_origin if field is not None else None
    dataset = read_dataset(path, tile_origin=origin, distortion=Distortion.UNDISTORT)
    for change in dataset.changes:
        print(f"{path}: {change}", file=sys.stderr)
    if field is not None and field_name is not None:
        cameras = [picture.camera.intrinsics for picture in dataset.pictures]
        warnings = [
            check_place(field, dataset.pictures, (field_name, str(path))),
            coarseness(field, cameras),
        ]
        for warning in filter(None, warnings):
            print(f"warning: {warning}", file=sys.stderr)
    return dataset


def drive_rate_hz(stated_hz: float | None, times_hz: float | None, drive: Path) -> float:
    """Return the rate of a drive: the stated one, else that of its times; say if it is assumed.

    Raises ``InvalidInput`` for a rate outside 0.01..1000 Hz.
    """
    if stated_hz is not None and not 0.01 <= stated_hz <= 1000:
        raise InvalidInput("rate", f"{stated_hz:g} Hz is outside 0.01..1000 Hz")
    rate_hz = times_hz if stated_hz is None else stated_hz
    if rate_hz is None:
        print(f"{drive}: no times; {ASSUMED_HZ:g} Hz is assumed (--rate HZ)", file=sys.stderr)
    return rate_hz or ASSUMED_HZ


def max_field_bytes() -> int:
    """Return the memory that a field's splats may take, from RFEDGE_MAX_FIELD_GB.

    Raises ``InvalidInput`` if that is not a number from 0.001 to 1000.
    """
    stated = os.environ.get("RFEDGE_MAX_FIELD_GB")
    if stated is None:
        return DECODED_BYTES
    try:
        max_gb = float(stated)
    except ValueError:
        max_gb = 0.0
    if not 0.001 <= max_gb <= 1000:
        raise InvalidInput("RFEDGE_MAX_FIELD_GB", f"{stated[:20]!r} is not a number 0.001..1000")
    return round(max_gb * 1e9)


def open_splats(name: Path | str, *, threads: int) -> SplatField:
    """Load a field of splats; raise ``InvalidInput`` for another kind."""
    from rfcore.field import SplatField

    field = open_field(name, threads=threads)
    if not isinstance(field, SplatField):
        raise InvalidInput("field", f"{name} is of kind '{field.metadata.kind}', not splats")
    return field


def _candidates(name: Path) -> Iterator[Path]:
    yield name
    if len(name.parts) == 1:
        file = name if name.suffix == SUFFIX else Path(f"{name}{SUFFIX}")
        yield from (folder / file for folder in (IMPORTED, SAMPLES))


def check_folder(path: Path, wanted: str) -> None:
    """Raise ``InvalidInput`` for an output folder that is named like a picture or a video.

    ``wanted`` says what to name instead.
    """
    if path.suffix.lower() in (*PICTURES, *VIDEOS):
        raise InvalidInput("out", f"{path}: no {path.suffix} file is written; name {wanted}")


def parse_size(text: str) -> tuple[int, int]:
    """Return (width, height) in pixels; raise ``InvalidInput`` for anything but ``640x360``."""
    from rfcore.camera import MAX_SIDE_PX

    match = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text, re.ASCII)
    if match is None:
        raise InvalidInput("size", f"'{text}' is not WIDTHxHEIGHT, such as 640x360")
    width_px, height_px = int(match[1]), int(match[2])
    if max(width_px, height_px) > MAX_SIDE_PX:
        raise InvalidInput("size", f"{text} is over the limit of {MAX_SIDE_PX} px")
    return width_px, height_px


def time_text(seconds: float) -> str:
    """Return a duration in the unit that fits it."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


PEM = arg(metavar="FILE.pem")


@dataclass(frozen=True)
class TwinConnection:
    """Connection of a consumer of the twin: to one server, or to the NATS of all servers."""

    nats: Annotated[str | None, arg(metavar="URL[,URL]")] = None
    """Show what all servers publish over this NATS (docs/how-to/servers.md), instead of one
    server."""
    nats_login: Annotated[Path | None, arg(metavar="FILE")] = None
    """With --nats: file of one line, USER:PASSWORD or a token."""
    tls_cert: Annotated[Path | None, PEM] = None
    """Certificate of this consumer (PEM), for a server or a NATS that wants one."""
    tls_key: Annotated[Path | None, PEM] = None
    """Its private key."""
    tls_ca: Annotated[Path | None, PEM] = None
    """Certificate of the authority that vouches for the other end."""
    allow_insecure: bool = False
    """Watch a server on another machine in plaintext."""

    def nats_servers(self, urls: str) -> NatsServers:
        """Return the NATS servers of the options; raise ``InvalidInput``."""
        from rfcore.wire.nats import NatsServers

        parsed, tls = NatsServers.parse_urls(urls), (self.tls_ca, self.tls_cert, self.tls_key)
        return NatsServers(parsed, self.nats_login, *tls, self.allow_insecure)

    def tls(self) -> TlsFiles | None:
        """Return the files of a connection with TLS, or None; raise ``InvalidInput``."""
        from rfcore.wire.tls import TlsFiles

        return TlsFiles.of(self.tls_cert, self.tls_key, self.tls_ca)
