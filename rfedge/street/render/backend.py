"""Which Mitsuba runs here: compiled by LLVM where that works, else its slow scalar variant.

Mitsuba is told by ``DRJIT_LIBLLVM_PATH`` which LLVM to load, and the wrong one ends the process: of
Debian's, 14 is refused, 15 and 16 abort in code generation ("Cannot select", Mitsuba 3.9.1), 19
works. So versions below ``OLDEST_LLVM`` are passed over, and since an abort is no exception, each
newer one is tried in a process of its own, newest first.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from rfcore.extras import needs, require

__all__ = ["Backend", "chosen_backend", "load_mitsuba", "require_renderer"]

FOLDERS = (
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib64",
    "/usr/local/lib",
)
VERSION = re.compile(r"libLLVM(?:-|\.so\.)(\d+)")
OLDEST_LLVM = 17
PROBE_LIMIT_S = 60
PROBE = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
ball = {"type": "scene", "ball": {"type": "sphere"}, "light": {"type": "constant"},
        "path": {"type": "path", "max_depth": 3},
        "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}}}
assert mi.render(mi.load_dict(ball), spp=1).numpy().size
"""


@dataclass(frozen=True)
class Backend:
    """A variant of Mitsuba and, for ``llvm_ad_rgb``, the LLVM library it loads."""

    variant: str
    llvm: str = ""

    @property
    def vectorised(self) -> bool:
        """Whether rays are traced many at a time."""
        return self.variant != "scalar_rgb"


def require_renderer() -> None:
    """Raise ``BackendUnavailable`` where the extra is not installed."""
    require("scene", "mitsuba", "pyoidn", "scipy")


def chosen_backend() -> Backend:
    """Return the first LLVM that renders; without any, the scalar variant."""
    require_renderer()
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    for library in [named] if named else installed_llvms(FOLDERS):
        if _renders(library):
            return Backend("llvm_ad_rgb", library)
    return Backend("scalar_rgb")


def installed_llvms(folders: Iterable[str]) -> list[str]:
    """Return the LLVM libraries in these folders that can work, one a version, newest first."""
    found: dict[int, str] = {}
    for folder in folders:
        for path in sorted(Path(folder).glob("libLLVM*")):
            version = VERSION.search(path.name)
            if version and int(version[1]) >= OLDEST_LLVM:
                found.setdefault(int(version[1]), str(path))
    return [found[version] for version in sorted(found, reverse=True)]


def _renders(library: str) -> bool:
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": library}
    try:
        done = subprocess.run(
            [sys.executable, "-c", PROBE],
            env=environment,
            capture_output=True,
            timeout=PROBE_LIMIT_S,
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def load_mitsuba(backend: Backend, threads: int) -> Any:
    """Import Mitsuba in this process, which can have one backend only; return the module."""
    if backend.llvm:
        os.environ["DRJIT_LIBLLVM_PATH"] = backend.llvm
    with needs("scene"):
        mitsuba = import_module("mitsuba")
    mitsuba.set_variant(backend.variant)
    if backend.vectorised:
        with needs("scene"):
            drjit = import_module("drjit")
        drjit.set_thread_count(threads)
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    return mitsuba
