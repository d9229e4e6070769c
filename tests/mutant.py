"""Pytest plugin: run with one line of the product changed, as ``MUTANT`` says.

``MUTANT`` is JSON: ``[file, before, after]``, the file relative to the repository. The module is
compiled from the changed source on import; no file is written.
"""

import json
import os
from importlib.machinery import SourceFileLoader
from pathlib import Path

FILE, BEFORE, AFTER = json.loads(os.environ["MUTANT"])
PATH = str(Path(__file__).parents[1] / FILE)
get_data, path_stats = SourceFileLoader.get_data, SourceFileLoader.path_stats


def mutated_data(loader: SourceFileLoader, path: str) -> bytes:
    """Return a file's bytes, those of ``FILE`` changed."""
    data = get_data(loader, path)
    if path != PATH:
        return data
    text = data.decode()
    assert text.count(BEFORE) == 1, f"{FILE} has {text.count(BEFORE)} times: {BEFORE}"
    return text.replace(BEFORE, AFTER).encode()


def uncached_stats(loader: SourceFileLoader, path: str) -> object:
    """Keep Python from taking, or making, compiled code of ``FILE``."""
    if path == PATH:
        raise OSError("changed")
    return path_stats(loader, path)


SourceFileLoader.get_data = mutated_data
SourceFileLoader.path_stats = uncached_stats
