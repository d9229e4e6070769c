"""Start a module of ours as a confined process: in a sandbox of bubblewrap, or to confine itself.

In a sandbox there is no network, no other process, no /proc and no /dev, and no file but Python's
and this project's code, all read-only: no key, no field, no recording. No capability is left, no
user namespace can be made in it, and its system calls are filtered from the first instruction on.
<https://github.com/containers/bubblewrap>
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from rfcore.confinement.confine import WHILE_STARTING, Confinement, Refusal, assembled
from rfcore.errors import BackendUnavailable

SYSTEM = ("/usr", "/lib", "/lib64", "/bin", "/etc/ld.so.cache")
"""Parts of the system that programs need; a sandbox has them read-only."""

NAMESPACES = (
    *("--unshare-ipc", "--unshare-pid", "--unshare-net", "--unshare-uts", "--unshare-cgroup-try"),
    *("--die-with-parent", "--new-session", "--clearenv", "--cap-drop", "ALL"),
)
AS_USER = ("--unshare-user", "--disable-userns", "--assert-userns-disabled")
AS_ROOT = ("--cap-add", "CAP_SETUID", "--cap-add", "CAP_SETGID")
"""A user namespace of root's maps root to root, which /proc/sys and the like take for root. Outside
of one the program becomes nobody (``confine``) and loses these two capabilities with that; making
user namespaces is refused by the filter."""

Descriptors = Sequence[int]
BEST_FIRST = (Confinement.BUBBLEWRAP, Confinement.LANDLOCK)
READY = b"."
"""The first byte that a reader writes: it is confined."""


def check_not_root(as_root: bool) -> None:
    """Raise ``BackendUnavailable`` for root, unless told that this is meant."""
    if os.geteuid() == 0 and not as_root:
        raise BackendUnavailable(
            "sandbox: this runs as root, whom a sandbox holds less surely; run it as another "
            "user, or give --sandbox-as-root"
        )


def bubblewrap_command(environment: Mapping[str, str], filter_fd: int) -> list[str]:
    """Return the command line that runs a command in a sandbox, to be put before it.

    ``filter_fd`` is an open file with the filter of system calls, to be inherited. Raises
    ``BackendUnavailable`` without bubblewrap.
    """
    program = shutil.which("bwrap")
    if program is None:
        raise BackendUnavailable(
            "bwrap is not on PATH; install bubblewrap, or choose Landlock (--decoder landlock)"
        )
    user = AS_ROOT if os.geteuid() == 0 else AS_USER
    command = [program, *NAMESPACES, *user, "--add-seccomp-fd", str(filter_fd)]
    for name, value in environment.items():
        command += ["--setenv", name, value]
    for path in _readable():
        command += ["--ro-bind", path, path]
    return [*command, "--remount-ro", "/", "--"]


def _readable() -> Iterable[str]:
    """Return the folders that our code is run from, each before those inside it."""
    installed = [path for path in sys.path if path.endswith(("site-packages", "dist-packages"))]
    packages = Path(__file__).parents[2]  # of an editable installation: the checkout
    own = [str(packages / name) for name in ("rfcore", "mec_server", "rfedge")]
    found = {*SYSTEM, sys.prefix, sys.base_prefix, *installed, *own}
    return sorted(path for path in found if Path(path).exists())


@dataclass(frozen=True)
class ConfinedProgram:
    """A module of ours that calls ``confine`` with its first argument."""

    module: str
    confinement: Confinement
    environment: Mapping[str, str]

    def start(
        self,
        arguments: Sequence[str],
        descriptors: Descriptors,
        stdout: int | IO[bytes] = subprocess.DEVNULL,
        stderr: int | IO[bytes] = subprocess.DEVNULL,
    ) -> subprocess.Popen[bytes]:
        """Start it; ``descriptors`` keep their numbers in the process.

        Call it on a thread that outlives the process: bubblewrap ends with the thread that started
        it. Raises ``BackendUnavailable``.
        """
        python = [sys.executable, "-P", "-m", self.module, str(self.confinement), *arguments]
        if self.confinement is not Confinement.BUBBLEWRAP:
            return self._popen(python, descriptors, stdout, stderr)
        filter_fd = os.memfd_create("seccomp", os.MFD_CLOEXEC)
        try:
            os.write(filter_fd, assembled(WHILE_STARTING, Refusal.EPERM))
            os.lseek(filter_fd, 0, os.SEEK_SET)
            command = [*bubblewrap_command(self.environment, filter_fd), *python]
            return self._popen(command, [*descriptors, filter_fd], stdout, stderr)
        finally:
            os.close(filter_fd)

    def _popen(
        self,
        command: Sequence[str],
        descriptors: Descriptors,
        stdout: int | IO[bytes],
        stderr: int | IO[bytes],
    ) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            command,
            pass_fds=descriptors,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=stderr,
        )


def confined_reader(
    module: str,
    arguments: Sequence[str],
    descriptors: Descriptors,
    best_first: Sequence[Confinement] = BEST_FIRST,
) -> tuple[subprocess.Popen[bytes], Confinement]:
    """Start a module that reads open files and answers on its standard output, after ``READY``.

    The first of ``best_first`` that works here is used, and returned. Raises
    ``BackendUnavailable``, which says why each did not.
    """
    problems = []
    for confinement in best_first:
        environment = {"OPENBLAS_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
        if "PYTHONPATH" in os.environ:
            environment["PYTHONPATH"] = os.environ["PYTHONPATH"]
        program = ConfinedProgram(module, confinement, environment)
        try:
            process = program.start(arguments, descriptors, subprocess.PIPE, subprocess.PIPE)
        except BackendUnavailable as error:
            problems.append(str(error))
            continue
        assert process.stdout is not None
        assert process.stderr is not None
        if process.stdout.read(1) == READY:
            process.stderr.close()
            return process, confinement
        _, errors = process.communicate()
        problems.append((errors.decode(errors="replace").splitlines() or ["ended"])[-1][:200])
    raise BackendUnavailable("; ".join(problems))
