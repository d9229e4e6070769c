"""Code a drive with one field of the street and with the tiles it was cut into; one result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from lab.robust.run import kbit_between
from rfcore.camera import Camera
from rfcore.codec.h264.config import check_effort
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, load_field
from rfcore.wire.tiles import Area
from rfedge.datasets.split import SplitTile, read_tiles
from rfedge.evaluate.cells import CellStore, clip_key, program_version
from rfedge.evaluate.clips import Clip, CodedClip, Drive, luma_mse, psnr_of_mse, read_drive
from rfedge.evaluate.field_coder import FieldCoder, RenderedClip, render_clip
from rfedge.report.tables import heading, print_table, table
from rfedge.results import Result, check_result_path, make_result, provenance, rows_of, write_result

__all__ = ["Placed", "SeamRow", "SeamsJob", "placed", "print_seams", "run_seams", "seams_section"]


@dataclass(frozen=True)
class SeamRow:
    """Frames of one kind: bits at one quality and the renders' own, with one field and in tiles."""

    scene: str
    hz: float
    frames_are: str
    """``near a seam``, ``elsewhere`` or ``all``."""
    frames: int
    new_streams: int
    """Of them, how many are the first of a tile."""
    whole_kbit: float
    tiles_kbit: float
    more_percent: float
    whole_render_db: float
    tiles_render_db: float


COLUMNS = (
    "scene",
    "Hz",
    "frames",
    "of them first of a tile",
    "kbit a frame, one field",
    "tiles",
    "more %",
    "render dB, one field",
    "tiles",
)


def seams_section(path: Path, result: Result) -> str:
    """Return the table."""
    rows = [_cells(row) for row in rows_of(SeamRow, result["rows"])]
    street = result["street"]
    note = (
        f"A drive across {street['tiles']} tiles; near a seam: within {street['within_m']:g} m of "
        f"another tile's ground. Bits at {street['quality_db']:g} dB. One field has "
        f"{street['whole_bytes'] / 1e6:.1f} MB, the tiles {street['tiles_bytes'] / 1e6:.1f} MB "
        "together."
    )
    return "\n\n".join([heading(path, result), note, table(COLUMNS, rows), ""])


def print_seams(console: Console, rows: Sequence[SeamRow]) -> None:
    """Print the rows."""
    print_table(console, "One field and tiles", COLUMNS, [_cells(row) for row in rows])


def _cells(row: SeamRow) -> list[str]:
    return [
        row.scene,
        f"{row.hz:g}",
        f"{row.frames} {row.frames_are}",
        str(row.new_streams),
        f"{row.whole_kbit:.2f}",
        f"{row.tiles_kbit:.2f}",
        f"{row.more_percent:+.1f}",
        f"{row.whole_render_db:.2f}",
        f"{row.tiles_render_db:.2f}",
    ]


CRFS = (23.0, 27.0, 31.0, 35.0, 39.0)


@dataclass(frozen=True)
class SeamsJob:
    """What to code; see ``rfedge-lab seams --help``."""

    whole: Path
    tiles: Path
    fields: Path
    drive: str
    within_m: float
    quality_db: float
    effort: str
    out: Path
    cells: Path

    def __post_init__(self) -> None:
        check_result_path(self.out)
        check_effort("effort", self.effort)
        if not 0 < self.within_m <= 1000:
            raise InvalidInput("within-m", f"{self.within_m:g} m is outside 0..1000")
        if not 20 <= self.quality_db <= 50:
            raise InvalidInput("quality-db", f"{self.quality_db:g} dB is outside 20..50")


@dataclass(frozen=True)
class Placed:
    """The tile that a frame is coded with, and how far its camera is from another tile's ground."""

    tile: str
    seam_m: float


def placed(tiles: Sequence[SplitTile], ground_m: Sequence[tuple[float, float]]) -> list[Placed]:
    """Return the place of each frame of a drive: on the nearest tile, on a border the one before.

    Raises ``InvalidInput`` for a single tile.
    """
    areas = {tile.name: Area(tile.area_m[:2], tile.area_m[2:]) for tile in tiles}
    if len(areas) < 2:
        raise InvalidInput("tiles", f"{len(areas)} of them have no seam")
    places: list[Placed] = []
    for east_m, north_m in ground_m:
        distances = {name: area.distance_m(east_m, north_m) for name, area in areas.items()}
        before = places[-1].tile if places else ""
        own = min(distances, key=lambda name: (distances[name], name != before))
        others = (distance for name, distance in distances.items() if name != own)
        places.append(Placed(own, min(others)))
    return places


def run_seams(job: SeamsJob) -> dict[str, Any]:
    """Code what is not there yet, write ``job.out``, and return its content.

    Raises ``InvalidInput`` for a drive that crosses no seam or does not span the quality, and what
    reading tiles, fields and drive raises.
    """
    tiles = read_tiles(job.tiles)
    if tiles is None:
        raise InvalidInput(
            "tiles", f"{job.tiles} has no tiles.json: `rfedge dataset split` makes it"
        )
    drive = read_drive(job.drive)
    places = placed(tiles, _ground_m(drive))
    used = list(dict.fromkeys(place.tile for place in places))
    if len(used) < 2:
        raise InvalidInput("drive", f"{drive.name.dataset} stays on {used[0]}: no seam is crossed")
    files = {name: job.fields / f"{name}.rff" for name in used}
    made = provenance([job.whole, *files.values()])
    bench = Bench(job, drive, CellStore(job.cells))
    whole = bench.coded([(load_field(job.whole), range(len(places)))])
    in_tiles = bench.coded([(load_field(files[name]), list(each)) for name, each in _runs(places)])
    content = {
        "street": {
            "tiles": len(used),
            "within_m": job.within_m,
            "quality_db": job.quality_db,
            "whole_bytes": job.whole.stat().st_size,
            "tiles_bytes": sum(file.stat().st_size for file in files.values()),
        },
        "rows": [bench.row(kind, chosen, whole, in_tiles) for kind, chosen in _kinds(job, places)],
    }
    result = make_result("seams", made, content)
    write_result(job.out, result)
    return result


