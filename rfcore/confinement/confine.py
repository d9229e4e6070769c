"""Confine this process, before it reads the first byte that somebody else wrote.

With Landlock (landlock(7)) a process gives up every right to files and ports, without being root,
also where user namespaces are refused, as under Docker's default profile.
"""

from __future__ import annotations

import ctypes
import os
import resource
from dataclasses import dataclass
from enum import StrEnum

from rfcore.confinement.seccomp import WHILE_READING, Refusal, apply_filter, assembled
from rfcore.errors import BackendUnavailable

CREATE_RULESET, RESTRICT_SELF = 444, 446
"""System call numbers, the same on every machine."""
ASK_VERSION = 1
PR_SET_NO_NEW_PRIVS = 38

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
