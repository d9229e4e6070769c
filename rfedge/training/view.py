"""A field in a browser while it is trained.

The training writes snapshots of the field, and a process of its own at the lowest priority shows
the newest (``rfedge twin --follow``), so that no browser and no conversion of splats takes a core
from the training. What a snapshot takes bounds how often there is one: ``SHARE`` of the time.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from rfcore.errors import RfedgeError
from rfcore.field import save_field
from rfcore.train import FieldTrainer
from rfedge.twin.web import WebSettings

__all__ = ["SHARE", "Snapshots", "shown_in_browser"]

SHARE = 0.02
"""Of the time since the last snapshot, the most that writing it may take."""
SOONEST_S = 2.0
LOWEST_PRIORITY = 19
START_TIMEOUT_S = 60.0
STOP_TIMEOUT_S = 10.0


class Snapshots:
    """Writes a trainer's field to ``path``, as often as ``SHARE`` permits."""

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self.count = 0
        self._path = path
        self._clock = clock
        self._due_s = clock()

    def __call__(self, trainer: FieldTrainer) -> None:
        """Write the field if it is time to."""
        began_s = self._clock()
        if began_s < self._due_s:
            return
        save_field(trainer.field(), self._path)
        took_s = self._clock() - began_s
        self._due_s = began_s + max(SOONEST_S, took_s / SHARE)
        self.count += 1


@contextmanager
def shown_in_browser(
    settings: WebSettings, drive: Path | None, tell: Callable[[str], None]
) -> Iterator[Snapshots]:
    """Serve the page while the block runs; yield what writes the snapshots that it shows.

    ``drive``: pictures to show beside the field's renders. ``tell`` is given the page's address.
    Raises ``RfedgeError`` where the page cannot be served.
    """
    with TemporaryDirectory(prefix="rfedge-view-") as folder:
        path, ready = Path(folder, "field.rff"), Path(folder, "ready")
        with Path(folder, "log").open("w+") as log:
            process = subprocess.Popen(
                _command(settings, drive, path, ready),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=_environment(settings),
            )
            os.setpriority(os.PRIO_PROCESS, process.pid, LOWEST_PRIORITY)
            try:
                _await_ready(process, ready, Path(folder, "log"))
                tell(ready.read_text())
                yield Snapshots(path)
            finally:
                _stop(process)


def _command(settings: WebSettings, drive: Path | None, path: Path, ready: Path) -> list[str]:
    command = [sys.executable, "-m", "rfedge", "twin", str(path), "--follow"]
    command += ["--http", str(settings.address), "--ready-file", str(ready)]
    command += ["--until-exit-of", str(os.getpid())]
    return command if drive is None else [*command, "--drive", str(drive), "--rate-hz", "1"]


def _environment(settings: WebSettings) -> dict[str, str]:
    token = {} if settings.token is None else {"RFEDGE_TWIN_TOKEN": settings.token}
    return {**os.environ, **token}


def _await_ready(process: subprocess.Popen[bytes], ready: Path, log: Path) -> None:
    end_s = time.monotonic() + START_TIMEOUT_S
    while not ready.exists():
        if process.poll() is not None or time.monotonic() > end_s:
            said = log.read_text().strip().rpartition("\n")[2]
            raise RfedgeError(f"--view: the page cannot be served: {said}")
        time.sleep(0.05)


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
