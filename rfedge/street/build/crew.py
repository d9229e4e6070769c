"""Taking shots in this process or in several at once."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait

from rfcore.errors import RfedgeError
from rfedge.street.build.studio import Order, Studio
from rfedge.street.shots import Shot

__all__ = ["take_all"]

_studio: Studio | None = None


def take_all(order: Order, shots: Sequence[Shot], workers: int) -> Iterator[Shot]:
    """Take the shots and yield each when its files are written.

    Raises ``RfedgeError`` naming the shot that could not be taken; those before it stay valid.
    """
    taken = _take_here(order, shots) if workers == 1 else _take_apart(order, shots, workers)
    yield from taken


def _take_here(order: Order, shots: Sequence[Shot]) -> Iterator[Shot]:
    studio = Studio(order)
    for shot in shots:
        try:
            studio.take(shot)
        except OSError as error:
            raise _stopped(shot, error) from error
        yield shot


def _take_apart(order: Order, shots: Sequence[Shot], workers: int) -> Iterator[Shot]:
    pool = ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=_open_studio, initargs=(order,)
    )
    with pool:
        waiting = {pool.submit(_take, shot): shot for shot in shots}
        try:
            for done in as_completed(waiting):
                shot = waiting.pop(done)
                try:
                    done.result()
                except (OSError, BrokenProcessPool) as error:
                    raise _stopped(shot, error) from error
                yield shot
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _open_studio(order: Order) -> None:
    global _studio
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _studio = Studio(order)


def _take(shot: Shot) -> None:
    assert _studio is not None
    _studio.take(shot)


def _end_with_parent() -> None:
    """A pool's workers would wait for ever for a parent that was killed."""
    parent = parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


def _stopped(shot: Shot, error: Exception) -> RfedgeError:
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return RfedgeError(
        f"{shot.split}/{shot.name} could not be written ({reason}); frames finished before are "
        "valid, the same command goes on from there"
    )
