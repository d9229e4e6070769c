"""What every verb of ``rfedge eval`` leaves: a JSON file that says where its figures came from."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import Any

from rfcore.errors import InvalidInput
from rfcore.files import write_whole
from rfedge.provenance import host

__all__ = ["check_result_path", "provenance", "write_result"]


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
