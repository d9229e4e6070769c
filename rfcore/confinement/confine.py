"""Confine this process, before it reads the first byte that somebody else wrote.

With Landlock (landlock(7)) a process gives up every right to files and ports, without being root,
also where user namespaces are refused, as under Docker's default profile.

A filter of system calls (seccomp) lists what is allowed. It is a classic BPF program over ``struct
seccomp_data`` (system call number, architecture, six arguments) that is run before each call;
seccomp(2). It is assembled here and not by libseccomp, so that a machine without that library is
not one without a filter; the tests compare numbers and verdicts with libseccomp's.

``WHILE_STARTING`` is what an interpreter needs to start, to load what it will use, and to fork;
``WHILE_READING`` is what is left when it reads the first byte of a foreign file: memory that is
not executable, the descriptors it was given, clocks. Then it can open no path, start no process or
thread, make no socket or namespace, and send no signal to others.
"""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum, StrEnum

from rfcore.errors import BackendUnavailable

# name: number on x86_64 (asm/unistd_64.h), number on aarch64 (asm-generic/unistd.h).
NUMBERS: dict[str, tuple[int | None, int | None]] = {
    "access": (21, None),
    "arch_prctl": (158, None),
    "brk": (12, 214),
    "clock_gettime": (228, 113),
    "clone": (56, 220),
    "close": (3, 57),
    "dup": (32, 23),
    "dup2": (33, None),
    "dup3": (292, 24),
    "execve": (59, 221),
    "exit": (60, 93),
    "exit_group": (231, 94),
    "faccessat": (269, 48),
    "faccessat2": (439, 439),
    "fcntl": (72, 25),
    "fstat": (5, 80),
    "futex": (202, 98),
    "getcpu": (309, 168),
    "getcwd": (79, 17),
    "getdents64": (217, 61),
    "getegid": (108, 177),
    "geteuid": (107, 175),
    "getgid": (104, 176),
    "getpeername": (52, 205),
    "getpid": (39, 172),
    "getrandom": (318, 278),
    "getrusage": (98, 165),
    "getsockname": (51, 204),
    "getsockopt": (55, 209),
    "gettid": (186, 178),
    "getuid": (102, 174),
    "ioctl": (16, 29),
    "landlock_create_ruleset": (444, 444),
    "landlock_restrict_self": (446, 446),
    "lseek": (8, 62),
    "lstat": (6, None),
    "madvise": (28, 233),
    "mmap": (9, 222),
    "mprotect": (10, 226),
    "mremap": (25, 216),
    "munmap": (11, 215),
    "newfstatat": (262, 79),
    "open": (2, None),
    "openat": (257, 56),
    "pidfd_open": (434, 434),
    "prctl": (157, 167),
    "pread64": (17, 67),
    "prlimit64": (302, 261),
    "read": (0, 63),
    "readlink": (89, None),
    "readlinkat": (267, 78),
    "recvfrom": (45, 207),
    "recvmsg": (47, 212),
    "restart_syscall": (219, 128),
    "rseq": (334, 293),
    "rt_sigaction": (13, 134),
    "rt_sigprocmask": (14, 135),
    "rt_sigreturn": (15, 139),
    "sched_getaffinity": (204, 123),
    "sched_yield": (24, 124),
    "seccomp": (317, 277),
    "sendmsg": (46, 211),
    "sendto": (44, 206),
    "set_robust_list": (273, 99),
    "set_tid_address": (218, 96),
    "setgroups": (116, 159),
    "setresgid": (119, 149),
    "setresuid": (117, 147),
    "sigaltstack": (131, 132),
    "stat": (4, None),
    "statx": (332, 291),
    "sysinfo": (99, 179),
    "tgkill": (234, 131),
    "uname": (63, 160),
    "wait4": (61, 260),
    "write": (1, 64),
}

MACHINES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
"""AUDIT_ARCH of each, in the order of the columns above."""
X32_BIT = 0x40000000
"""Numbers from here on are another table of x86_64's, and never allowed."""

PROT_EXEC = 4
PR_SET_PDEATHSIG, PR_SET_NAME, PR_SET_SECCOMP = 1, 15, 22
PR_SET_NO_NEW_PRIVS, PR_SET_VMA = 38, 0x53564D41
FORK = 0x01200011
"""Flags of ``clone`` for fork(2): CLONE_CHILD_SETTID, CLONE_CHILD_CLEARTID and SIGCHLD; a new
process that shares nothing, and no namespace."""
TCGETS, TIOCGWINSZ, FIOCLEX, FIONBIO = 0x5401, 0x5413, 0x5451, 0x5421


@dataclass(frozen=True)
class Allowed:
    """A system call that is allowed, always or where ``argument & mask`` is one of ``values``.

    Only the low 32 bits of an argument are compared: all those used here are ints.
    """

    call: str
    argument: int = 0
    mask: int = 0
    values: tuple[int, ...] = ()


