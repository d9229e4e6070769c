"""The examples in the docstrings of public entry points run as they stand, imports and all."""

import doctest
import importlib
from pathlib import Path

import pytest

SAMPLES = Path(__file__).parents[1] / "samples"
EXAMPLES = (
    "rfcore.dataset.read.read_dataset",
    "rfcore.link.plan.read_link",
    "rfcore.link.shaper.Link",
    "rfcore.localise.localiser.Localiser",
    "rfcore.wire.drive_file.read_drive",
    "rfedge.offline.encode_drive",
)


@pytest.mark.sample
@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs_as_it_stands(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Examples run in an empty folder that has the samples, as in a checkout."""
    module, _, attribute = name.rpartition(".")
    documented = getattr(importlib.import_module(module), attribute)
    (tmp_path / "samples").symlink_to(SAMPLES)
    monkeypatch.chdir(tmp_path)
    (example,) = doctest.DocTestFinder(recurse=False).find(documented, name, globs={})
    assert example.examples, "there is an example"
    said: list[str] = []
    result = doctest.DocTestRunner().run(example, out=said.append)
    assert not result.failed, "".join(said)
