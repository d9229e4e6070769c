"""The code of another revision, taken from history, compiled, and kept in ``build/``."""

import io
import shutil
import subprocess
import sys
import tarfile
import tempfile
from contextlib import suppress
from pathlib import Path

__all__ = ["ROOT", "code_of", "git"]

ROOT = Path(__file__).parents[1]


def git(*arguments: str) -> "subprocess.CompletedProcess[bytes]":
    return subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, check=False)


def code_of(commit: str, folder: Path) -> Path:
    """Return a folder with the code of ``commit``, compiled; made in ``folder`` the first time."""
    kept = ROOT / "build" / f"code-{commit[:12]}-{sys.implementation.cache_tag}"
    if not kept.exists():
        made = _compiled(commit, folder)
        kept.parent.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=kept.parent) as beside:
            whole = shutil.copytree(made, Path(beside) / "whole")
            with suppress(OSError):  # another run was faster
                whole.rename(kept)
    return kept


def _compiled(commit: str, folder: Path) -> Path:
    """Return ``folder`` with the code of a commit, compiled."""
    archive = git("archive", "--format=tar", commit)
    assert archive.returncode == 0, archive.stderr.decode()
    with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as tar:
        tar.extractall(folder, filter="data")
    build = folder / "build"
    configure = ["cmake", "-S", folder, "-B", build, "-G", "Ninja", "-DSKBUILD_STATE=editable"]
    launcher = ["-DCMAKE_CXX_COMPILER_LAUNCHER=ccache"] if shutil.which("ccache") else []
    options = [f"-DPython_EXECUTABLE={sys.executable}", "-DRFEDGE_SAMPLES=OFF", *launcher]
    for command in ([*configure, *options], ["ninja", "-C", build, "_native"]):
        done = subprocess.run(list(map(str, command)), capture_output=True, check=False)
        assert done.returncode == 0, (done.stdout + done.stderr).decode()[-4000:]
    (extension,) = build.glob("_native*.so")
    shutil.copy(extension, folder / "rfcore" / "native")
    shutil.rmtree(build)
    return folder
