"""Seeds and finds of fuzzing: every reader takes each, or refuses it in words."""

import subprocess
import sys
from pathlib import Path

import pytest

from fuzz.targets import TARGETS

HERE = Path(__file__).parent
INPUTS = sorted(path for folder in ("corpus", "crashers") for path in (HERE / folder).glob("*/*"))


@pytest.mark.parametrize("path", INPUTS, ids=lambda path: f"{path.parent.name}-{path.name[:20]}")
def test_an_input_is_read_or_refused(path):
    TARGETS[path.parent.name](path.read_bytes())


PLAINLY = """
import importlib.util
from fuzz import load_sources_plainly
extension = load_sources_plainly()
import rfcore.native
rfcore.native.__path__.append(extension)
import targets
loaders = {type(importlib.util.find_spec(name).loader).__name__ for name in ("rfcore.wire.convert",
    "mec_server.session")}
print(*loaders)
"""


def test_sources_are_loaded_by_what_atheris_can_instrument():
    command = [sys.executable, "-c", PLAINLY]
    ran = subprocess.run(command, cwd=HERE, capture_output=True, text=True)
    assert ran.stdout == "SourceFileLoader\n", ran.stderr


def test_every_target_has_something_to_start_from():
    assert {path.parent.name for path in INPUTS} == set(TARGETS)
    assert "atheris" not in sys.modules, "the tests do without the fuzzer"
