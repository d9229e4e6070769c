"""Print what an installation needs beside rfedge itself, from pyproject.toml, a requirement a line.

``runtime`` and ``full`` are the two images: agent, server, link and the verbs about fields and
certificates; and what trains and evaluates too. ``demo`` is what `make demo` builds and runs with,
``test`` every extra and the tools of `make test` and `make check`. `make lock` pins each with
hashes in requirements/.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path

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


def requirements(name: str, pyproject: Path) -> list[str]:
    """Return the direct requirements of the set ``name``, sorted; raises ``ValueError``."""
    if name not in SETS:
        raise ValueError(f"{name!r} is none of {', '.join(SETS)}")
    content = tomllib.loads(pyproject.read_text(encoding="utf-8"))
    project, groups = content["project"], content["dependency-groups"]
    extras, tools = SETS[name]
    wanted = {line for line in project["dependencies"] if name != "runtime" or _kept(line)}
    for extra in project["optional-dependencies"] if extras is None else extras:
        wanted.update(project["optional-dependencies"][extra])
    for group in tools:
        wanted.update(_plain(groups[group]))
    return sorted(wanted)


def _plain(group: Iterable[object]) -> list[str]:
    lines = [line for line in group if isinstance(line, str)]
    if len(lines) != len(list(group)):
        raise ValueError("a group that is named here must not include another")
    return lines


def _kept(requirement: str) -> bool:
    found = re.match(r"[A-Za-z0-9._-]+", requirement)
    if found is None:
        raise ValueError(f"{requirement!r} is not a requirement")
    return found[0].lower() not in ONLY_FULL


if __name__ == "__main__":
    print("\n".join(requirements(sys.argv[1], Path("pyproject.toml"))))
