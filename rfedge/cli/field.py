"""``rfedge field``: import, look into, check, reduce, export and publish fields."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg, subcommand

from rfedge.arguments import (
    DATASET,
    FIELD,
    IMPORTED,
    RFF,
    SIZE,
    SPLATS,
    Up,
    field_path,
    open_drive,
    open_field,
    open_splats,
    parse_size,
)
from rfedge.cli.field_tiles import FieldList, FieldPublish, FieldRollback
from rfedge.cli.field_update import FieldDisagree, FieldUpdate

if TYPE_CHECKING:
    from rfcore.camera import Camera
    from rfcore.field import FieldMetadata, RadianceField, SplatField
    from rfcore.field.stored_splats import ImportedSplats
    from rfcore.raster.gaussians import Gaussians
    from rfcore.train.levels import LevelFitConfig
    from rfcore.views import PosedPicture
    from rfedge.fields.check import Fit

EXPORTED = (".ply", ".spz", ".glb", ".usdc", ".usda")


@dataclass(frozen=True)
class FieldImport:
    """Read splats: a .ply of INRIA, gsplat, nerfstudio, OpenSplat, Brush, SuperSplat or
    LichtFeld, also a compressed one, a .spz, or glTF (.glb)."""

    splats: Annotated[Path, Positional, SPLATS]
    """The file, told by its content; properties of a .ply are found by name, text and binary
    alike. What is changed or left out is said. `rfedge doctor FILE` says so without importing."""
    name: Annotated[str, arg(metavar="NAME")]
    """Name of the field; every command that takes a field knows it by this name."""
    out: Annotated[Path | None, RFF] = None
    """The archive to write (default: out/fields/NAME.rff)."""
    replace: bool = False
    """Replace an archive that is there already."""
    transform: Path | None = None
    """nerfstudio's dataparser_transforms.json, to bring the field back to its world."""
    tile_origin: tuple[float, float, float] | None = None
    """East, north and up of the tile's origin, m, subtracted in float64; default: zero, or the
    median splat where that is farther than 10 km from it."""
    up: Up | None = None
    """Axis that points up; default: as the file says, else z."""
    antialiased: bool = False
    """The field was trained with antialiased rasterization (gsplat, Mip-Splatting), and the file's
    SplatRenderMode comment does not say so."""
    raw: bool = False
    """Keep every float32 as it is instead of compressing to about a tenth."""
    unconfined: bool = False
    """Read the file in this process instead of a sandbox; only for files of your own."""
    threads: int = 2
    """Threads of the renderer that predicts the time of a frame."""

    def run(self) -> None:
        """Import, print what it is, and how long a frame of it takes here."""
        from rich.console import Console

        from rfcore.errors import InvalidInput
        from rfcore.field import FieldMetadata, SplatField, save_field
        from rfedge.fields.describe import print_levels, size_mb, up_of_file
        from rfedge.fields.viewpoints import UPS, look_around

        out = self.out if self.out is not None else IMPORTED / f"{self.name}.rff"
        _check_out(out, ".rff")
        if out.exists() and not self.replace:
            raise InvalidInput("name", f"{out} is there already: take another name, or --replace")
        if out.exists() and self.splats.exists() and out.samefile(self.splats):
            raise InvalidInput("out", f"{out} is the file that is read: name another")
        read = self._splats()
        antialiased = self.antialiased or read.antialiased is True
        up = read.up if self.up is None else UPS[self.up]
        metadata = FieldMetadata(self.name, read.tile_origin, antialiased=antialiased, up=up)
        field = SplatField(read.splats, metadata, threads=self.threads)
        field = field if self.raw else field.compressed()
        out.parent.mkdir(parents=True, exist_ok=True)
        field_id = save_field(field, out)
        print(f"{out}: field {field_id}, {field.primitives:,} splats, {size_mb(field):.2f} MB")
        up_line = up_of_file(read.up) if self.up is None else f"up: {self.up}, as --up states"
        for note in (*read.notes, up_line, self._mode_line(read.antialiased)):
            print(note)
        if not self.raw:
            print("compressed, which moves every number a little: --raw keeps them")
        print_levels(Console(), field, look_around(field, 1280, 720))

    def _mode_line(self, stated: bool | None) -> str:
        """Say how the splats are drawn and why; ``stated`` is what the file says."""
        if self.antialiased:
            return "drawn antialiased, as --antialiased asks"
        if stated is None:
            tries = f"`rfedge field check {self.name} --drive DATASET` tries both"
            return f"not drawn antialiased: the file does not say whether to; {tries}"
        return f"{'drawn' if stated else 'not drawn'} antialiased, as the file says"

    def _splats(self) -> ImportedSplats:
        """Return the file's splats in the tile's frame, the most important first."""
        from rfcore.camera import TileOrigin
        from rfcore.errors import InvalidInput
        from rfcore.field.importance import most_important_first, reordered, visible_area
        from rfcore.field.similarity import moved, read_field_from_world
        from rfcore.field.stored_splats import chosen_origin
        from rfedge.fields.confined_reader import read_splats

        back = read_field_from_world(self.transform).inverse() if self.transform else None
        origin = TileOrigin(*self.tile_origin) if self.tile_origin is not None else None
        read = read_splats(self.splats, TileOrigin() if back else origin, self.unconfined)
        splats, notes = read.splats, [*read.notes]
        if not len(splats):
            raise InvalidInput("splats", f"{self.splats} holds no splats")
        if back is None:
            origin = read.tile_origin
        else:
            origin = origin or chosen_origin(back.apply(splats.means.astype(float)), notes)
            splats = moved(splats, back.localised(origin))
        splats = reordered(splats, most_important_first(visible_area(splats)))
        up = read.up if back is None else None
        return replace(read, splats=splats, tile_origin=origin, notes=tuple(notes), up=up)


