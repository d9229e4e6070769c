"""The kernels' objects hold nothing the linker could merge across instruction sets."""

import shutil
import subprocess
from pathlib import Path

import pytest

BUILD = Path(__file__).parents[2] / "build"
OBJECTS = sorted(
    path for path in BUILD.glob("*/CMakeFiles/kernels_*.dir/**/*.o") if "asan" not in path.parts
)
MERGEABLE = set("vVwWu")
"""Types of `nm` for weak and unique symbols."""


def test_the_build_keeps_an_object_per_instruction_set():
    names = {part for path in OBJECTS for part in path.parts if part.startswith("kernels_")}
    assert "kernels_scalar.dir" in names, f"no kernel objects under {BUILD}; run `make build`"
    assert len(names) >= 2


@pytest.mark.parametrize("path", OBJECTS, ids=lambda path: path.parents[-1].name + path.name)
def test_no_symbol_of_a_kernel_object_is_weak_or_unique(path):
    nm = shutil.which("nm")
    assert nm is not None, "nm comes with the compiler that built the kernels"
    listing = subprocess.run([nm, path], capture_output=True, text=True, check=True).stdout
    symbols = [line.split()[-2:] for line in listing.splitlines()]
    assert [name for kind, name in symbols if kind in MERGEABLE] == []


@pytest.mark.parametrize("path", OBJECTS, ids=lambda path: path.parents[-1].name + path.name)
def test_a_kernel_object_exports_its_table_alone(path):
    listing = subprocess.run(
        ["nm", "--extern-only", "--defined-only", path], capture_output=True, text=True, check=True
    ).stdout
    assert len(listing.splitlines()) == 1
    assert "Kernels" in listing
