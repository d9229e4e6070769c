"""The layers that ``docs/architecture.md`` draws are those that import-linter enforces."""

import re
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]


def layered_contracts() -> list[dict[str, Any]]:
    config = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts: list[dict[str, Any]] = config["tool"]["importlinter"]["contracts"]
    return [contract for contract in contracts if contract["type"] == "layers"]


def drawn_layers() -> list[list[str]]:
    """The fenced blocks ``layers`` of the page, a line a layer, without comments."""
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```layers\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)
    return [[line.split("#")[0].strip() for line in block.splitlines()] for block in blocks]


def test_the_page_draws_the_layers_that_are_enforced() -> None:
    assert drawn_layers() == [contract["layers"] for contract in layered_contracts()]


def test_layers_inside_a_package_name_every_module_of_it() -> None:
    inside = [contract for contract in layered_contracts() if "containers" in contract]
    assert {name for contract in inside for name in contract["containers"]} >= {"rfcore", "rfedge"}
    assert all(contract["exhaustive"] for contract in inside)
