"""The command line that puts a decoder process into a sandbox of bubblewrap.

In it there is no network, no other process, and no file but Python's and this project's code, all
read-only: no key, no field, no recording. <https://github.com/containers/bubblewrap>
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

import mec_server
import rfcore
from rfcore.errors import BackendUnavailable

__all__ = ["bubblewrap_command"]

SYSTEM = ("/usr", "/lib", "/lib64", "/bin", "/etc/ld.so.cache")


def bubblewrap_command(environment: Mapping[str, str]) -> list[str]:
    """Return what to put before a command; raise ``BackendUnavailable`` without bubblewrap."""
    program = shutil.which("bwrap")
    if program is None:
        raise BackendUnavailable(
            "decoder: bwrap is not on PATH; install bubblewrap, or give --decoder child"
        )
    command = [program, "--unshare-all", "--die-with-parent", "--new-session", "--clearenv"]
    for name, value in environment.items():
        command += ["--setenv", name, value]
    for path in _readable():
        command += ["--ro-bind", path, path]
    return [*command, "--proc", "/proc", "--dev", "/dev", "--remount-ro", "/", "--"]


def _readable() -> Iterable[str]:
    """Return the folders that running our code takes, each before what lies in it."""
    installed = [path for path in sys.path if path.endswith(("site-packages", "dist-packages"))]
    own = [path for package in (rfcore, mec_server) for path in package.__path__]
    found = {*SYSTEM, sys.prefix, sys.base_prefix, *installed, *own}
    return sorted(path for path in found if Path(path).exists())
