"""Print what an image needs beside rfedge itself, from pyproject.toml, a requirement a line.

``runtime`` runs agent, server, link and the verbs about fields and certificates; ``full`` trains
and evaluates too.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

__all__ = ["ONLY_FULL", "requirements"]

ONLY_FULL = frozenset({"torch", "opencv-contrib-python-headless", "matplotlib", "jinja2"})
"""What nothing that the services import may import (import-linter holds the first three to it)."""


def requirements(image: str, pyproject: Path) -> list[str]:
    """Return the direct requirements of ``image``, runtime or full."""
    project = tomllib.loads(pyproject.read_text())["project"]
    if image not in ("runtime", "full"):
        raise ValueError(f"{image!r} is neither runtime nor full")
    wanted = [*project["dependencies"], *project["optional-dependencies"]["ops"]]
    if image == "full":
        return wanted
    return [line for line in wanted if _name(line) not in ONLY_FULL]


def _name(requirement: str) -> str:
    found = re.match(r"[A-Za-z0-9._-]+", requirement)
    if found is None:
        raise ValueError(f"{requirement!r} is not a requirement")
    return found[0].lower()


if __name__ == "__main__":
    print("\n".join(requirements(sys.argv[1], Path("pyproject.toml"))))
