"""How far a build is: a bar with the time left on a terminal, a line at each tenth in a log."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rfedge.durations import time_text

__all__ = ["show_progress"]


def show_progress(
    done: Iterable[object], total: int, console: Console, now_s: Callable[[], float]
) -> None:
    """Exhaust ``done``, of which ``total`` things will come, and show how it goes."""
    if console.is_terminal:
        _bar(done, total, console)
    else:
        _lines(done, total, console, now_s)


def _bar(done: Iterable[object], total: int, console: Console) -> None:
    columns = (TextColumn("frames"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("frames", total=total)
        for _ in done:
            bar.advance(task)


def _lines(
    done: Iterable[object], total: int, console: Console, now_s: Callable[[], float]
) -> None:
    start_s = now_s()
    every = max(total // 10, 1)
    for count, _ in enumerate(done, start=1):
        if count % every == 0 or count == total:
            left_s = (now_s() - start_s) / count * (total - count)
            console.print(f"{count} of {total} frames, {time_text(left_s)} left")
