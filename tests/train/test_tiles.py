"""``rfedge train`` of the tiles of a split: here or on Ray, killed or not, the same bytes."""

import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from lab.servers.ray import require_resumed, train_tiles
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.wire.tile_manifest import read_publication
from rfedge.cli.field_tiles import FieldPublish
from rfedge.datasets.convert import SplitSettings, split_dataset
from rfedge.training import Train
from tests.train.conftest import write_drive

OPTIONS = {"iterations": 60, "gaussians": 200, "threads": 1, "plain": True, "checkpoint_every": 20}


@pytest.fixture(scope="session")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two tiles of a drive past a painted wall."""
    folder = write_drive(tmp_path_factory.mktemp("drive"), [0.2 * i for i in range(16)])
    split_dataset(folder, folder / "split", SplitSettings(1.5, 0.4))
    return folder / "split"


@pytest.fixture(scope="session")
def trained(split: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The fields of the two tiles, trained here."""
    out = tmp_path_factory.mktemp("fields") / "out"
    verb(split, out).run()
    return out


def verb(split: Path, out: Path) -> Train:
    return replace(Train(split, out), **OPTIONS)


def fields_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*.rff")}


def test_every_tile_gets_a_field_and_its_checkpoint_is_gone(trained):
    names = {"tile-0-0", "tile-1-0"}
    assert {path.name for path in trained.iterdir()} == {
        "tiles.json",
        *(f"{name}.rff" for name in names),
        *(f"{name}.rff.job" for name in names),
    }


def test_tiles_that_are_trained_are_skipped_and_with_other_settings_trained_again(
    split, trained, tmp_path, capsys
):
    out = tmp_path / "out"
    out.mkdir()
    for path in trained.iterdir():
        (out / path.name).write_bytes(path.read_bytes())
    verb(split, out).run()
    assert f"{out}: 2 tiles, 2 of them trained before" in capsys.readouterr().out
    replace(verb(split, out), seed=2).run()
    assert f"{out}: 2 tiles, 0 of them trained before" in capsys.readouterr().out
    assert fields_of(out) != fields_of(trained)


def test_one_tile_that_cannot_be_trained_does_not_stop_the_other(split, trained, tmp_path):
    broken = tmp_path / "split"
    for path in split.rglob("*"):
        if path.is_file():
            copy = broken / path.relative_to(split)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(path.read_bytes())
    picture = next((broken / "tile-0-0/images").iterdir())
    picture.write_bytes(picture.read_bytes()[:200])
    with pytest.raises(RfedgeError, match=r"^1 of 2 jobs failed.*\n  tile-0-0: .*images"):
        verb(broken, tmp_path / "out").run()
    whole = fields_of(trained)["tile-1-0.rff"]
    assert fields_of(tmp_path / "out") == {"tile-1-0.rff": whole}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"minutes": 1.0}, "minutes: goes with one dataset"),
        ({"json": "-"}, "json: goes with one dataset"),
        ({"resume": True}, "resume: goes with one dataset"),
        ({"out": Path("a.rff")}, "out: a.rff must be a folder"),
    ],
)
def test_what_one_dataset_takes_is_refused_for_tiles(split, tmp_path, changed, message):
    with pytest.raises(InvalidInput, match=message):
        replace(verb(split, tmp_path), **changed).run()


def test_one_dataset_is_not_trained_on_ray(split, tmp_path):
    one = replace(verb(split / "tile-0-0", tmp_path / "a.rff"), ray="local")
    with pytest.raises(InvalidInput, match=r"ray: trains tiles, and .* has no tiles\.json"):
        one.run()


def test_trained_tiles_are_published_for_their_ground(trained, tmp_path):
    FieldPublish(trained, tmp_path).run()
    tiles = read_publication(tmp_path).tiles
    assert set(tiles) == {"tile-0-0", "tile-1-0"}
    west, east = tiles["tile-0-0"].area, tiles["tile-1-0"].area
    assert west.high_m[0] == east.low_m[0] == pytest.approx(1.5)
    assert tiles["tile-0-0"].margin_m == 0.2
    with pytest.raises(InvalidInput, match="tile: goes with one field"):
        FieldPublish(trained, tmp_path, tile="other").run()


def test_nothing_is_published_where_a_tile_is_missing(trained, tmp_path):
    for name in ("tiles.json", "tile-0-0.rff"):
        (tmp_path / name).write_bytes((trained / name).read_bytes())
    with pytest.raises(InvalidInput, match=r"tile-1-0\.rff is missing"):
        FieldPublish(tmp_path, tmp_path / "published").run()
    assert not (tmp_path / "published").exists()


@pytest.mark.slow
def test_on_ray_the_fields_are_the_same_bytes_also_when_a_worker_is_killed(split, tmp_path):
    options = ["--iterations", "4000", "--gaussians", "200", "--threads", "1", "--plain"]
    options += ["--checkpoint-every", "20"]
    here, there = tmp_path / "here", tmp_path / "there"
    replace(verb(split, here), iterations=4000).run()
    run = train_tiles(split, there, options, "local", kill_at="tile-0-0")
    require_resumed(run, "tile-0-0")
    assert run.resumed_after("tile-0-0")[0] >= 2000
    assert len(run.work_s) == 2
    assert fields_of(there) == fields_of(here)
    assert len(fields_of(here)) == 2


def test_without_the_option_ray_is_not_imported(split, tmp_path):
    code = "import sys; from rfedge.cli import main; end = main(); print('ray' in sys.modules)"
    run = partial(subprocess.run, capture_output=True, text=True, check=True)
    done = run([sys.executable, "-c", code, "train", str(split), "--out", str(tmp_path / "out"),
                *("--iterations", "2", "--gaussians", "20", "--plain")])  # fmt: skip
    assert done.stdout.splitlines()[-1] == "False"
