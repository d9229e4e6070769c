"""How a process gives up its rights, before it reads the first byte that somebody else wrote."""

from __future__ import annotations

import os
import resource
from dataclasses import dataclass
from enum import StrEnum

from rfcore.confinement.landlock import restrict_files_and_ports
from rfcore.confinement.seccomp import WHILE_READING, Refusal, apply_filter, assembled
from rfcore.errors import BackendUnavailable

__all__ = ["NOBODY", "Confinement", "ProcessLimits", "confine"]

NOBODY = 65534
"""User and group that a process of root becomes."""


class Confinement(StrEnum):
    """What surrounds a process.

    ``bubblewrap``: namespaces of its own without network, processes or any file but Python and this
    code, and the filter of system calls. ``landlock``: no new file and no port, and the same
    filter; needs no namespaces. ``limits``: resource limits alone, no protection from code that
    took the process over.
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
