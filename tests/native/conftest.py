"""Programs built for AArch64 and run by an emulator.

They need Debian's ``g++-aarch64-linux-gnu`` and ``qemu-user``; ``make test-slow`` installs them
where it may, and a test that lacks them fails and says so.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BUILD = ROOT / "build" / "cross" / "aarch64"
COMPILER, EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64"

Emulated = Callable[[str, str, int, bytes], bytes]


@pytest.fixture(scope="session")
def cross_build() -> Path:
    """Configure the build for AArch64 with the flags of the build itself; return its folder."""
    target = ["-DCMAKE_SYSTEM_NAME=Linux", "-DCMAKE_SYSTEM_PROCESSOR=aarch64"]
    tools = [f"-DCMAKE_MAKE_PROGRAM={_tool('ninja')}", f"-DCMAKE_CXX_COMPILER={_tool(COMPILER)}"]
    _run(_tool("cmake"), "-S", ROOT, "-B", BUILD, "-G", "Ninja", *target, *tools)
    return BUILD


@pytest.fixture
def emulated(cross_build: Path, tmp_path: Path) -> Emulated:
    """Return a call that builds a program, runs it on a scene and returns what it wrote."""

    def run(program: str, isa: str, threads: int, scene: bytes) -> bytes:
        _run(_tool("cmake"), "--build", cross_build, "--target", program)
        (tmp_path / "scene").write_bytes(scene)
        paths = (tmp_path / "scene", tmp_path / "result")
        _run(_tool(EMULATOR), cross_build / program, isa, str(threads), *paths)
        return paths[1].read_bytes()

    return run


@pytest.fixture(scope="session")
def first_difference() -> Callable[[bytes, bytes], int | None]:
    """Return a call that says where two results differ, which says in what."""

    def find(a: bytes, b: bytes) -> int | None:
        assert len(a) == len(b)
        return next((i for i, (x, y) in enumerate(zip(a, b, strict=True)) if x != y), None)

    return find


def _tool(name: str) -> str:
    """Return the path of a program, this environment's own first."""
    folders = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    found = shutil.which(name, path=folders)
    if found is None:
        pytest.fail(
            f"{name} not found: run `make cross` as root, or "
            "`apt-get install g++-aarch64-linux-gnu qemu-user` (cmake and ninja: `make build`)"
        )
    return found


def _run(*command: str | Path) -> None:
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