@dataclass(frozen=True)
class FieldExport:
    """Write a field's splats for other programs, as .ply, .spz, .glb or OpenUSD."""

    field: Annotated[Path, Positional, FIELD]
    """The archive (.rff), or the field's name."""
    out: Annotated[Path, arg(metavar="FILE.ply|.spz|.glb|.usdc")]
    """The file to write; positions are relative to the tile's origin. As .ply in the property order
    of the reference implementation, with comments that say how the splats are to be drawn and
    which way is up; as .spz, lossy and a tenth of the size, for viewers in a browser; as .glb, glTF
    with KHR_gaussian_splatting; as .usdc or .usda, OpenUSD (extra usd)."""
    detail: float = 1.0
    """Share of the splats: 1, 0.5, 0.25 or 0.1."""
    spz_version: Literal[3, 4] = 4
    """Version of a .spz: 4 states its axes (extra spz), 3 is read by older viewers, which may
    show it turned."""

    def run(self) -> None:
        """Load and export."""
        from rfcore.camera import TileOrigin
        from rfcore.field import Quality
        from rfcore.field.quality import splats_at_detail

        _check_out(self.out, *EXPORTED)
        detail = Quality(self.detail).detail
        field = open_splats(self.field, threads=1)
        splats = splats_at_detail(field.gaussians, field.levels, detail)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        axes = self._write(splats, field.metadata)
        print(f"{self.out}: {len(splats):,} splats of SH degree {splats.sh_degree}")
        if axes:
            print(f"axes: {axes}")
        if field.metadata.antialiased and self.out.suffix in (".usdc", ".usda"):
            print("they are drawn antialiased, which OpenUSD cannot state")
        origin = field.metadata.tile_origin
        if origin != TileOrigin():
            place = f"{origin.east_m:.10g} {origin.north_m:.10g} {origin.up_m:.10g}"
            print(f"positions are relative to {place} m, the tile's origin")

    def _write(self, splats: Gaussians, metadata: FieldMetadata) -> str:
        """Write the file; return what is to be said of its axes."""
        from rfcore.field import write_ply
        from rfcore.field.gltf import write_glb
        from rfcore.field.spz import write_spz
        from rfcore.field.usd import write_usd
        from rfcore.vertical import direction

        antialiased, up = metadata.antialiased, metadata.vertical
        if self.out.suffix == ".ply":
            stated = up if metadata.states_up else None
            write_ply(self.out, splats, antialiased=antialiased, up=stated)
            return f"the field's own; up, {direction(up)}, is a comment" if stated else ""
        if self.out.suffix == ".spz":
            write_spz(self.out, splats, antialiased=antialiased, version=self.spz_version, up=up)
            can = "as it states" if self.spz_version == 4 else "which version 3 cannot state"
            return f"RDF, those of a .ply, and up, {direction(up)}, {can}"
        if self.out.suffix == ".glb":
            write_glb(self.out, splats, antialiased=antialiased, up=up)
            return f"the field's vertical, {direction(up)}, is +Y, as glTF says"
        write_usd(self.out, splats, up=up)
        return f"the field's vertical, {direction(up)}, is z, as the file states"


