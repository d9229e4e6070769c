"""A field seen along a path: the stops, and the pictures taken there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from rfcore.camera import Camera
from rfcore.field import Quality, RadianceField
from rfcore.image import Rgb, write_png
from rfcore.metrics import psnr
from rfcore.views import PosedPicture
from rfedge.fields.check import to_rgb
from rfedge.fields.viewpoints import OrbitSettings, orbit

__all__ = ["Stop", "drive_stops", "orbit_stops", "pictures_along", "write_pictures"]


@dataclass(frozen=True)
class Stop:
    """Where a picture is taken; ``seen`` is what a camera saw there, if one did."""

    name: str
    camera: Camera
    seen: PosedPicture | None = None


def orbit_stops(field: RadianceField, settings: OrbitSettings) -> list[Stop]:
    """Return the stops of one turn around the field."""
    cameras = orbit(field, settings)
    return [Stop(f"{number:05d}", camera) for number, camera in enumerate(cameras)]


def drive_stops(pictures: Iterable[PosedPicture]) -> list[Stop]:
    """Return the poses of a drive, named as its pictures."""
    return [Stop(Path(p.name).stem, p.camera, p) for p in pictures]


def pictures_along(
    field: RadianceField, stops: Iterable[Stop], quality: Quality
) -> Iterator[tuple[Stop, Rgb]]:
    """Yield what the field shows at each stop."""
    for stop in stops:
        yield stop, to_rgb(field.render_colour(stop.camera, quality))


def write_pictures(folder: Path, pictures: Iterable[tuple[Stop, Rgb]], with_psnr: bool) -> None:
    """Write PNG files and print their names, with the PSNR where a camera saw something."""
    folder.mkdir(parents=True, exist_ok=True)
    for stop, rgb in pictures:
        path = folder / f"{stop.name}.png"
        write_png(path, rgb)
        seen = stop.seen if with_psnr else None
        note = f"  {psnr(rgb, seen.read()):.2f} dB" if seen is not None else ""
        print(f"{path}{note}")
