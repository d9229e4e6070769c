"""Tiles of a street against one field of it: which frames are near a seam, and what they cost."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from experiments.conftest import wall

from lab.robust.seams import (
    Placed,
    SeamRow,
    SeamsJob,
    placed,
    run_seams,
    seams_section,
)
from rfcore.errors import InvalidInput
from rfcore.field import save_field
from rfedge.datasets.split import SplitSettings, SplitTile, split_dataset
from rfedge.results import rows_of

WEST = SplitTile("west", (0.0, 0.0, 10.0, 4.0), 1.0, (), ("east",))
EAST = SplitTile("east", (10.0, 0.0, 20.0, 4.0), 1.0, (), ("west",))


def test_a_frame_is_of_the_tile_it_is_on_and_on_the_border_of_the_one_before() -> None:
    there = placed((WEST, EAST), [(2.0, 1.0), (10.0, 1.0), (13.0, 1.0), (10.0, 1.0), (25.0, 1.0)])
    assert there == [
        Placed("west", 8.0),
        Placed("west", 0.0),
        Placed("east", 3.0),
        Placed("east", 0.0),
        Placed("east", 15.0),
    ]
    with pytest.raises(InvalidInput, match="tiles: 1 of them have no seam"):
        placed((WEST,), [(2.0, 1.0)])


@pytest.fixture(scope="module")
def seams(thumbnail: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The thumbnail's drive of 0.2 m, cut in the middle; each tile has the very field of all."""
    folder = tmp_path_factory.mktemp("seams")
    path = Path(thumbnail.drive.partition("=")[2])
    tiles = split_dataset(path, folder / "split", SplitSettings(0.5, 0.1, fewest=1))
    assert len(tiles) == 2
    (folder / "fields").mkdir()
    for tile in tiles:
        shutil.copy(thumbnail.field, folder / "fields" / f"{tile.name}.rff")
    job = SeamsJob(
        whole=thumbnail.field,
        tiles=folder / "split",
        fields=folder / "fields",
        drive=thumbnail.drive,
        within_m=0.06,
        quality_db=36.0,
        effort="fast",
        out=folder / "seams.json",
        cells=folder / "cells",
    )
    return job, run_seams(job)


def test_with_the_same_field_in_every_tile_nothing_but_the_new_stream_differs(seams: Any) -> None:
    job, result = seams
    assert json.loads(job.out.read_text()) == result
    rows = {row.frames_are: row for row in rows_of(SeamRow, result["rows"])}
    near, elsewhere = rows["near a seam"], rows["elsewhere"]
    assert rows["all"].frames == near.frames + elsewhere.frames == 4
    assert (near.new_streams, elsewhere.new_streams) == (1, 0)
    for row in rows.values():
        assert row.whole_render_db == pytest.approx(row.tiles_render_db)
        assert row.more_percent == pytest.approx(100 * (row.tiles_kbit / row.whole_kbit - 1))
        assert abs(row.more_percent) < 5, "the render alone predicts a noisy wall as well"
    assert result["street"]["tiles_bytes"] == 2 * result["street"]["whole_bytes"]


def test_a_tile_with_the_field_of_another_street_costs_bits_near_its_seam(
    seams: Any, tmp_path: Path
) -> None:
    job, result = seams
    shutil.copytree(job.fields, tmp_path / "fields")
    east = sorted((tmp_path / "fields").iterdir())[-1]
    save_field(wall(2), east)
    wrong = run_seams(replace(job, fields=tmp_path / "fields", out=tmp_path / "wrong.json"))
    (near,) = (row for row in rows_of(SeamRow, wrong["rows"]) if row.frames_are == "near a seam")
    assert near.more_percent > 20
    assert near.tiles_render_db < near.whole_render_db - 3
    assert near.whole_kbit == rows_of(SeamRow, result["rows"])[0].whole_kbit


def test_finished_pieces_are_not_coded_again(seams: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    job, result = seams
    coder = "lab.robust.seams.FieldCoder.code"
    monkeypatch.setattr(coder, lambda *_: pytest.fail("coded again"))
    assert run_seams(job)["rows"] == result["rows"]


def test_a_section_has_what_was_measured(seams: Any) -> None:
    job, result = seams
    section = seams_section(job.out, result)
    assert "A drive across 2 tiles; near a seam: within 0.06 m" in section
    assert "near a seam | 1 |" in section


def test_what_cannot_be_compared_is_refused_by_name(seams: Any) -> None:
    job, _ = seams
    with pytest.raises(InvalidInput, match=r"tiles: .* has no tiles\.json"):
        run_seams(replace(job, tiles=job.fields))
    with pytest.raises(InvalidInput, match="quality-db: 49 dB is outside"):
        run_seams(replace(job, quality_db=49.0))
    for change, named in (({"within_m": 0.0}, "within-m"), ({"quality_db": 5.0}, "quality-db")):
        with pytest.raises(InvalidInput, match=named):
            replace(job, **change)


def test_a_drive_that_stays_on_one_tile_is_refused(seams: Any, tmp_path: Path) -> None:
    job, _ = seams
    listed = json.loads((job.tiles / "tiles.json").read_text())
    for tile in listed["tiles"]:
        west, south, east, north = tile["area_m"]
        tile["area_m"] = [west + 100, south, east + 100, north]
    (tmp_path / "tiles.json").write_text(json.dumps(listed))
    with pytest.raises(InvalidInput, match=r"drive: .* stays on tile-"):
        run_seams(replace(job, tiles=tmp_path))
