"""Run pytest with the extension of another build: ``sanitized.py FOLDER [PYTEST OPTION ...]``.

Used by `make test-asan` with the one compiled under sanitizers; it ends at the first report.
"""

import importlib.util
import sys
from pathlib import Path

import pytest


def main() -> int:
    """Put the extension in its place, then run the tests."""
    (path,) = Path(sys.argv[1]).glob("_native*.so")
    spec = importlib.util.spec_from_file_location("rfcore.native._native", path)
    extension = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = extension
    spec.loader.exec_module(extension)
    import rfcore.native

    rfcore.native._native = extension
    return pytest.main(sys.argv[2:])


if __name__ == "__main__":
    sys.path.insert(0, str(Path.cwd()))
    sys.exit(main())
