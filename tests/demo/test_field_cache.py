"""The demo starts from the field that ships, or trains one once; never from a damaged one."""

import json
from pathlib import Path

import pytest
from rich.console import Console

from lab import sample_field
from lab.sample_field import write_sample_field
from rfcore.dataset import write_manifest
from rfcore.errors import DatasetError, FieldFormatError, InvalidData
from rfcore.field import SplatField, load_field
from rfcore.raster.gaussians import Gaussians
from rfcore.train.splats import SplatTrainingConfig
from rfedge.demo.field import cache_path, choose_field, sample_field_path
from rfedge.results import provenance

CONFIG = SplatTrainingConfig(gaussians=100, iterations=3)
SILENT = Console(quiet=True)
BY_HAND = provenance(command="by hand", at="v1")


def chosen(
    sample: Path, cache: Path, config: SplatTrainingConfig = CONFIG, anew: bool = False
) -> Path:
    return choose_field(sample, cache, config, SILENT, anew=anew)


def test_a_trained_field_is_found_again(tiny_sample, tmp_path):
    path = chosen(tiny_sample, tmp_path / "c")
    written_ns = path.stat().st_mtime_ns
    again = chosen(tiny_sample, tmp_path / "c")
    assert (again, again.stat().st_mtime_ns) == (path, written_ns)


def test_a_trained_field_is_small_has_levels_and_says_how_good_it_is(tiny_sample, tmp_path):
    field = load_field(chosen(tiny_sample, tmp_path / "c"))
    assert isinstance(field, SplatField)
    assert "encoding" in field.archive().metadata
    assert set(field.levels) == {0.5, 0.25, 0.1}
    assert field.metadata.held_out_psnr_db is not None
    assert field.metadata.held_out_ssim is not None


def test_other_settings_or_another_sample_are_another_field(tiny_sample, tmp_path):
    path = cache_path(tiny_sample, tmp_path, CONFIG)
    longer = SplatTrainingConfig(gaussians=100, iterations=4)
    assert cache_path(tiny_sample, tmp_path, longer) != path
    faster = SplatTrainingConfig(gaussians=100, iterations=3, threads=2)
    assert cache_path(tiny_sample, tmp_path, faster) == path, "threads do not change the field"
    manifest = tiny_sample / "manifest.json"
    manifest.write_text(manifest.read_text() + " ")
    assert cache_path(tiny_sample, tmp_path, CONFIG) != path


def test_a_damaged_field_says_how_to_make_it_anew(tiny_sample, tmp_path):
    path = chosen(tiny_sample, tmp_path)
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(FieldFormatError, match=r"field\.rff.*--train"):
        chosen(tiny_sample, tmp_path)
    assert chosen(tiny_sample, tmp_path, anew=True) == path


@pytest.fixture
def shipped(tiny_sample: Path, tiny_gaussians: Gaussians) -> Path:
    """The field of the tiny sample, put where a shipped one lies."""
    write_sample_field(tiny_sample, SplatField(tiny_gaussians).compressed(), BY_HAND, 0)
    return sample_field_path(tiny_sample)


def test_the_shipped_field_is_used_at_once_unless_the_user_asks_for_another(
    shipped, tiny_sample, tmp_path
):
    assert chosen(tiny_sample, tmp_path / "c", SplatTrainingConfig(threads=2)) == shipped
    assert not (tmp_path / "c").exists()
    assert chosen(tiny_sample, tmp_path / "c", CONFIG) == cache_path(
        tiny_sample, tmp_path / "c", CONFIG
    )


@pytest.mark.parametrize("victim", ["tiny.rff", "tiny.json"])
def test_a_damaged_shipped_field_is_named_with_the_way_out(shipped, tiny_sample, tmp_path, victim):
    path = shipped.parent / victim
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    with pytest.raises(DatasetError, match=f"{victim}.*--train"):
        chosen(tiny_sample, tmp_path, SplatTrainingConfig())


def test_a_shipped_field_of_another_sample_is_refused(shipped, tiny_sample, tmp_path):
    (tiny_sample / "more.txt").write_text("new")
    write_manifest(tiny_sample)
    with pytest.raises(DatasetError, match=r"made from another .* --train"):
        chosen(tiny_sample, tmp_path, SplatTrainingConfig())
    shipped.with_suffix(".json").write_text("{}")
    write_manifest(shipped.parent)
    with pytest.raises(DatasetError, match="no readable record"):
        chosen(tiny_sample, tmp_path, SplatTrainingConfig())


def test_a_field_too_large_to_ship_is_not_left_there(tiny_sample, tiny_gaussians, monkeypatch):
    monkeypatch.setattr(sample_field, "MAX_BYTES", 1000)
    with pytest.raises(InvalidData, match="over the 1000"):
        write_sample_field(tiny_sample, SplatField(tiny_gaussians), BY_HAND, 0)
    assert not sample_field_path(tiny_sample).exists()


def test_making_the_sample_field_writes_what_the_demo_takes(tiny_sample, tmp_path, monkeypatch):
    options = "--gaussians 100 --iterations 3 --limit 120 --sh-degree 1 --max-mb 0.02 --sky 50"
    monkeypatch.setattr("sys.argv", ["sample-field", str(tiny_sample), *options.split()])
    assert sample_field.main() == 0
    path = chosen(tiny_sample, tmp_path / "c", SplatTrainingConfig())
    assert path == sample_field_path(tiny_sample)
    record = json.loads(path.with_suffix(".json").read_text())
    assert record["command"] == f'make sample-field ARGS="{options}"'
    assert record["bytes"] == path.stat().st_size
    field = load_field(path)
    assert record["field"] == f"splats {field.field_id}"
    assert isinstance(field, SplatField)
    assert field.gaussians.sh_degree == 1
    assert path.stat().st_size <= 20_000


def test_a_sample_that_cannot_be_read_has_no_field_made(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["sample-field", str(tmp_path)])
    assert sample_field.main() == 2
    assert "manifest.json" in capsys.readouterr().err
