"""Publishing and taking back: whole, checked, and never in the way of who reads."""

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from rfcore.errors import FieldFormatError, InvalidInput, UnknownField
from rfcore.field import SplatField, save_field
from rfcore.raster.gaussians import Gaussians
from rfcore.wire.tile_manifest import MANIFEST, read_publication
from rfcore.wire.tiles import Area
from rfedge.cli.field_tiles import FieldList, FieldPublish, FieldRollback
from rfedge.fields.publish import Ground, publish, roll_back

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
    assert read_publication(folder).tiles["west"].times == ("2026-01-02T03:04:05+00:00",) * 3


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
    with pytest.raises(InvalidInput, match=r"version 0 of 'west' is outside 1..1"):
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