@dataclass(frozen=True)
class FieldInfo:
    """Print what is known about a field, and the time of a frame at each level of detail here."""

    field: Annotated[Path, Positional, FIELD]
    """The archive (.rff), or the field's name."""
    size: Annotated[str, SIZE] = "1280x720"
    """Size of the frames measured, px (without --drive)."""
    drive: Annotated[Path | None, DATASET] = None
    """Posed pictures to measure every level of detail against, in dB and in ms."""
    threads: int = 2
    """Threads of the renderer."""

    def run(self) -> None:
        """Load, describe, measure."""
        from rich.console import Console

        from rfcore.field import SplatField
        from rfedge.fields.describe import describe_field, frame_ms, print_levels
        from rfedge.fields.viewpoints import look_around

        console = Console()
        field = open_field(self.field, threads=self.threads)
        for name, value in describe_field(field):
            console.print(f"{name:>13}  {value}", highlight=False)
        pictures: tuple[PosedPicture, ...] = ()
        cameras = look_around(field, *parse_size(self.size))
        if self.drive is not None:
            pictures = open_drive(self.drive, field).pictures
            cameras = [picture.camera for picture in pictures]
        if isinstance(field, SplatField):
            print_levels(console, field, cameras, pictures)
        else:
            console.print(f"{'frame':>13}  {frame_ms(field, cameras, rounds=1):.1f} ms")


@dataclass(frozen=True)
class FieldCheck:
    """Show four camera pictures beside the field's renders; say which frame and mode fit."""

    field: Annotated[Path, Positional, FIELD]
    """The archive (.rff), or the field's name."""
    drive: Annotated[Path, DATASET]
    """The drive: any dataset of posed pictures."""
    transform: Path | None = None
    """nerfstudio's dataparser_transforms.json, if the field was trained there."""
    out: Annotated[Path, arg(metavar="FILE.png")] = Path("out/field-check.png")
    """The four pairs, as PNG."""
    fix: Annotated[Path | None, RFF] = None
    """File to write with the field in the frame and mode that fit."""
    threads: int = 2
    """Threads of the renderer."""

    def run(self) -> None:
        """Check; a field that does not fit is an error."""
        from rfcore.errors import InvalidData
        from rfcore.field import SplatField, save_field
        from rfcore.field.place import coarseness
        from rfcore.field.similarity import read_field_from_world
        from rfedge.fields.check import check_field, drawn_antialiased, in_drive_world

        field = open_field(self.field, threads=self.threads)
        nerfstudio = read_field_from_world(self.transform) if self.transform else None
        pictures = open_drive(self.drive, field).pictures
        fit = check_field(field, pictures, nerfstudio)
        if isinstance(field, SplatField) and fit.mode is not None:
            field = drawn_antialiased(field, fit.mode.antialiased)
        self._write_pairs(field, pictures, fit)
        if not fit.fits:
            raise InvalidData(
                f"none of {fit.tried} conventions fits: {fit.as_given_db:.2f} dB as it is, at best "
                f"{fit.psnr_db:.2f} dB. Is it the same place? A field trained in nerfstudio needs "
                "--transform dataparser_transforms.json"
            )
        _print_fit(fit)
        coarse = coarseness(field, [picture.camera.intrinsics for picture in pictures])
        if coarse is not None:
            print(coarse)
        if self.fix is not None:
            fixed = in_drive_world(field, fit.convention)
            print(f"{self.fix}: field {save_field(fixed, self.fix)}")

    def _write_pairs(
        self, field: RadianceField, pictures: tuple[PosedPicture, ...], fit: Fit
    ) -> None:
        from rfcore.image import write_png
        from rfedge.fields.check import pairs_picture

        pairs, values_db = pairs_picture(field, pictures, fit.convention)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        write_png(self.out, pairs)
        shown = ", ".join(f"{value:.2f}" for value in values_db)
        print(f"{self.out}: camera | render, {shown} dB under: {fit.convention.name}")


