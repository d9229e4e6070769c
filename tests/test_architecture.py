"""The layers are those that ``docs/explanation/architecture.md`` draws."""

import re
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "explanation" / "architecture.md"


def layered_contracts() -> list[dict[str, Any]]:
    config = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts: list[dict[str, Any]] = config["tool"]["importlinter"]["contracts"]
    return [contract for contract in contracts if contract["type"] == "layers"]


def drawn_layers() -> list[list[str]]:
    """Return the fenced blocks ``layers``, a line a layer, without what stands after ``#``."""
    page = PAGE.read_text(encoding="utf-8")
    blocks = re.findall(r"^```layers\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)
    return [[line.split("#")[0].strip() for line in block.splitlines()] for block in blocks]


def test_the_page_draws_the_layers_that_are_enforced():
    assert drawn_layers() == [contract["layers"] for contract in layered_contracts()]


def test_layers_inside_a_package_name_everything_in_it():
    inside = [contract for contract in layered_contracts() if "containers" in contract]
    assert {name for contract in inside for name in contract["containers"]} >= {"rfcore", "rfedge"}
    assert all(contract["exhaustive"] for contract in inside)
