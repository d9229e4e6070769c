"""What a module lists in ``__all__`` exists."""

import importlib
import pkgutil
from collections.abc import Iterator

import cav_agent
import mec_server
import rfcore
import rfedge

GENERATED = "rfcore.wire.v1"


def modules() -> Iterator[str]:
    for package in (rfcore, cav_agent, mec_server, rfedge):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not found.name.startswith(GENERATED) and not found.name.endswith("._native"):
                yield found.name


def test_what_a_module_lists_exists() -> None:
    wrong = []
    for name in modules():
        module = importlib.import_module(name)
        wrong += [f"{name}.{n}" for n in getattr(module, "__all__", []) if not hasattr(module, n)]
    assert wrong == []
