"""The learning process (``mec_server.tile_learning``) and the server's hold on it.

The process runs on one core, while a processor is idle; it ends with the server, whose end of a
pipe it reads. One that ends by itself, or is killed, is started again. A second process on the same
recordings waits until the first is gone.
"""

from __future__ import annotations

import fcntl
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path

import structlog

from mec_server.event_loop import work_when_idle
from mec_server.tile_history import LEARNING, TileHistory, read_histories
from mec_server.tile_learning import LearningJob, LearningRounds
from rfcore.errors import RfedgeError
from rfcore.update.run import LearnAs
from rfcore.wire.settings import LogForm, configure_logs

__all__ = ["ONE_THREAD", "Learner", "main"]

log = structlog.get_logger()

EVERY_S = 0.5
"""From the end of one round to the next."""
RESTART_S = 30.0
"""A process that ended is started again this long after its start, at the earliest."""
STOP_S = 5.0
ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
Command = tuple[str, ...]


class Learner:
    """Keeps the learning process running: ``start``, then ``look`` now and then, then ``close``.

    ``show`` is given what was learnt, by tile, with each look; ``now_s`` is a monotonic clock.
    """

    def __init__(
        self,
        job: LearningJob,
        form: LogForm,
        show: Callable[[Mapping[str, TileHistory]], None],
        now_s: Callable[[], float] = time.monotonic,
        command: Command = (sys.executable, "-m", "mec_server.learner"),
    ) -> None:
        self._job, self._show, self._now_s = job, show, now_s
        self._command = (*command, json.dumps(_plain(job)), str(form))
        self._process: subprocess.Popen[bytes] | None = None
        self._started_s = 0.0
        self.restarts = 0

    @property
    def pid(self) -> int | None:
        """The process that runs, or ran last."""
        return None if self._process is None else self._process.pid

    def start(self) -> None:
        """Start the process; raise ``OSError``."""
        self._started_s = self._now_s()
        self._process = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, env={**os.environ, **ONE_THREAD}
        )
        log.info("learning", recordings=str(self._job.recordings), pid=self._process.pid)

    def look(self) -> None:
        """Start the process again if it has ended, and show what was learnt; raise ``OSError``."""
        process = self._process
        is_over = process is not None and process.poll() is not None
        if process is not None and is_over and self._now_s() - self._started_s >= RESTART_S:
            log.warning("learning process ended", status=process.returncode)
            self.close()
            self.restarts += 1
            self.start()
        self._show(read_histories(self._job.recordings))

    def close(self) -> None:
        """End the process."""
        process = self._process
        if process is None:
            return
        assert process.stdin is not None
        process.stdin.close()
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def main() -> None:
    """Be the learning process: ``mec_server.learner JOB LOG_FORM``."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    work_when_idle()
    job = _job(json.loads(sys.argv[1]))
    configure_logs(sys.stderr, LogForm(sys.argv[2]))
    threading.Thread(target=_end_with_the_server, daemon=True).start()
    folder = job.recordings / LEARNING
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        rounds = LearningRounds(job, lambda: time.time_ns() // 1_000_000)
        while True:
            _try(rounds)
            time.sleep(EVERY_S)


def _try(rounds: LearningRounds) -> None:
    try:
        rounds.run()
    except (RfedgeError, OSError) as error:
        log.error("learning failed", problem=str(error))


def _end_with_the_server() -> None:
    sys.stdin.buffer.read()
    os._exit(0)


def _plain(job: LearningJob) -> dict[str, object]:
    return {**asdict(job), "fields": str(job.fields), "recordings": str(job.recordings)}


def _job(plain: dict[str, object]) -> LearningJob:
    paths = {name: Path(str(plain.pop(name))) for name in ("fields", "recordings")}
    learn_as = LearnAs(str(plain.pop("learn_as")))
    return LearningJob(**paths, learn_as=learn_as, **plain)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
