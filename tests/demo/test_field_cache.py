"""The demo's field is trained once, found again, and never used when it is damaged."""

from pathlib import Path

import pytest
from rich.console import Console

from rfcore.errors import FieldFormatError
from rfcore.train import SplatTrainingConfig
from rfedge.demo.field import cache_path, cached_or_trained

CONFIG = SplatTrainingConfig(gaussians=100, iterations=3)
SILENT = Console(quiet=True)


def test_a_trained_field_is_found_again(tiny_sample: Path, tmp_path: Path) -> None:
    path = cached_or_trained(tiny_sample, tmp_path / "c", CONFIG, anew=False, console=SILENT)
    written_ns = path.stat().st_mtime_ns
    again = cached_or_trained(tiny_sample, tmp_path / "c", CONFIG, anew=False, console=SILENT)
    assert (again, again.stat().st_mtime_ns) == (path, written_ns)


def test_other_settings_or_another_sample_are_another_field(
    tiny_sample: Path, tmp_path: Path
) -> None:
    path = cache_path(tiny_sample, tmp_path, CONFIG)
    longer = SplatTrainingConfig(gaussians=100, iterations=4)
    assert cache_path(tiny_sample, tmp_path, longer) != path
    faster = SplatTrainingConfig(gaussians=100, iterations=3, threads=2)
    assert cache_path(tiny_sample, tmp_path, faster) == path, "threads do not change the field"
    manifest = tiny_sample / "manifest.json"
    manifest.write_text(manifest.read_text() + " ")
    assert cache_path(tiny_sample, tmp_path, CONFIG) != path


def test_a_damaged_field_says_how_to_make_it_anew(tiny_sample: Path, tmp_path: Path) -> None:
    path = cached_or_trained(tiny_sample, tmp_path, CONFIG, anew=False, console=SILENT)
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(FieldFormatError, match=r"field\.rff.*--train"):
        cached_or_trained(tiny_sample, tmp_path, CONFIG, anew=False, console=SILENT)
    assert cached_or_trained(tiny_sample, tmp_path, CONFIG, anew=True, console=SILENT) == path
