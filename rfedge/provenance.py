"""Where a figure came from: the revision and the host it was taken on."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path
from typing import Any

__all__ = ["host", "revision"]

CHECKOUT = Path(__file__).parents[1]
CODE = (".", ":!results", ":!docs")
"""What decides about a figure, as git pathspecs."""


def revision(checkout: Path = CHECKOUT) -> str:
    """Return the checkout's commit, with ``-dirty`` if it has changes; ``unknown`` outside one.

    Results and the pages made of them do not count: figures are taken one after another.
    """
    try:
        commit = _git(checkout, "describe", "--always", "--abbrev=12")
        changed = _git(checkout, "status", "--porcelain", "--untracked-files=no", "--", *CODE)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{commit}-dirty" if changed else commit


def _git(checkout: Path, *arguments: str) -> str:
    command = ["git", "-C", str(checkout), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def host() -> dict[str, Any]:
    """Return CPU model, core count, best instruction set, Python and operating system."""
    from rfcore.raster.native import available_isas

    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)),
        "isa": available_isas()[0],
        "python": platform.python_version(),
        "os": platform.platform(),
    }


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.machine()
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()
