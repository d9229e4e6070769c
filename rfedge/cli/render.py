"""``rfedge render``: render a field on an orbit around it or along a drive."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from rfedge.arguments import (
    DATASET,
    FIELD,
    RENDERER,
    SIZE,
    Up,
    check_folder,
    open_drive,
    open_field,
    parse_size,
)


@dataclass(frozen=True)
class Render:
    """Render a field along a path, as PNG files or one MP4."""

    field: Annotated[Path, Positional, FIELD]
    """The field: an archive (.rff), a name, or MODULE:CLASS (docs/how-to/python.md)."""
    out: Annotated[Path, arg(metavar="FOLDER|FILE.mp4")]
    """Folder for the PNG files, or a file ending in .mp4."""
    path: Literal["orbit", "drive"] | None = None
    """Orbit around the field, or the poses of a drive; default: drive if --drive is given."""
    drive: Annotated[Path | None, DATASET] = None
    """A dataset with the poses; its pictures are used only to print PSNR."""
    psnr: bool = False
    """Print the PSNR of each render against the drive's picture, and the mean, dB."""
    frames: int = 96
    """Number of pictures of an orbit."""
    size: Annotated[str, SIZE] = "960x540"
    """Size of an orbit's pictures, px; those of a drive have the size of its camera."""
    up: Up | None = None
    """Axis of the field that points up (orbit); default: as its training cameras show it."""
    centre: Annotated[tuple[float, float, float] | None, arg(metavar="X Y Z")] = None
    """Point to orbit around, in the field's axes, m; default: what its training cameras look at, or
    its middle."""
    radius: Annotated[float | None, arg(metavar="M")] = None
    """Distance of an orbit from that point, m; default: that of the training cameras, or 1.5 times
    the field's radius."""
    rate_hz: float = 24.0
    """Pictures per second of the MP4."""
    detail: float = 1.0
    """Share of the splats to render: 1, 0.5, 0.25 or 0.1."""
    sh_degree: int | None = None
    """Highest degree of spherical harmonics to render; default: all."""
    threads: int = 2
    """Threads of the renderer."""
    isa: str | None = None
    """Instruction set to force: avx512, avx2, neon or scalar; default: the best of this machine."""
    renderer: Annotated[str, RENDERER] = "cpu"
    """Render splats on the CPU or on an OpenCL device; the bytes are the same."""

    def run(self) -> None:
        """Render the path."""
        from rfcore.errors import InvalidInput
        from rfcore.field import Quality
        from rfcore.raster.renderers import renderer_isa
        from rfedge.fields.viewpoints import (
            OrbitSettings,
            compared,
            drive_viewpoints,
            orbit_viewpoints,
            pictures_along,
            write_pictures,
        )
        from rfedge.video import write_mp4

        film = self.out.suffix.lower() == ".mp4"
        if not film:
            check_folder(self.out, "a folder for PNG files, or a video ending in .mp4")
        quality = Quality(self.detail, self.sh_degree)
        field = open_field(
            self.field, threads=self.threads, isa=renderer_isa(self.renderer, self.isa)
        )
        if self.path == "orbit" or (self.path is None and self.drive is None):
            size_px = parse_size(self.size)
            settings = OrbitSettings(self.frames, *size_px, self.up, self.centre, self.radius)
            viewpoints = orbit_viewpoints(field, settings)
        elif (self.centre, self.radius) != (None, None):
            raise InvalidInput("centre", "and --radius are of an orbit, not of a drive")
        elif self.drive is None:
            raise InvalidInput("drive", "--path drive needs --drive, a dataset with the poses")
        else:
            drive = open_drive(self.drive, field, str(self.field))
            viewpoints = drive_viewpoints(drive.pictures)
        if self.psnr and viewpoints[0].seen is None:
            raise InvalidInput("psnr", "compares with a drive's pictures; give --drive DATASET")
        pictures = pictures_along(field, viewpoints, quality)
        psnr_db: list[float] = []
        if self.psnr:
            pictures = compared(pictures, psnr_db)
        if film:
            self.out.parent.mkdir(parents=True, exist_ok=True)
            count = write_mp4(self.out, (rgb for _, rgb in pictures), self.rate_hz)
            print(f"{self.out}: {count} pictures")
        else:
            write_pictures(self.out, pictures, psnr_db)
        if psnr_db:
            print(f"mean of {len(psnr_db)} pictures: {sum(psnr_db) / len(psnr_db):.2f} dB")
