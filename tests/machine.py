"""Whether the machine was ours alone while something was timed.

A virtual machine's host counts the time in which a thread was ready and had no processor, as the
host gave it to somebody else: ``steal`` in ``/proc/stat`` (proc_stat(5)). Where it took more than
``QUIET`` and nothing but a bound of time was missed, the figures say nothing of us, and the case
is measured again, ``AGAIN`` times at most. What is wrong on a quiet machine fails at once.
"""

import psutil
import pytest

QUIET = 0.01
AGAIN = 2


class NotQuiet(AssertionError):
    """Bounds of time were missed on a machine that others kept busy."""


MEASURED_AGAIN = pytest.mark.flaky(reruns=AGAIN, only_rerun=[NotQuiet.__name__])


class Host:
    """Processor time that others took of the machine since this was made."""

    def __init__(self) -> None:
        self._begin = _seconds()

    def taken(self) -> float:
        """Return the share of all processors' time that the host gave to others."""
        stolen, every = (now - then for now, then in zip(_seconds(), self._begin, strict=True))
        return stolen / max(0.01, every)


def judge(failed: list[str], late: list[str], taken: float) -> None:
    """Fail with what failed; raise ``NotQuiet`` if all of that is time, and others were busy."""
    if failed and failed == late and taken > QUIET:
        raise NotQuiet(f"the host gave {taken:.1%} of the processors to others: {failed}")
    assert failed == []


def _seconds() -> tuple[float, float]:
    """Return what was stolen and everything, in seconds, of all processors together."""
    times = psutil.cpu_times()
    return times.steal, sum(times[:8])  # guests' are in the user's