class Refusal(Enum):
    """Consequence of a call that is not allowed: it fails with EPERM, or ends the process."""

    EPERM = 0x00050000 | 1
    KILL_PROCESS = 0x80000000


def _all(names: str) -> tuple[Allowed, ...]:
    return tuple(map(Allowed, names.split()))


WHILE_READING: tuple[Allowed, ...] = (
    *_all("brk munmap mremap madvise"),
    Allowed("mmap", 2, PROT_EXEC, (0,)),
    Allowed("mprotect", 2, PROT_EXEC, (0,)),
    *_all("read write lseek fstat close sendto recvfrom"),
    *_all("clock_gettime getrandom getrusage getpid gettid getcpu sched_yield sched_getaffinity"),
    *_all("futex restart_syscall rt_sigaction rt_sigprocmask rt_sigreturn sigaltstack"),
    Allowed("prlimit64", 0, 0xFFFFFFFF, (0,)),  # of this process alone
    *_all("exit exit_group"),
)

WHILE_STARTING: tuple[Allowed, ...] = (
    *(rule for rule in WHILE_READING if rule.call not in ("mmap", "mprotect")),
    *_all("mmap mprotect execve arch_prctl set_tid_address set_robust_list rseq"),
    *_all("open openat stat lstat newfstatat statx access faccessat faccessat2 pread64"),
    *_all("readlink readlinkat getdents64 getcwd fcntl dup uname sysinfo wait4"),
    *_all("getuid geteuid getgid getegid getsockopt getsockname getpeername"),
    *_all("setgroups setresgid setresuid seccomp landlock_create_ruleset landlock_restrict_self"),
    Allowed("ioctl", 1, 0xFFFFFFFF, (TCGETS, TIOCGWINSZ, FIOCLEX, FIONBIO)),
    Allowed(
        "prctl",
        0,
        0xFFFFFFFF,
        (PR_SET_PDEATHSIG, PR_SET_NAME, PR_SET_SECCOMP, PR_SET_NO_NEW_PRIVS, PR_SET_VMA),
    ),
    Allowed("clone", 0, 0xFFFFFFFF, (FORK,)),
    *_all("dup2 dup3 pidfd_open recvmsg sendmsg"),
)

LOAD, EQUAL, AT_LEAST, AND, RETURN = 0x20, 0x15, 0x35, 0x54, 0x06
ALLOW = 0x7FFF0000
NUMBER_AT, MACHINE_AT, ARGUMENTS_AT = 0, 4, 16
INSTRUCTION = struct.Struct("=HBBI")


def machine_column(machine: str) -> int:
    """Return the column of ``NUMBERS`` for ``machine``; raise ``BackendUnavailable``."""
    if machine not in MACHINES:
        raise BackendUnavailable(
            f"seccomp: no filter for {machine}, only for {', '.join(MACHINES)}; "
            "decode without a sandbox only if you trust every sender"
        )
    return list(MACHINES).index(machine)


def assembled(allowed: Iterable[Allowed], refusal: Refusal, machine: str | None = None) -> bytes:
    """Return the BPF program that allows ``allowed`` and answers all else with ``refusal``.

    ``machine`` is this one's unless named. Raises ``BackendUnavailable`` for one without a table.
    """
    machine = machine if machine is not None else platform.machine()
    column = machine_column(machine)
    code = [
        (LOAD, 0, 0, MACHINE_AT),
        (EQUAL, 1, 0, MACHINES[machine]),
        (RETURN, 0, 0, Refusal.KILL_PROCESS.value),
        (LOAD, 0, 0, NUMBER_AT),
        (AT_LEAST, 0, 1, X32_BIT),
        (RETURN, 0, 0, refusal.value),
    ]
    for rule in allowed:
        number = NUMBERS[rule.call][column]
        if number is not None:
            code += _rule(rule, number, refusal)
    code.append((RETURN, 0, 0, refusal.value))
    return b"".join(INSTRUCTION.pack(*line) for line in code)


def _rule(rule: Allowed, number: int, refusal: Refusal) -> list[tuple[int, int, int, int]]:
    """Return the lines that decide about one call; any other passes them with its number kept."""
    verdict = [(RETURN, 0, 0, ALLOW)]
    if rule.values:
        tests = [
            line for value in rule.values for line in ((EQUAL, 0, 1, value), (RETURN, 0, 0, ALLOW))
        ]
        load = [(LOAD, 0, 0, ARGUMENTS_AT + 8 * rule.argument), (AND, 0, 0, rule.mask)]
        verdict = [*load, *tests, (RETURN, 0, 0, refusal.value)]
    return [(EQUAL, 0, len(verdict), number), *verdict]


class _Program(ctypes.Structure):
    """``struct sock_fprog``."""

    _fields_ = (("length", ctypes.c_ushort), ("code", ctypes.c_char_p))


SECCOMP_SET_MODE_FILTER, SECCOMP_FILTER_FLAG_TSYNC = 1, 1


