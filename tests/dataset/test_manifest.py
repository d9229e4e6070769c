"""A manifest notices every damaged and every missing file, by name."""

from pathlib import Path

import pytest

from rfcore.dataset import verify_manifest, write_manifest
from rfcore.errors import DatasetError


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "a.bin").write_bytes(b"one")
    (tmp_path / "b.bin").write_bytes(b"two")
    write_manifest(tmp_path)
    return tmp_path


def test_what_was_listed_verifies_and_listing_again_changes_nothing(directory):
    verify_manifest(directory)
    before = (directory / "manifest.json").read_bytes()
    write_manifest(directory)
    assert (directory / "manifest.json").read_bytes() == before


def test_words_about_the_data_may_change(directory):
    before = (directory / "manifest.json").read_bytes()
    (directory / "README.md").write_text("about the data\n")
    assert write_manifest(directory).read_bytes() == before
    (directory / "sub" / "README.md").write_text("data\n")
    assert b"sub/README.md" in write_manifest(directory).read_bytes()


def test_a_flipped_bit_is_named(directory):
    (directory / "sub" / "a.bin").write_bytes(b"ona")
    with pytest.raises(DatasetError, match=r"sub/a\.bin: damaged"):
        verify_manifest(directory)


def test_a_missing_file_is_named(directory):
    (directory / "b.bin").unlink()
    with pytest.raises(DatasetError, match=r"b\.bin: listed in manifest\.json but missing"):
        verify_manifest(directory)


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"sha256": 3}', '{"sha256": {"../x": "00"}}'])
def test_a_manifest_that_is_none_is_refused(directory, text):
    (directory / "manifest.json").write_text(text)
    with pytest.raises(DatasetError, match=r"manifest\.json"):
        verify_manifest(directory)


def test_a_directory_without_manifest_is_refused(tmp_path):
    with pytest.raises(DatasetError, match=r"manifest\.json"):
        verify_manifest(tmp_path)
