"""Samples are found in the working folder, in the checkout and in the wheel, in this order."""

import re
from pathlib import Path

import pytest

import rfedge.samples
from rfedge.samples import sample_path

ROOT = Path(__file__).parents[2]


def put(folder: Path, name: str) -> Path:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).touch()
    return folder / name


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    """An empty working folder, checkout and package."""
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    monkeypatch.setattr(rfedge.samples, "CHECKOUT", tmp_path / "checkout" / "samples")
    monkeypatch.setattr(rfedge.samples, "PACKAGED", tmp_path / "package" / "samples")
    return {"checkout": rfedge.samples.CHECKOUT, "package": rfedge.samples.PACKAGED}


def test_the_working_folder_comes_before_the_checkout_and_that_before_the_wheel(places):
    packaged = put(places["package"], "links/drive.up")
    assert sample_path("links/drive.up") == packaged
    checked_out = put(places["checkout"], "links/drive.up")
    assert sample_path("links/drive.up") == checked_out
    put(Path("samples"), "links/drive.up")
    assert sample_path("links/drive.up") == Path("samples/links/drive.up")


def test_a_folder_with_other_samples_does_not_hide_the_packaged_ones(places):
    packaged = put(places["package"], "fields/street.rff")
    put(Path("samples"), "street/own.toml")
    assert sample_path("fields/street.rff") == packaged


def test_a_sample_that_is_nowhere_is_named_where_the_user_would_put_it(places):
    assert not any(place.exists() for place in places.values())
    assert sample_path("street") == Path("samples/street")


def test_a_checkout_is_found_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert sample_path("street/manifest.json") == ROOT / "samples/street/manifest.json"


def test_what_a_wheel_carries_stays_within_its_limit():
    """A wheel of at most 40 MB, of which the compiled kernels and the code take some."""
    listed = re.search(
        r"^set\(samples (.*)\)$", (ROOT / "CMakeLists.txt").read_text(), re.MULTILINE
    )
    names = listed[1].split()
    assert {"street", "fields", "links"} <= set(names)
    found = [path for name in names for path in (ROOT / "samples" / name).rglob("*")]
    assert 20e6 < sum(path.stat().st_size for path in found if path.is_file()) < 38e6
