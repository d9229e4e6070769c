"""What fuzzing started from and what it found: every reader takes each, or refuses it in words."""

import sys
from pathlib import Path

import pytest

from fuzz.targets import TARGETS

HERE = Path(__file__).parent
INPUTS = sorted(path for folder in ("corpus", "crashers") for path in (HERE / folder).glob("*/*"))


@pytest.mark.parametrize("path", INPUTS, ids=lambda path: f"{path.parent.name}-{path.name[:20]}")
def test_an_input_is_read_or_refused(path: Path) -> None:
    TARGETS[path.parent.name](path.read_bytes())


def test_every_target_has_something_to_start_from() -> None:
    assert {path.parent.name for path in INPUTS} == set(TARGETS)
    assert "atheris" not in sys.modules, "the tests do without the fuzzer"
