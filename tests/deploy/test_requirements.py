"""Every set of packages is pinned with hashes, and names no index."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from scripts import ROOT, loaded

SCRIPT = loaded("deploy/requirements.py")
SETS: tuple[str, ...] = tuple(SCRIPT.SETS)


def wanted(name: str) -> dict[str, Requirement]:
    """Return the requirements of pyproject.toml, by normalised name."""
    lines = [Requirement(line) for line in SCRIPT.requirements(name, ROOT)]
    return {canonicalize_name(requirement.name): requirement for requirement in lines}


def pins(name: str) -> dict[str, str]:
    """Return the version of each package in requirements/NAME.txt."""
    text = (ROOT / f"requirements/{name}.txt").read_text(encoding="utf-8")
    found = re.findall(r"^([A-Za-z0-9._-]+)==([^ ;\\\n]+)", text, flags=re.MULTILINE)
    return {canonicalize_name(package): version for package, version in found}


def test_the_runtime_image_lacks_reports_and_evaluation():
    left_out = set(wanted("full")) - set(wanted("runtime"))
    assert left_out >= SCRIPT.ONLY_FULL
    assert {"scipy", "opencv-contrib-python-headless"} <= left_out
    assert "torch" not in wanted("full")


def test_the_demo_needs_no_extra_but_the_page_that_it_points_to():
    base = {canonicalize_name(name) for name in wanted("demo")}
    assert {"numpy", "matplotlib", "nanobind"} <= base
    assert not {"torch", "scipy", "opencv-contrib-python-headless", "pytest"} & base


def test_only_the_workbench_needs_what_renders_streets_drives_browsers_and_builds_itself():
    workbench = {"mitsuba", "selenium", "hatchling", "editables"}
    assert workbench <= set(wanted("test"))
    for name in ("runtime", "full", "demo"):
        assert not workbench & set(wanted(name))


def test_an_unknown_set_is_refused():
    with pytest.raises(ValueError, match="'both' is none of runtime, full, demo, test"):
        SCRIPT.requirements("both", ROOT)


@pytest.mark.parametrize("name", SETS)
def test_pins_satisfy_pyproject(name):
    pinned = pins(name) | pins("torch")
    for package, requirement in wanted(name).items():
        assert package in pinned, f"{package} is not pinned: run `make lock`"
        assert requirement.specifier.contains(pinned[package]), f"run `make lock`: {requirement}"


@pytest.mark.parametrize("name", SETS)
def test_every_pin_has_a_hash(name):
    text = (ROOT / f"requirements/{name}.txt").read_text(encoding="utf-8")
    blocks = re.split(r"\n(?=\S)", text.strip())
    assert len(blocks) == len(pins(name)) >= len(wanted(name)) - 1
    for block in blocks:
        assert re.search(r"--hash=sha256:[0-9a-f]{64}", block), block


def test_sets_agree_on_versions():
    everything = pins("test")
    for name in SETS:
        assert pins(name).items() <= everything.items()


def test_only_torch_is_without_a_hash_and_it_is_the_pinned_one():
    assert pins("torch") == {"torch": "2.13.0"}
    assert str(wanted("test")["torch"].specifier) == "==2.13.0"
    assert not any("torch" in pins(name) for name in SETS)


def test_no_committed_file_names_a_package_index():
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
    names = [name for name in listed.stdout.decode().split("\0") if name]
    assert len(names) > 100
    index = re.compile(r"(index-url|find-links|TORCH_INDEX)[ =]+['\"]?\w+:/|/simple/?['\"\s]")
    texts = (".py", ".txt", ".toml", ".md", ".sh", ".yml", "Makefile", "Dockerfile", "run", ".cfg")
    for name in names:
        path = ROOT / name
        if path.name.endswith(texts) and path.is_file():
            found = index.search(path.read_text(encoding="utf-8"))
            assert found is None, f"{name}: {found}"


STEPS = (
    *("build-full", "check", "docs", "test", "test-slow"),
    *("test-asan", "fuzz", "test-fault-core", "soak-short"),
)
"""Steps of CI on each push."""


def ledger(tmp_path: Path, makefile: str) -> subprocess.CompletedProcess[str]:
    """Run ``.ci/run`` above a Makefile of the test's own."""
    (tmp_path / ".ci").mkdir()
    shutil.copy(ROOT / ".ci/run", tmp_path / ".ci/run")
    (tmp_path / "Makefile").write_text(makefile)
    return subprocess.run(
        [tmp_path / ".ci/run"], capture_output=True, text=True, check=False, timeout=60
    )


def test_ci_goes_on_after_a_step_that_failed_and_fails(tmp_path):
    others = " ".join(step for step in STEPS if step != "check")
    done = ledger(tmp_path, f"{others}:\n\t@true\ncheck:\n\t@false\n")
    assert re.search(r"^check +\d+\.\d min  FAILED\ndocs +\d+\.\d min  passed$", done.stdout, re.M)
    assert done.returncode == 1


FAILING_TEST = """
check:
\t@mkdir -p .pytest_cache/v/cache
\t@printf '{\\n  "tests/test_a.py::test_b": true\\n}' > .pytest_cache/v/cache/lastfailed
\t@echo "$$PYTEST_ADDOPTS" | grep -q -- --last-failed && %s
"""


@pytest.mark.parametrize(
    ("again", "outcome"), [("true", "passed at the second try"), ("false", "FAILED")]
)
def test_ci_runs_failed_tests_alone_once_more_and_names_them(tmp_path, again, outcome):
    others = " ".join(step for step in STEPS if step != "check")
    done = ledger(tmp_path, f"{others}:\n\t@true\n{FAILING_TEST % again}")
    assert "\nflaky: tests/test_a.py::test_b\n" in done.stdout
    assert re.search(rf"^check +\d+\.\d min  {outcome}$", done.stdout, re.M)
    assert done.returncode == (outcome == "FAILED")


WHEELS = loaded("deploy/wheels.py")


def test_wheels_are_built_for_an_interpreter_that_is_named(tmp_path):
    assert WHEELS.found_pythons([sys.executable]) == {sys.version_info[:2]: sys.executable}
    old = tmp_path / "python3.12"
    old.write_text("#!/bin/sh\necho '3 10 cpython'\n")
    old.chmod(0o755)
    with pytest.raises(SystemExit, match=r"python3\.12 is no CPython from 3\.11 on"):
        WHEELS.found_pythons([str(old)])


def test_interpreters_are_searched_on_the_path(tmp_path, monkeypatch):
    for name, says in (("python3.99", "3 99 cpython"), ("python3.98", "3 98 pypy")):
        (tmp_path / name).write_text(f"#!/bin/sh\necho '{says}'\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("PYENV_ROOT", str(tmp_path))
    assert WHEELS.found_pythons([]) == {(3, 99): str(tmp_path / "python3.99")}


def test_one_wheel_serves_every_version_from_3_12_on():
    tags = [WHEELS.tag_for((3, minor)) for minor in (11, 12, 15)]
    assert tags == ["cp311-cp311", "cp312-abi3", "cp312-abi3"]
