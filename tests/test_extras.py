"""Packages of extras: guarded wherever they are imported, named by every verb that lacks one."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib.metadata import distribution, packages_distributions
from pathlib import Path

import pytest

from rfcore.errors import BackendUnavailable
from rfcore.extras import needs, require

ROOT = Path(__file__).parents[1]
PACKAGES = ("rfcore", "cav_agent", "mec_server", "rfedge")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]


def name_of(requirement: str) -> str:
    """The normalised name of a distribution: ``Foo_bar>=1; extra == "x"`` is ``foo-bar``."""
    found = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert found is not None, requirement
    return re.sub(r"[-_.]+", "-", found[0]).lower()


@cache
def installed() -> dict[str, set[str]]:
    """The distributions of each package; made once: it reads a list of every installed file."""
    return {
        package: {name_of(name) for name in names}
        for package, names in packages_distributions().items()
    }


def distributions_of(package: str) -> set[str]:
    return installed().get(package, set())


@cache
def brought_by(extra: str) -> set[str]:
    """The distributions an extra lists, and what these require themselves, one step."""
    listed = {name_of(line) for line in EXTRAS[extra]}
    return listed | {
        name_of(line)
        for name in listed
        for line in distribution(name).requires or []
        if "extra ==" not in line
    }


BASE = {name_of(line) for line in PROJECT["dependencies"]}


class Imports(ast.NodeVisitor):
    """Collects (package, line, extra of the guard around it or "") of a module's imports."""

    def __init__(self) -> None:
        self.found: list[tuple[str, int, str]] = []
        self._extra = ""

    def visit_With(self, node: ast.With) -> None:
        guards = [_guard(item.context_expr) for item in node.items]
        outer, self._extra = self._extra, next(filter(None, guards), self._extra)
        self.generic_visit(node)
        self._extra = outer

    def visit_If(self, node: ast.If) -> None:
        if ast.unparse(node.test) != "TYPE_CHECKING":
            self.generic_visit(node)

    def visit_Import(self, node: ast.Import) -> None:
        for alias in node.names:
            self._add(alias.name, node.lineno)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        if node.level == 0 and node.module is not None:
            self._add(node.module, node.lineno)

    def visit_Call(self, node: ast.Call) -> None:
        called = ast.unparse(node.func).split(".")[-1]
        names = [a.value for a in node.args if isinstance(a, ast.Constant)]
        if called in ("import_module", "__import__") and names:
            self._add(str(names[0]), node.lineno)
        if called == "require" and names:
            self.found += [(str(name), node.lineno, str(names[0])) for name in names[1:]]
        self.generic_visit(node)

    def _add(self, module: str, line: int) -> None:
        package = module.split(".")[0]
        if package not in sys.stdlib_module_names:
            self.found.append((package, line, self._extra))


def _guard(expression: ast.expr) -> str:
    if isinstance(expression, ast.Call) and ast.unparse(expression.func) == "needs":
        (extra,) = expression.args
        assert isinstance(extra, ast.Constant), ast.unparse(expression)
        return str(extra.value)
    return ""


def imports_of(source: str) -> list[tuple[str, int, str]]:
    imports = Imports()
    imports.visit(ast.parse(source))
    return imports.found


def problem_of(package: str, extra: str) -> str | None:
    """Return the error of importing ``package`` under the guard of ``extra`` ("": under none)."""
    if package in PACKAGES:
        return "is ours: keep it out of the guard" if extra else None
    if extra and extra not in EXTRAS:
        return f"is guarded by an extra {extra!r} that pyproject.toml does not have"
    if extra:
        listed = distributions_of(package) & brought_by(extra)
        return None if listed else f"is not brought by the extra {extra}"
    return None if distributions_of(package) & BASE else "is no base dependency and not guarded"


def sources() -> Iterator[Path]:
    for package in PACKAGES:
        yield from sorted((ROOT / package).rglob("*.py"))


def test_every_import_is_a_base_dependency_or_guarded_by_its_extra():
    wrong, guarded = [], set()
    for path in sources():
        for package, line, extra in imports_of(path.read_text(encoding="utf-8")):
            problem = problem_of(package, extra)
            if problem is not None:
                wrong.append(f"{path.relative_to(ROOT)}:{line}: {package} {problem}")
            elif extra:
                guarded.add(extra)
    assert wrong == []
    assert guarded == set(EXTRAS), "every extra is there because something imports it"


