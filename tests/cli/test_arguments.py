"""A field is found by path or by name, by the same rule in every command."""

from pathlib import Path

import pytest

from rfcore.errors import InvalidInput
from rfedge.arguments import field_path


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names are looked up in the working folder."""
    monkeypatch.chdir(tmp_path)


def made(path: str) -> Path:
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.touch()
    return file


@pytest.mark.parametrize("name", ["mine", "mine.rff"])
def test_an_imported_field_comes_before_a_samples_of_the_same_name(name):
    sample = made("samples/fields/mine.rff")
    assert field_path(name) == sample
    imported = made("out/fields/mine.rff")
    assert field_path(name) == imported
    assert field_path(Path(name)) == imported


def test_a_file_of_that_path_comes_before_every_name():
    made("out/fields/mine.rff")
    assert field_path("mine.rff") == Path("out/fields/mine.rff")
    assert field_path(made("mine.rff")) == Path("mine.rff")


def test_a_folder_is_no_field():
    """A dataset and the field trained on it often have one name."""
    Path("street").mkdir()
    imported = made("out/fields/street.rff")
    assert field_path("street") == imported


def test_a_path_with_folders_is_only_a_path():
    made("out/fields/mine.rff")
    with pytest.raises(InvalidInput, match=r"there is no file fields/mine;"):
        field_path("fields/mine")


def test_what_is_not_found_lists_what_was_tried_and_what_there_is():
    with pytest.raises(InvalidInput, match=r"names known here: none \(rfedge field import"):
        field_path("mine")
    made("out/fields/other.rff")
    made("samples/fields/street.rff")
    made("samples/fields/manifest.json")
    with pytest.raises(InvalidInput) as caught:
        field_path("mine")
    assert str(caught.value) == (
        "field: 'mine' is no field: there is no file mine, out/fields/mine.rff, "
        "samples/fields/mine.rff; names known here: other, street"
    )
