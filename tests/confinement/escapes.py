"""Tries to leave a sandbox, each in a process of its own; started by ``test_escapes``.

``python escapes.py CONFINEMENT STAGE KEY`` prints a JSON object with the outcome of each try: an
errno's name, the signal that ended the process, or "done". STAGE is how far a confined process has
come: ``started`` (what surrounds it from outside is there, it has not confined itself yet),
``landlocked`` (Landlock alone, no filter), or ``confined``.
"""

import ctypes
import errno
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from rfcore.confinement.confine import Confinement, ProcessLimits, confine, restrict_files_and_ports
from rfcore.confinement.start import ConfinedProgram

LIBC = ctypes.CDLL(None, use_errno=True)
CLONE_NEWUSER, PTRACE_SEIZE, MS_BIND = 0x10000000, 0x4206, 4096
READ_WRITE_EXECUTE, PRIVATE_ANONYMOUS = 7, 0x22
RLIMIT_NOFILE = 7
PTRACE, KEXEC_LOAD, BPF = (101, 117), (246, 104), (321, 280)
"""Numbers of system calls on x86-64 and on AArch64."""


def check(result: int) -> None:
    if result < 0:
        raise OSError(ctypes.get_errno(), "refused")


def system_call(numbers: tuple[int, int], *arguments: int) -> None:
    number = numbers[os.uname().machine == "aarch64"]
    check(LIBC.syscall(number, *map(ctypes.c_long, arguments)))


def write_file() -> None:
    """Write a file somewhere, in turn."""
    for folder in ("/tmp", "/dev/shm", str(Path(__file__).parent)):
        try:
            Path(folder, "escaped").write_text("out")
            return
        except OSError as error:
            refused = error
    raise refused


def fork() -> None:
    if os.fork() == 0:
        os._exit(0)


def map_executable() -> None:
    address = LIBC.mmap(None, 4096, READ_WRITE_EXECUTE, PRIVATE_ANONYMOUS, -1, 0)
    check(-1 if address == -1 else 0)


def listen_on_unix() -> None:
    socket.socket(socket.AF_UNIX, socket.SOCK_STREAM).bind("\0escaped")


def reach_limits_of_parent() -> None:
    """Read them: who may do that may set them, too."""
    limits = ctypes.create_string_buffer(16)
    check(LIBC.prlimit(os.getppid(), RLIMIT_NOFILE, None, limits))


TRIES: dict[str, Callable[[Path], object]] = {
    "write a sysctl": lambda _: Path("/proc/sys/kernel/core_pattern").open("r+").close(),
    "write a file": lambda _: write_file(),
    "read the key": lambda key: key.read_bytes(),
    "open a socket": lambda _: socket.create_connection(("127.0.0.1", 1)),
    "listen on a Unix socket": lambda _: listen_on_unix(),
    "fork": lambda _: fork(),
    "ptrace the parent": lambda _: system_call(PTRACE, PTRACE_SEIZE, os.getppid(), 0, 0),
    "signal the parent": lambda _: os.kill(os.getppid(), 0),
    "limit the parent": lambda _: reach_limits_of_parent(),
    "mount": lambda _: check(LIBC.mount(b"/", b"/", None, MS_BIND, None)),
    "make a user namespace": lambda _: check(LIBC.unshare(CLONE_NEWUSER)),
    "become root": lambda _: check(LIBC.setresuid(0, 0, 0)),
    "load a kernel": lambda _: system_call(KEXEC_LOAD, 0, 0, 0, 0),
    "load a BPF program": lambda _: system_call(BPF, 0, 0, 0),
    "map executable memory": lambda _: map_executable(),
}


def attempt(confinement: Confinement, stage: str, key: Path, name: str) -> str:
    """Come as far as ``stage``, then try."""
    if stage == "confined":
        confine(confinement, ProcessLimits(address_space_bytes=1 << 30))
    elif stage == "landlocked":
        restrict_files_and_ports()
    try:
        TRIES[name](key)
    except OSError as error:
        return errno.errorcode[error.errno or 0]
    return "done"


def outcome(process: subprocess.Popen[bytes]) -> str:
    printed, errors = process.communicate()
    status = process.returncode
    number = -status if status < 0 else status - 128
    if number > 0:
        return signal.Signals(number).name
    return printed.decode() or errors.decode()


def main() -> None:
    """Be the parent of the tries, or one of them."""
    confinement, stage, key, *name = sys.argv[1:]
    if name:
        sys.stdout.write(attempt(Confinement(confinement), stage, Path(key), name[0]))
        sys.stdout.flush()
        os._exit(0)  # finalizers would make calls that are not allowed
    environment = {"PYTHONPATH": os.environ["PYTHONPATH"], "PYTHONDONTWRITEBYTECODE": "1"}
    program = ConfinedProgram("escapes", Confinement(confinement), environment)
    pipe = subprocess.PIPE
    outcomes = {
        name: outcome(program.start([stage, key, name], (), stdout=pipe, stderr=pipe))
        for name in TRIES
    }
    print(json.dumps(outcomes))


if __name__ == "__main__":
    main()