@pytest.mark.parametrize(
    ("source", "wrong"),
    [
        ("import numpy, grpc, google.protobuf", []),
        ("import torch", ["torch"]),
        ("def run():\n    from scipy.stats import binomtest", ["scipy"]),
        ("with needs('eval'):\n    from scipy.stats import binomtest", []),
        ("with needs('colmap'):\n    import scipy", ["scipy"]),
        ("with needs('ewal'):\n    import scipy", ["scipy"]),
        ("with needs('eval'):\n    import rfcore.views", ["rfcore"]),
        ("from importlib import import_module\nimport_module('mitsuba')", ["mitsuba"]),
        ("with needs('twin'):\n    import yarl", []),
        ("require('eval', 'scipy', 'torch')", ["torch"]),
        ("if TYPE_CHECKING:\n    import torch", []),
    ],
)
def test_the_search_sees_an_import_that_is_wrong(source, wrong):
    found = [package for package, _, extra in imports_of(source) if problem_of(package, extra)]
    assert found == wrong


def test_a_package_that_is_missing_or_broken_is_named_with_its_extra(monkeypatch, tmp_path):
    (tmp_path / "broken_package.py").write_text("raise ImportError('no libGL.so.1')")
    monkeypatch.syspath_prepend(tmp_path)
    for module in ("scipy", "scipy.stats"):  # another test may have loaded it
        monkeypatch.setitem(sys.modules, module, None)
    with (
        pytest.raises(
            BackendUnavailable, match=r"^scipy is missing: pip install 'rfedge\[eval\]'$"
        ),
        needs("eval"),
    ):
        from scipy.stats import binomtest  # noqa: F401
    with (
        pytest.raises(BackendUnavailable, match=r"cannot be loaded \(no libGL.so.1\): pip install"),
        needs("eval"),
    ):
        import broken_package  # noqa: F401
    with pytest.raises(BackendUnavailable, match=r"^scipy is missing: .*\[eval\]'$"):
        require("eval", "numpy", "scipy")


WITHOUT = """
import sys

class Hiding:
    # A finder that does not see some packages.
    def __init__(self, finder):
        self._finder = finder
    def find_spec(self, name, *where):
        hidden = name.partition(".")[0] in HIDDEN
        return None if hidden else self._finder.find_spec(name, *where)
    def __getattr__(self, name):
        return getattr(self._finder, name)

HIDDEN = sys.argv.pop(1).split(",")
sys.meta_path[:] = map(Hiding, sys.meta_path)
"""
VERB = """
from rfedge.cli import main
sys.exit(main())
"""


def run_hiding(
    packages: str, code: str, folder: Path, *arguments: str
) -> subprocess.CompletedProcess[str]:
    """Run Python code in ``folder``, in a process that does not find ``packages`` ("a,b")."""
    command = [sys.executable, "-c", WITHOUT + code, packages, *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=110)


FIELD = ROOT / "samples/fields/street.rff"
DRIVE = f"empty@10={ROOT / 'samples/street/transforms_drive_empty.json'}"


@pytest.mark.parametrize(
    ("package", "extra", "command"),
    [
        ("pyopencl", "opencl", f"render {FIELD} --out made --renderer opencl"),
        ("scipy", "eval", f"eval compare {FIELD} {DRIVE}"),
        ("scipy", "eval", f"eval never-worse {FIELD} {DRIVE}"),
        ("cv2", "localise", f"localise {DRIVE.partition('=')[2]} --field {FIELD}"),
        ("asn1tools", "v2x", f"watch 127.0.0.1:1 --cpm made.jsonl --field {FIELD}"),
        ("nats", "nats", "watch --nats nats://127.0.0.1:4222"),
        ("psutil", "loadtest", "loadtest"),
        ("h2", "loadtest", "loadtest"),
        ("cryptography", "ops", "certs init --vehicles car-1"),
        ("cryptography", "ops", "certs show"),
        ("pycolmap", "colmap", f"dataset poses {ROOT}/samples/street/train --out made"),
        ("carla", "carla", "dataset record-carla --out made"),
    ],
)
def test_a_verb_says_in_one_line_which_extra_it_needs(package, extra, command, tmp_path):
    done = run_hiding(package, VERB, tmp_path, *command.split())
    assert done.stderr == f"rfedge: {package} is missing: pip install 'rfedge[{extra}]'\n"
    assert done.returncode == 2
    assert list(tmp_path.iterdir()) == [], "nothing was begun"


@pytest.mark.slow
def test_services_demo_and_training_import_no_package_of_an_extra(tmp_path):
    modules = [
        *("cav_agent.__main__", "mec_server.__main__", "mec_server.decoding.process"),
        *(
            "rfedge.demo.run",
            "rfedge.demo.report",
            "rfedge.demo.field",
            "rfedge.training.report",
        ),
        *("rfedge.training.run", "rfedge.training.views", "rfedge.offline", "rfedge.link.proxy"),
    ]
    listed = {name_of(line) for lines in EXTRAS.values() for line in lines}
    blocked = [package for package, names in installed().items() if names & listed]
    assert {"torch", "cv2", "scipy", "psutil"} <= set(blocked)
    done = run_hiding(",".join(blocked), f"import {', '.join(modules)}", tmp_path)
    assert done.stderr == ""
    assert done.returncode == 0