@dataclass(frozen=True)
class Bench:
    """The drive, and where its pieces are kept."""

    job: SeamsJob
    drive: Drive
    store: CellStore

    def coded(self, pieces: Sequence[tuple[RadianceField, Sequence[int]]]) -> DriveAtCrfs:
        """Code the drive piece by piece, each a stream of its own with a field of its own."""
        by_crf: dict[float, list[CodedClip]] = {crf: [] for crf in CRFS}
        render_mse: list[float] = []
        for field, frames in pieces:
            rendered = render_clip(field, self._cameras(field, frames))
            part = slice(frames[0], frames[-1] + 1)
            piece = replace(
                self.drive, pictures=self.drive.pictures[part], frames=self.drive.frames[part]
            )
            for crf in CRFS:
                by_crf[crf].append(self._coded(rendered, piece.clip(), crf))
            shown = zip(rendered.renders, piece.frames, strict=True)
            render_mse += [luma_mse(render, frame) for render, frame in shown]
        at_crf = {
            crf: (
                np.concatenate([clip.frame_bytes for clip in clips]),
                np.concatenate([clip.luma_mse for clip in clips]),
            )
            for crf, clips in by_crf.items()
        }
        return DriveAtCrfs(at_crf, np.array(render_mse), {frames[0] for _, frames in pieces})

    def _cameras(self, field: RadianceField, frames: Sequence[int]) -> list[Camera]:
        origin = field.metadata.tile_origin
        pictures = read_dataset(self.drive.name.dataset, tile_origin=origin).pictures
        return [pictures[index].camera for index in frames]

    def _coded(self, rendered: RenderedClip, clip: Clip, crf: float) -> CodedClip:
        effort = self.job.effort
        coder = FieldCoder(rendered, f"rfedge-{effort}", program_version(), effort=effort)
        key = clip_key(clip, coder, crf)
        return self.store.clip(key, lambda: coder.code(clip.frames, clip.rate_hz, crf))

    def row(
        self, kind: str, chosen: Sequence[int], whole: DriveAtCrfs, in_tiles: DriveAtCrfs
    ) -> SeamRow:
        """Return the row of the frames ``chosen``; raises ``InvalidInput`` where they do not span
        the quality."""
        whole_kbit, tiles_kbit = (
            made.kbit_at(chosen, self.job.quality_db) for made in (whole, in_tiles)
        )
        return SeamRow(
            scene=self.drive.name.scene,
            hz=self.drive.name.rate_hz,
            frames_are=kind,
            frames=len(chosen),
            new_streams=len(in_tiles.begins.intersection(chosen)),
            whole_kbit=whole_kbit,
            tiles_kbit=tiles_kbit,
            more_percent=100 * (tiles_kbit / whole_kbit - 1),
            whole_render_db=whole.render_db(chosen),
            tiles_render_db=in_tiles.render_db(chosen),
        )


@dataclass(frozen=True)
class DriveAtCrfs:
    """A drive coded at each CRF: (bytes, squared error of the luma) of each frame; ``begins``: the
    frames that begin a stream."""

    at_crf: dict[float, tuple[NDArray[np.int64], NDArray[np.float64]]]
    render_mse: NDArray[np.float64]
    begins: set[int]

    def kbit_at(self, chosen: Sequence[int], quality_db: float) -> float:
        """Return kilobits a frame of those chosen at a luma PSNR; raises as ``kbit_between``."""
        frames = list(chosen)
        points = (
            (psnr_of_mse(float(luma_mse[frames].mean())), float(frame_bytes[frames].mean()))
            for frame_bytes, luma_mse in self.at_crf.values()
        )
        return kbit_between(points, quality_db, "quality-db")

    def render_db(self, chosen: Sequence[int]) -> float:
        """Return the luma PSNR of the renders of the frames chosen."""
        return psnr_of_mse(float(self.render_mse[list(chosen)].mean()))


def _ground_m(drive: Drive) -> list[tuple[float, float]]:
    """Return east and north of each camera in the data set's own world."""
    dataset = read_dataset(drive.name.dataset)
    east_m, north_m, _ = astuple(dataset.tile_origin)
    places = (picture.camera.world_from_cam.translation_m for picture in dataset.pictures)
    return [(x + east_m, y + north_m) for x, y, _ in places]


def _runs(places: Sequence[Placed]) -> list[tuple[str, list[int]]]:
    """Return the frames that follow one another on one tile."""
    numbered = groupby(enumerate(places), key=lambda each: each[1].tile)
    return [(tile, [index for index, _ in run]) for tile, run in numbered]


def _kinds(job: SeamsJob, places: Sequence[Placed]) -> list[tuple[str, list[int]]]:
    """Return the kinds of frames there are, but the drive's first, which begins both codings."""
    steady = range(1, len(places))
    near = [index for index in steady if places[index].seam_m <= job.within_m]
    kinds = {
        "near a seam": near,
        "elsewhere": [index for index in steady if index not in near],
        "all": list(steady),
    }
    return [(kind, chosen) for kind, chosen in kinds.items() if chosen]
