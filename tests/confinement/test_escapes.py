"""A process that reads what others wrote can leave its sandbox neither as root nor as a user.

Where the tests run as root, the tries of a user are made by user 65534, in a mount namespace where
the interpreter, the packages and the code have places that everybody may read.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from confinement import escapes
from rfcore.confinement import start

ROOT, USER = "root", "user"
TOOK_OVER = set(escapes.TRIES)
FILES = {"write a sysctl", "write a file", "read the key"}

MOUNTED = """
mount --bind "$1" "$4/python" && mount --bind "$2" "$4/code" && mount --bind "$3" "$4/packages" &&
shift 4 && exec "$@"
"""


@pytest.fixture(scope="module")
def place() -> Iterator[Path]:
    """A folder that everybody may read, with the tries, the key and the mount points."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    for name in ("python", "code", "packages", "site-packages"):
        (folder / name).mkdir()
    shutil.copy(str(escapes.__file__), folder / "site-packages" / "escapes.py")
    (folder / "server.key").write_text("secret")
    yield folder
    shutil.rmtree(folder)


def outcomes(place: Path, who: str, confinement: str, stage: str) -> dict[str, str]:
    """Return what each try came to."""
    if who == ROOT and os.geteuid() != 0:
        pytest.skip("needs root")
    script = [str(place / "site-packages" / "escapes.py"), confinement, stage]
    script.append(str(place / "server.key"))
    code, packages = Path(start.__file__).parents[2], Path(np.__path__[0]).parent
    command, paths = [sys.executable], [place / "site-packages", code, packages]
    if os.geteuid() == 0:
        user = ["--reuid=65534", "--regid=65534", "--clear-groups"] if who == USER else []
        mounts = [sys.base_prefix, str(code), str(packages), str(place)]
        python = str(place / "python" / "bin" / Path(sys.executable).resolve().name)
        command = ["unshare", "--mount", "sh", "-ec", MOUNTED, "sh", *mounts]
        command += ["setpriv", *user, python]
        paths = [place / "site-packages", place / "code", place / "packages"]
    ran = subprocess.run(
        [*command, *script],
        env={"PATH": os.environ["PATH"], "PYTHONPATH": ":".join(map(str, paths))},
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr
    return dict(json.loads(ran.stdout))


@pytest.mark.parametrize("who", [ROOT, USER])
@pytest.mark.parametrize(
    "confinement", ["landlock", pytest.param("bubblewrap", marks=pytest.mark.slow)]
)
def test_every_try_to_escape_ends_the_process(place: Path, who: str, confinement: str) -> None:
    came_to = outcomes(place, who, confinement, "confined")
    assert came_to == dict.fromkeys(TOOK_OVER, "SIGSYS")


@pytest.mark.slow
@pytest.mark.parametrize("who", [ROOT, USER])
def test_bubblewrap_alone_refuses_what_the_process_will_give_up_later(
    place: Path, who: str
) -> None:
    came_to = outcomes(place, who, "bubblewrap", "started")
    free_while_starting = {"become root", "fork", "map executable memory"}
    done = {name for name, result in came_to.items() if result == "done"}
    assert done <= (free_while_starting if who == ROOT else {"fork", "map executable memory"})
    assert {came_to[name] for name in FILES} <= {"ENOENT", "EROFS", "EACCES"}
    refused = {came_to[name] for name in TOOK_OVER - FILES - free_while_starting}
    assert refused == {"EPERM"}


@pytest.mark.parametrize("who", [ROOT, USER])
def test_landlock_alone_refuses_files(place: Path, who: str) -> None:
    came_to = outcomes(place, who, "landlock", "landlocked")
    assert {came_to[name] for name in FILES} == {"EACCES"}


def test_without_a_sandbox_the_tries_succeed(place: Path) -> None:
    came_to = outcomes(place, USER, "limits", "started")
    assert {name for name, result in came_to.items() if result == "done"} >= {
        "write a file",
        "read the key",
        "listen on a Unix socket",
        "fork",
        "signal the parent",
        "limit the parent",
        "map executable memory",
    }
    assert came_to["open a socket"] == "ECONNREFUSED"
