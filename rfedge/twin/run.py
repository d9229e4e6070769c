"""``rfedge twin``: one source of fields and pictures, the page, and what compares them."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from rfcore.files import write_whole
from rfedge.twin.board import Board
from rfedge.twin.comparing import Comparer
from rfedge.twin.scene import TwinScene
from rfedge.twin.web import TwinWeb, WebSettings

EXIT_SEEN_S = 1.0

__all__ = ["Source", "TwinRun", "run_twin"]


class Source(Protocol):
    """Where fields and pictures come from."""

    def run(self) -> Coroutine[Any, Any, None]:
        """Tell the scene, until cancelled."""


@dataclass(frozen=True)
class TwinRun:
    """What ``rfedge twin`` was asked for; ``source`` is made for the scene it is to tell."""

    web: WebSettings
    source: Callable[[TwinScene], Source]
    ready_file: Path | None = None
    """Written with the page's address once it can be opened."""
    until_exit_of: int | None = None
    """A process at whose end this one ends, too."""


def run_twin(run: TwinRun) -> None:
    """Serve until SIGINT or SIGTERM; raises what the source raises."""
    asyncio.run(_serve(run))


async def _serve(run: TwinRun) -> None:
    board = Board()
    scene = TwinScene(board)
    stopped = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopped.set)
    with ThreadPoolExecutor(1, "compare") as executor:
        comparer = Comparer(scene, executor)
        web = TwinWeb(run.web, board, scene, comparer)
        address = await web.start()
        print(f"open {address}", flush=True)
        if run.ready_file is not None:
            write_whole(run.ready_file, address.encode())
        tasks = [
            asyncio.create_task(run.source(scene).run()),
            asyncio.create_task(comparer.run()),
            asyncio.create_task(stopped.wait()),
            *([asyncio.create_task(_exit_of(run.until_exit_of))] if run.until_exit_of else []),
        ]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await web.stop()


async def _exit_of(pid: int) -> None:
    """Wait until a process has ended."""
    while _runs(pid):
        await asyncio.sleep(EXIT_SEEN_S)


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # it runs as another user
        return True
    return True
