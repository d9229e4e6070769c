"""Print the packages that an installation needs beside rfedge itself, one requirement a line.

``runtime`` and ``full`` are the two images: agent, server, link and the verbs about fields and
certificates; and what trains and evaluates too. ``demo`` is what `make demo` builds and runs with.
``test`` has every extra, the tools of `make test` and `make check`, and what streetgen and the lab
need. The requirements come from the three pyproject.toml; `make lock` pins each set with hashes in
requirements/.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

__all__ = ["ONLY_FULL", "SETS", "requirements"]

ONLY_FULL = frozenset({"matplotlib", "jinja2"})
"""Base dependencies that only reports need: the services and `rfedge link` start without them."""
SETS = {
    "runtime": (("ops", "twin", "nats"), ()),
    "full": (("ops", "eval", "twin", "nats"), ()),
    "demo": (("twin",), ("build",)),
    "test": (None, ("build", "test", "check")),
}
"""Extras (None: all) and dependency groups of each set, beside the base dependencies."""
WORKBENCH = ("streetgen", "lab")
"""Folders of the packages that ``test`` installs as well, each with a pyproject.toml of its own."""
OWN = frozenset({"rfedge", "rfedge-streetgen", "rfedge-lab"})


def requirements(name: str, root: Path) -> list[str]:
    """Return the direct requirements of the set ``name``, sorted.

    ``root`` is the checkout. Raises ``ValueError`` for a set that does not exist.
    """
    if name not in SETS:
        raise ValueError(f"{name!r} is none of {', '.join(SETS)}")
    content = _pyproject(root)
    project, groups = content["project"], content["dependency-groups"]
    extras, tools = SETS[name]
    wanted = {line for line in project["dependencies"] if name != "runtime" or _kept(line)}
    for extra in project["optional-dependencies"] if extras is None else extras:
        wanted.update(project["optional-dependencies"][extra])
    for group in tools:
        wanted.update(_plain(groups[group]))
    if name == "test":
        for folder in WORKBENCH:
            wanted.update(_workbench(_pyproject(root / folder)))
    return sorted(wanted)


def _pyproject(folder: Path) -> dict[str, Any]:
    return tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))


def _workbench(content: dict[str, Any]) -> set[str]:
    """Return what builds a package and what it needs with all its extras, without our own."""
    project = content["project"]
    lines = [*content["build-system"]["requires"], *project["dependencies"]]
    for extra in project.get("optional-dependencies", {}).values():
        lines += extra
    return {line for line in lines if _name(line) not in OWN}


def _plain(group: Iterable[object]) -> list[str]:
    lines = [line for line in group if isinstance(line, str)]
    if len(lines) != len(list(group)):
        raise ValueError("a group that is named here must not include another")
    return lines


def _kept(requirement: str) -> bool:
    return _name(requirement) not in ONLY_FULL


def _name(requirement: str) -> str:
    found = re.match(r"[A-Za-z0-9._-]+", requirement)
    if found is None:
        raise ValueError(f"{requirement!r} is not a requirement")
    return found[0].lower()


if __name__ == "__main__":
    print("\n".join(requirements(sys.argv[1], Path())))
