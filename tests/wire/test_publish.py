"""Publishing and taking back: whole, checked, and never in the way of who reads."""

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from rfcore.errors import FieldFormatError, InvalidInput, UnknownField
from rfcore.field import SplatField, load_field, save_field
from rfcore.field.layer import VOXELS_M, ColourLayer, layer_archive, layered_field
from rfcore.raster.gaussians import Gaussians
from rfcore.wire.tile_manifest import (
    MANIFEST,
    Ground,
    VersionLabel,
    publish,
    read_publication,
    roll_back,
)
from rfcore.wire.tiles import MAX_LIGHTS, Area, tile_message, tile_of
from rfedge.cli.field_tiles import FieldList, FieldPublish, FieldRollback

NOW = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)


@pytest.fixture
def archives(tmp_path: Path) -> list[Path]:
    """Three fields of one Gaussian each."""
    paths = []
    for i in range(3):
        arrays = {
            "means": [[i, 0, 0]], "quaternions": [[1, 0, 0, 0]], "log_scales": [[0, 0, 0]],
            "opacity_logits": [0], "sh": [[[0.5, 0.5, 0.5]]],
        }  # fmt: skip
        gaussians = Gaussians(**{name: np.asarray(a, np.float32) for name, a in arrays.items()})
        paths.append(tmp_path / f"{i}.rff")
        save_field(SplatField(gaussians), paths[-1])
    return paths


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "store"
    path.mkdir()
    return path


def current(folder: Path) -> tuple[int, str]:
    (tile,) = read_publication(folder).current()
    return tile.version, tile.field_id


def test_versions_follow_each_other_and_can_be_taken_back(
    archives: list[Path], folder: Path
) -> None:
    ids = [publish(folder, "west", path, Ground(), NOW).field_id for path in archives]
    assert current(folder) == (3, ids[2])
    assert roll_back(folder, "west").version == 2
    assert current(folder) == (2, ids[1])
    assert roll_back(folder, "west", to=3).field_id == ids[2]
    published = {version.published for version in read_publication(folder).tiles["west"].versions}
    assert published == {"2026-01-02T03:04:05+00:00"}


def test_publishing_what_is_current_makes_no_version(archives: list[Path], folder: Path) -> None:
    publish(folder, "west", archives[0], Ground(), NOW)
    assert publish(folder, "west", archives[0], Ground(), NOW).version == 1


def test_the_ground_stays_until_it_is_given_anew(archives: list[Path], folder: Path) -> None:
    area = Area((0.0, 0.0), (10.0, 5.0))
    publish(folder, "west", archives[0], Ground(area, 3.0), NOW)
    tile = publish(folder, "west", archives[1], Ground(), NOW)
    assert (tile.area, tile.margin_m) == (area, 3.0)


def test_a_damaged_archive_publishes_nothing(archives: list[Path], folder: Path) -> None:
    publish(folder, "west", archives[0], Ground(), NOW)
    before = sorted(path.name for path in folder.iterdir())
    archives[1].write_bytes(archives[1].read_bytes()[:-7])
    with pytest.raises(FieldFormatError):
        publish(folder, "west", archives[1], Ground(), NOW)
    assert current(folder)[0] == 1
    assert sorted(path.name for path in folder.iterdir()) == before


def test_what_cannot_be_taken_back_is_named(archives: list[Path], folder: Path) -> None:
    first = publish(folder, "west", archives[0], Ground(), NOW)
    with pytest.raises(InvalidInput, match=r"version 1 of 'west' is the first"):
        roll_back(folder, "west")
    with pytest.raises(InvalidInput, match=r"'east' is not published in .*tiles: west"):
        roll_back(folder, "east")
    publish(folder, "west", archives[1], Ground(), NOW)
    (folder / f"{first.field_id}.rff").unlink()
    with pytest.raises(UnknownField, match=r"version 1 of 'west'.*is gone"):
        roll_back(folder, "west")


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", "{}", '{"format": "rfedge tiles 2", "tiles": {}}',
        '{"format": "rfedge tiles 1", "tiles": {"a": {}}}',
    ],
)  # fmt: skip
def test_a_damaged_manifest_is_named(text: str, folder: Path) -> None:
    (folder / MANIFEST).write_text(text)
    with pytest.raises(FieldFormatError, match=MANIFEST):
        read_publication(folder)


def test_a_current_version_that_is_not_there_is_refused(archives: list[Path], folder: Path) -> None:
    publish(folder, "west", archives[0], Ground(), NOW)
    stored = json.loads((folder / MANIFEST).read_text())
    stored["tiles"]["west"]["current"] = 2
    (folder / MANIFEST).write_text(json.dumps(stored))
    with pytest.raises(FieldFormatError, match=r"tile.current: 2 is outside 1..1"):
        read_publication(folder)


def test_a_folder_without_a_manifest_publishes_no_tiles(folder: Path) -> None:
    assert read_publication(folder).current() == ()


