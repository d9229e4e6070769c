"""Choose the variant of Mitsuba: CUDA on an NVIDIA GPU, else LLVM, else the slow scalar one.

CUDA's variant needs nothing but the driver with its OptiX. A variant that does not work may abort
the process that tries it, so each is tried in a process of its own.

``DRJIT_LIBLLVM_PATH`` tells Mitsuba which LLVM to load, and the wrong one ends the process. Of
Debian's versions 14 is refused, 15 and 16 abort in code generation ("Cannot select", Mitsuba
3.9.1), and 19 works. So versions below ``OLDEST_LLVM`` are passed over, and newer ones are tried
newest first.
"""

from __future__ import annotations

import ctypes
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from rfcore.errors import BackendUnavailable

Variant = Literal["auto", "cuda", "llvm", "scalar"]
"""Names of the variants; auto is the first of the others that works."""

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
import sys
import mitsuba as mi
mi.set_variant(sys.argv[1])
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
        """True if many rays are traced at a time."""
        return self.variant != "scalar_rgb"


def chosen_backend(variant: Variant = "auto") -> Backend:
    """Return the first backend that renders of those that the variant permits.

    Raises ``BackendUnavailable`` where the variant named does not work here.
    """
    for backend in _candidates(variant):
        if _renders(backend):
            return backend
    if variant in MISSING:
        raise BackendUnavailable(MISSING[variant])
    return Backend("scalar_rgb")


CUDA = Backend("cuda_ad_rgb")
MISSING = {
    "cuda": "Mitsuba cannot render by CUDA here: it needs an NVIDIA GPU and a driver with OptiX "
    "(libcuda.so.1 and libnvoptix.so.1); --renderer auto takes what works",
    "llvm": f"Mitsuba can load no LLVM here: {OLDEST_LLVM} or newer (19 is known to work) belongs "
    "into a folder of libraries, or DRJIT_LIBLLVM_PATH names it",
}


def _candidates(variant: Variant) -> Iterator[Backend]:
    """Yield what may be tried, best first; the scalar variant needs no trial."""
    if variant in ("auto", "cuda") and _has_cuda():
        yield CUDA
    if variant in ("auto", "llvm"):
        named = os.environ.get("DRJIT_LIBLLVM_PATH")
        for library in [named] if named else installed_llvms(FOLDERS):
            yield Backend("llvm_ad_rgb", library)


def _has_cuda() -> bool:
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True


def installed_llvms(folders: Iterable[str]) -> list[str]:
    """Return the LLVM libraries in these folders that can work, one a version, newest first."""
    found: dict[int, str] = {}
    for folder in folders:
        for path in sorted(Path(folder).glob("libLLVM*")):
            version = VERSION.search(path.name)
            if version and int(version[1]) >= OLDEST_LLVM:
                found.setdefault(int(version[1]), str(path))
    return [found[version] for version in sorted(found, reverse=True)]


def _renders(backend: Backend) -> bool:
    environment = {**os.environ, **({"DRJIT_LIBLLVM_PATH": backend.llvm} if backend.llvm else {})}
    try:
        done = subprocess.run(
            [sys.executable, "-c", PROBE, backend.variant],
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
    mitsuba = import_module("mitsuba")
    mitsuba.set_variant(backend.variant)
    if backend.vectorised:
        import_module("drjit").set_thread_count(threads)
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    return mitsuba
