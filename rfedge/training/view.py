"""Show a field in a browser while it is trained.

The training writes snapshots of the field. Another process, at the lowest priority, shows the
newest one (``rfedge twin --follow``), so that neither the browser nor the conversion of splats
takes a core from the training. Writing snapshots takes at most ``SHARE`` of the time.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from rfcore.errors import RfedgeError
from rfcore.field import save_field
from rfcore.train.trainer import FieldTrainer
from rfedge.processes import service
from rfedge.twin.web import WebSettings

SHARE = 0.02
"""Largest share of the time that writing snapshots may take."""
SOONEST_S = 2.0
LOWEST_PRIORITY = 19


class Snapshots:
    """Writes a trainer's field to ``path``, as often as ``SHARE`` permits."""

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self.count = 0
        self._path = path
        self._clock = clock
        self._due_s = clock()

    def __call__(self, trainer: FieldTrainer) -> None:
        """Write the field if a snapshot is due."""
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
    """Serve the page while the block runs; yield the writer of the snapshots that it shows.

    ``drive`` has pictures to show beside the field's renders. ``tell`` is called with the page's
    address. Raises ``RfedgeError`` if the page cannot be served.
    """
    token = {} if settings.token is None else {"RFEDGE_TWIN_TOKEN": settings.token}
    with TemporaryDirectory(prefix="rfedge-view-") as folder, ExitStack() as running:
        path = Path(folder, "field.rff")
        command = [sys.executable, "-m", "rfedge", "twin", str(path), "--follow"]
        command += ["--http", str(settings.address), "--until-exit-of", str(os.getpid())]
        if drive is not None:
            command += ["--drive", str(drive), "--rate-hz", "1"]
        try:
            page = running.enter_context(service("twin", command, Path(folder), token))
        except RfedgeError as error:
            raise RfedgeError(f"--view: the page cannot be served: {error}") from None
        os.setpriority(os.PRIO_PROCESS, page.process.pid, LOWEST_PRIORITY)
        tell(page.address)
        yield Snapshots(path)