def _print_fit(fit: Fit) -> None:
    """Say which convention fits, and which mode of drawing splats."""
    instead = f" instead of {fit.as_given_db:.2f} dB" if fit.psnr_db != fit.as_given_db else ""
    print(f"fits {fit.convention.name}: {fit.psnr_db:.2f} dB{instead}")
    mode = fit.mode
    if mode is None:
        return
    print(
        f"antialiased {mode.antialiased_db:.2f} dB, not antialiased {mode.default_db:.2f} dB: ",
        end="",
    )
    if mode.antialiased == mode.stated_antialiased:
        print("the field's mode fits")
    else:
        wanted = "antialiased" if mode.antialiased else "not antialiased"
        print(f"it was trained to be drawn {wanted}; --fix FILE.rff writes it so")


@dataclass(frozen=True)
class FieldSlim:
    """Keep the splats that matter most, and fit them and lower levels of detail to the cameras.

    With --drive alone every splat is kept: they are ordered by what its cameras see of them, and
    the levels of 50, 25 and 10 % are fitted to the whole.
    """

    field: Annotated[Path, Positional, FIELD]
    """The archive (.rff), or the field's name."""
    out: Annotated[Path, RFF]
    """The archive to write."""
    keep: int | None = None
    """Number of splats to keep; default: all. --max-mb and --passes choose it instead, with the
    precision of every value, and fit lower levels of detail (with --drive)."""
    max_mb: float | None = None
    """Largest size of the archive, MB (10^6 bytes)."""
    passes: int | None = None
    """Write the size with the fewest bytes of field and stream over this number of passes of
    --drive, whose pictures are coded against every size; --max-mb limits the choice."""
    drive: Annotated[Path | None, DATASET] = None
    """Posed pictures whose cameras the field is to serve; their pixels are read for --passes only.
    Without this, opacity and area decide what matters."""
    iterations: int = 240
    """Iterations of fitting the survivors, and lower levels, to the full field's renders (with
    --drive)."""
    raw: bool = False
    """Write float32 instead of the compressed form."""
    threads: int = 2
    """Threads of the renderer."""

    def run(self) -> None:
        """Slim and write."""
        from rich.console import Console

        from rfcore.errors import InvalidInput
        from rfcore.field import save_field
        from rfcore.train.levels import LevelFitConfig
        from rfedge.fields.describe import size_mb
        from rfedge.fields.slim import slimmed
        from rfedge.training.finish import fit_levels

        _check_out(self.out, ".rff")
        has_goal = self.max_mb is not None or self.passes is not None
        if self.keep is not None and has_goal:
            raise InvalidInput("keep", "give either --keep, or --max-mb, --passes or both")
        if self.keep is None and not has_goal and self.drive is None:
            raise InvalidInput("keep", "give --keep, --max-mb or --passes; or --drive, to keep all")
        field = open_splats(self.field, threads=self.threads)
        config = LevelFitConfig(iterations=self.iterations, threads=self.threads)
        cameras = _cameras_of(self.drive, field) if self.drive is not None else []
        if has_goal:
            written = self._sized(field, config)
        elif self.keep is not None:
            written = slimmed(field, self.keep, cameras, config)
        else:
            written = fit_levels(field, cameras, config, Console())
        written = written if self.raw else written.compressed()
        self.out.parent.mkdir(parents=True, exist_ok=True)
        field_id = save_field(written, self.out)
        print(
            f"{self.out}: field {field_id}, {written.primitives:,} of {field.primitives:,} splats, "
            f"{size_mb(written):.2f} MB"
        )

    def _sized(self, field: SplatField, config: LevelFitConfig) -> SplatField:
        from rich.console import Console

        from rfcore.errors import InvalidInput
        from rfedge.training.finish import FieldSizer, size_goal

        if self.drive is None or self.raw:
            raise InvalidInput("max_mb", "and --passes go with --drive, and not with --raw")
        drive = open_drive(self.drive, field).pictures
        sizer = FieldSizer(drive, drive, config, Console())
        return sizer.sized(field, size_goal(self.max_mb, self.passes))


