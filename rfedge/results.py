"""Where a figure came from: the revision and the host it was taken on.

What every verb of ``rfedge eval`` leaves: a JSON file that says where its figures came from.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

from rfcore.errors import InvalidInput
from rfcore.files import write_whole

__all__ = ["check_result_path", "host", "provenance", "revision", "write_result"]


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
    from rfcore.native.backend import available_isas

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


def check_result_path(out: Path) -> None:
    """Raise ``InvalidInput`` unless ``out`` names a JSON file."""
    if out.suffix != ".json":
        raise InvalidInput("out", f"{out} must end in .json")


def provenance(revision: str) -> dict[str, Any]:
    """Return the command that runs, the host it runs on, and the code's ``revision``."""
    return {
        "command": shlex.join(["rfedge", *sys.argv[1:]]),
        "host": host(),
        "revision": revision,
    }


def write_result(out: Path, result: dict[str, Any]) -> None:
    """Write a result whole, with the folder it belongs in."""
    out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(out, json.dumps(result, indent=1) + "\n")