def apply_filter(program: bytes) -> None:
    """Filter every further system call of this process, in all of its threads, for good.

    Raises ``BackendUnavailable`` where the kernel does not permit it.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    fprog = _Program(len(program) // INSTRUCTION.size, program)
    number = NUMBERS["seccomp"][machine_column(platform.machine())]
    refused = libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) or libc.syscall(
        number, SECCOMP_SET_MODE_FILTER, SECCOMP_FILTER_FLAG_TSYNC, ctypes.byref(fprog)
    )
    if refused:
        raise BackendUnavailable(f"seccomp: {os.strerror(ctypes.get_errno())}")


CREATE_RULESET, RESTRICT_SELF = 444, 446
"""System call numbers, the same on every machine."""
ASK_VERSION = 1
FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 5: 16}
"""Kinds of file access that each version of the interface knows, from the first of these on."""
PORTS_SINCE, SCOPES_SINCE = 4, 6
PORT_RIGHTS = 0b11
"""Bind and connect, TCP."""
SCOPES = 0b11
"""Abstract Unix sockets of others, and signals to them."""


class _Ruleset(ctypes.Structure):
    """``struct landlock_ruleset_attr``: what is refused unless a rule permits it; there is none."""

    _fields_ = (
        ("files", ctypes.c_uint64),
        ("ports", ctypes.c_uint64),
        ("scopes", ctypes.c_uint64),
    )


def landlock_version() -> int:
    """Return the version of the kernel's interface; 0 if it has none."""
    return max(0, int(_libc().syscall(CREATE_RULESET, None, ctypes.c_size_t(0), ASK_VERSION)))


def restrict_files_and_ports() -> None:
    """Give up opening any file and port for good; open descriptors are kept.

    Acts on the calling thread and those it starts. Raises ``BackendUnavailable`` for a kernel
    without Landlock (before 5.13, or switched off).
    """
    version = landlock_version()
    if not version:
        raise BackendUnavailable(
            "Landlock: this kernel has none (it needs 5.13 and 'landlock' among its lsm=)"
        )
    rights = max(count for since, count in FILE_RIGHTS.items() if version >= since)
    ruleset = _Ruleset(
        files=(1 << rights) - 1,
        ports=PORT_RIGHTS if version >= PORTS_SINCE else 0,
        scopes=SCOPES if version >= SCOPES_SINCE else 0,
    )
    libc = _libc()
    descriptor = libc.syscall(
        CREATE_RULESET, ctypes.byref(ruleset), ctypes.c_size_t(ctypes.sizeof(ruleset)), 0
    )
    if descriptor < 0:
        raise BackendUnavailable(f"Landlock: {os.strerror(ctypes.get_errno())}")
    try:
        libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
        if libc.syscall(RESTRICT_SELF, descriptor, 0):
            raise BackendUnavailable(f"Landlock: {os.strerror(ctypes.get_errno())}")
    finally:
        os.close(descriptor)


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


NOBODY = 65534
"""User and group that a process of root becomes."""


class Confinement(StrEnum):
    """Kinds of confinement.

    * ``bubblewrap``: namespaces of its own without network, processes or any file but Python and
      this code, and the filter of system calls.
    * ``landlock``: no new file and no port, and the same filter; needs no namespaces.
    * ``limits``: resource limits alone, no protection from code that took the process over.
    """

    BUBBLEWRAP = "bubblewrap"
    LANDLOCK = "landlock"
    LIMITS = "limits"


@dataclass(frozen=True)
class ProcessLimits:
    """Resource limits of a confined process; it may write no file and start no process."""

    address_space_bytes: int
    descriptors: int = 16


def confine(confinement: Confinement, limits: ProcessLimits) -> None:
    """Give up for good what reading and computing do not need; root becomes ``NOBODY``.

    Everything that will be imported must have been. Raises ``BackendUnavailable`` if this machine
    cannot confine as asked.
    """
    for limit, value in (
        (resource.RLIMIT_AS, limits.address_space_bytes),
        (resource.RLIMIT_NOFILE, limits.descriptors),
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_NPROC, 0),
        (resource.RLIMIT_CORE, 0),
    ):
        resource.setrlimit(limit, (value, value))
    if confinement is Confinement.LIMITS:
        return
    if os.geteuid() == 0:
        _give_up_root()
    if confinement is Confinement.LANDLOCK:
        restrict_files_and_ports()
    apply_filter(assembled(WHILE_READING, Refusal.KILL_PROCESS))


def _give_up_root() -> None:
    try:
        os.setgroups([])
        os.setresgid(NOBODY, NOBODY, NOBODY)
        os.setresuid(NOBODY, NOBODY, NOBODY)
    except PermissionError as error:
        raise BackendUnavailable(
            "sandbox: root without the capabilities SETUID and SETGID cannot become user "
            f"{NOBODY}; run as another user"
        ) from error
