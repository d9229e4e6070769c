"""Keep an encoder library from taking the machine.

SVT-AV1 asks for real-time scheduling when it runs as root: its own threads and, for good, the one
that opened it. Everything started afterwards inherits that and starves what else runs, and times
taken beside it are worth nothing. Linux only; elsewhere there is nothing to undo.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

__all__ = ["ordinary_scheduling"]


@contextmanager
def ordinary_scheduling() -> Iterator[None]:
    """Give all threads of this process, new ones too, the policy that this one had before."""
    policy, priority = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        for task in Path("/proc/self/task").iterdir():
            with suppress(ProcessLookupError):  # a thread may end meanwhile
                if os.sched_getscheduler(int(task.name)) != policy:
                    os.sched_setscheduler(int(task.name), policy, priority)
