"""Every module says what it offers, and offers what it says."""

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


def test_every_module_with_functions_or_classes_lists_them() -> None:
    unlisted = []
    for name in modules():
        module = importlib.import_module(name)
        own = [
            n
            for n, value in vars(module).items()
            if not n.startswith("_")
            and callable(value)
            and getattr(value, "__module__", None) == name
        ]
        if own and not hasattr(module, "__all__"):
            unlisted.append(name)
    assert unlisted == []
