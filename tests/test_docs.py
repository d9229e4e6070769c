"""The documents name only what exists."""

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
METHOD = (ROOT / "docs" / "explanation" / "method.md").read_text(encoding="utf-8")
NAME = r"`((?:rfcore|cav_agent|mec_server|rfedge)[\w.]*:[\w.]+)`"
FUNCTIONS = sorted(set(re.findall(NAME, METHOD)))
TESTS = sorted(set(re.findall(r"`(test_\w+)`", METHOD)))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_of_the_method_exists(name: str) -> None:
    module, attributes = name.split(":")
    found = importlib.import_module(module)
    for attribute in attributes.split("."):
        found = getattr(found, attribute)


def test_every_test_of_the_method_exists() -> None:
    sources = "".join(path.read_text(encoding="utf-8") for path in ROOT.glob("tests/**/*.py"))
    defined = set(re.findall(r"def (test_\w+)", sources))
    assert [name for name in TESTS if name not in defined] == []


def test_the_method_is_not_empty() -> None:
    assert len(FUNCTIONS) > 15
    assert len(TESTS) > 15


def test_the_readme_fits_on_a_few_screens() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150