def test_the_verbs_say_what_is_current(
    archives: list[Path], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    FieldList(folder).run()
    assert "publishes no tiles" in capsys.readouterr().out
    FieldPublish(archives[0], folder, "west", (0, 0, 9, 5), 2.0).run()
    FieldPublish(archives[1], folder, "west").run()
    FieldRollback(folder, "west").run()
    out = capsys.readouterr().out.splitlines()
    assert [line.split(",")[0] for line in out] == [f"west is version {n}" for n in (1, 2, 1)]
    FieldList(folder).run()
    out = capsys.readouterr().out.splitlines()
    assert out[0] == "west: 0, 0 to 9, 5 m, margin 2 m"
    assert [line[0] for line in out[1:]] == ["*", " "]


def test_a_light_stands_beside_the_tiles_own_field(archives: list[Path], folder: Path) -> None:
    publish(folder, "west", archives[0], Ground(), NOW)
    dusk = VersionLabel("dusk", passes=2, time_of_day_h=18.5)
    tile = publish(folder, "west", archives[1], Ground(), NOW, dusk)
    (light,) = tile.lights
    assert (tile.version, light.version, light.name, light.passes) == (1, 2, "dusk", 2)
    assert tile.renderable_ids == (tile.field_id, light.field_id)
    assert read_publication(folder).current() == (tile,)
    later = publish(folder, "west", archives[2], Ground(), NOW)
    assert (later.version, later.lights) == (3, (light,))


def test_a_light_is_taken_back_version_by_version(archives: list[Path], folder: Path) -> None:
    publish(folder, "west", archives[0], Ground(), NOW)
    for path in archives[1:]:
        publish(folder, "west", path, Ground(), NOW, VersionLabel("dusk"))
    assert roll_back(folder, "west", light="dusk").lights[0].version == 2
    assert roll_back(folder, "west", light="dusk").lights == ()
    with pytest.raises(InvalidInput, match="'dusk' is no current light"):
        roll_back(folder, "west", light="dusk")
    assert roll_back(folder, "west", to=3, light="dusk").lights[0].version == 3


def test_the_tile_itself_never_goes_back_to_a_light(archives: list[Path], folder: Path) -> None:
    publish(folder, "west", archives[0], Ground(), NOW)
    publish(folder, "west", archives[1], Ground(), NOW, VersionLabel("dusk"))
    publish(folder, "west", archives[2], Ground(), NOW)
    with pytest.raises(InvalidInput, match=r"version 2 of 'west' is none of \[1, 3\]"):
        roll_back(folder, "west", to=2)
    assert roll_back(folder, "west").version == 1


def test_a_light_without_a_tile_is_refused(archives: list[Path], folder: Path) -> None:
    with pytest.raises(InvalidInput, match="publish a field of tile 'west' itself first"):
        publish(folder, "west", archives[0], Ground(), NOW, VersionLabel("dusk"))
    assert list(folder.glob("*.rff")) == []


def test_a_layer_is_published_with_the_base_it_needs(archives: list[Path], folder: Path) -> None:
    base = load_field(archives[0])
    assert isinstance(base, SplatField)
    layer = ColourLayer(
        tuple(np.full((1, 6), 1, np.int32) for _ in VOXELS_M), np.zeros((1, 3), np.int32)
    )
    made = layered_field(layer_archive(layer, base, base.metadata), base, base.metadata)
    path = archives[0].with_name("dusk.rff")
    save_field(made, path)
    publish(folder, "west", archives[1], Ground(), NOW)
    with pytest.raises(UnknownField, match=base.field_id):
        publish(folder, "west", path, Ground(), NOW, VersionLabel("dusk"))
    publish(folder, "east", archives[0], Ground(), NOW)
    tile = publish(folder, "west", path, Ground(), NOW, VersionLabel("dusk"))
    assert tile.lights[0].base_field_id == base.field_id
    assert base.field_id in tile.archive_ids


def test_a_tile_with_lights_is_the_same_at_the_other_end(
    archives: list[Path], folder: Path
) -> None:
    publish(folder, "west", archives[0], Ground(), NOW)
    for name, hour in (("dusk", 18.25), ("rain", None)):
        label = VersionLabel(name, passes=3, time_of_day_h=hour)
        publish(folder, "west", archives[1], Ground(), NOW, label)
    (tile,) = read_publication(folder).current()
    assert tile_of(tile_message(tile)) == tile


def test_more_lights_than_are_kept_open_are_refused(archives: list[Path], folder: Path) -> None:
    tile = publish(folder, "west", archives[0], Ground(), NOW)
    message = tile_message(tile)
    for number in range(MAX_LIGHTS + 1):
        message.lights.add(name=f"l{number}", field_id=tile.field_id, version=1)
    with pytest.raises(InvalidInput, match="8 are more than 7"):
        tile_of(message)