def _cameras_of(drive: Path, field: SplatField) -> list[Camera]:
    return [picture.camera for picture in open_drive(drive, field).pictures]


def _check_out(out: Path, *suffixes: str) -> None:
    """Raise ``InvalidInput`` unless ``out`` is named as the format it will hold."""
    from rfcore.errors import InvalidInput

    if out.suffix not in suffixes:
        raise InvalidInput("out", f"{out} must end in {' or '.join(suffixes)}")


@dataclass(frozen=True)
class FieldAnchor:
    """State where on the Earth a field is, for poses from satellite navigation; `info` shows it."""

    field: Annotated[Path, Positional, FIELD]
    """The archive (.rff), or the field's name."""
    at: Annotated[tuple[float, float, float], arg(metavar="LATITUDE LONGITUDE HEIGHT")]
    """WGS 84, degrees, and metres above the ellipsoid."""
    out: Annotated[Path, RFF]
    """The archive to write. Another anchor makes another field id."""
    point_m: Annotated[tuple[float, float, float], arg(metavar="X Y Z")] = (0.0, 0.0, 0.0)
    """The point of the field that is there, m; default: its origin."""
    enu_from_world: Annotated[tuple[float, float, float, float], arg(metavar="W X Y Z")] = (
        1.0,
        0.0,
        0.0,
        0.0,
    )
    """Rotation of the field's axes to east, north, up; default: they are these."""

    def run(self) -> None:
        """Write the field with the anchor."""
        from rfcore.field.store import anchored_file
        from rfcore.geodesy import Anchor
        from rfedge.fields.describe import anchor_text

        _check_out(self.out, ".rff")
        anchor = Anchor(*self.at, self.enu_from_world, self.point_m)
        field_id = anchored_file(field_path(self.field), anchor, self.out)
        print(f"{self.out}: field {field_id}, {anchor_text(anchor)}")


@dataclass(frozen=True)
class Field:
    """Import, inspect, check, slim, refine, export and publish radiance fields."""

    verb: Annotated[
        Annotated[FieldImport, subcommand("import")]
        | Annotated[FieldAnchor, subcommand("anchor")]
        | Annotated[FieldInfo, subcommand("info")]
        | Annotated[FieldCheck, subcommand("check")]
        | Annotated[FieldSlim, subcommand("slim")]
        | Annotated[FieldUpdate, subcommand("update")]
        | Annotated[FieldDisagree, subcommand("disagree")]
        | Annotated[FieldExport, subcommand("export")]
        | Annotated[FieldPublish, subcommand("publish")]
        | Annotated[FieldList, subcommand("list")]
        | Annotated[FieldRollback, subcommand("rollback")],
        arg(name=""),
    ]

    def run(self) -> None:
        """Run the sub-verb."""
        self.verb.run()
