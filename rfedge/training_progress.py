"""How far a training is: a bar on a terminal, a line at each twentieth in a log."""

from __future__ import annotations

from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from rfcore.errors import RfedgeError
from rfedge.durations import time_text
from rfedge.training_loop import LoopStatus, TrainingLoop

__all__ = ["run_showing"]

STEPS = 1000
"""Of the bar: progress is a share, of time or of iterations."""
LINES = 20


def run_showing(loop: TrainingLoop, console: Console, now_s: Callable[[], float]) -> None:
    """Run ``loop`` to its end and show iterations, loss, held-out quality and time left."""
    if console.is_terminal:
        _with_bar(loop, console)
    else:
        loop.run(_Lines(console, now_s))


def _with_bar(loop: TrainingLoop, console: Console) -> None:
    columns = (
        BarColumn(),
        TextColumn("{task.fields[state]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("train", total=STEPS, state="")

        def tell(status: LoopStatus) -> None:
            bar.update(task, completed=STEPS * status.progress, state=_state(status))

        try:
            loop.run(tell)
        except RfedgeError:
            bar.stop()
            raise


class _Lines:
    """Prints a line at each twentieth; time left goes by the pace since the start."""

    def __init__(self, console: Console, now_s: Callable[[], float]) -> None:
        self._console, self._now_s = console, now_s
        self._start: tuple[float, float] | None = None
        self._printed = 0

    def __call__(self, status: LoopStatus) -> None:
        now_s = self._now_s()
        if self._start is None:
            self._start, self._printed = (now_s, status.progress), int(LINES * status.progress)
        if int(LINES * status.progress) == self._printed:
            return
        self._printed = int(LINES * status.progress)
        start_s, start_progress = self._start
        pace_s = (now_s - start_s) / max(status.progress - start_progress, 1e-9)
        left = time_text(pace_s * (1.0 - status.progress))
        self._console.print(f"  {status.progress:.0%}: {_state(status)}, {left} left")


def _state(status: LoopStatus) -> str:
    quality = f", held out {status.psnr_db:.2f} dB" if status.psnr_db is not None else ""
    return (
        f"{status.iteration:,} iterations, {status.primitives:,} primitives, "
        f"loss {status.loss:.4f}{quality}"
    )
