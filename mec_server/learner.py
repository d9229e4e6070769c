"""The learning process (``mec_server.tile_learning``), and the server's supervision of it.

The process runs on one core, while a processor is idle; it ends with the server, whose end of a
pipe it reads. If it ends by itself, or is killed, it is started again. A second process on the same
recordings waits until the first is gone.

Pictures of vehicles that are not recorded never reach it: the server tries learnt fields on those
itself, in memory (``UnrecordedTrials``), and reports the increase in bits to the process.
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
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import structlog

from mec_server.config import ServerConfig
from mec_server.event_loop import Workers, work_when_idle
from mec_server.tile_history import LEARNING, TileHistory, read_histories
from mec_server.tile_learning import (
    CHECK_EVERY,
    CHECK_FRAMES,
    BitsIncrease,
    LearningJob,
    LearningRounds,
    percent_worse,
)
from mec_server.twin.state import ReceivedPicture
from rfcore.camera import Camera
from rfcore.errors import RfedgeError
from rfcore.field import RadianceField
from rfcore.native.yuv import rgb_from_i420
from rfcore.perception.objects import CameraKey
from rfcore.update.passes import Pass
from rfcore.update.run import LearnAs
from rfcore.views import PosedPicture
from rfcore.wire.settings import LogForm, configure_logs

log = structlog.get_logger()

EVERY_S = 0.5
"""Pause between two rounds."""
RESTART_S = 30.0
"""A process that ended is started again this long after its start, at the earliest."""
STOP_S = 5.0
MOST_PAUSE_S = 2.0
"""Longest pause between two pictures of one trial; after a longer one another camera is tried."""
ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}


class Learner:
    """Keeps the learning process running: call ``start``, then ``look`` regularly, then ``close``.

    ``show`` is given the history of each tile with each look; ``now_s`` is a monotonic clock.
    """

    def __init__(
        self,
        job: LearningJob,
        form: LogForm,
        show: Callable[[Mapping[str, TileHistory]], None],
        now_s: Callable[[], float] = time.monotonic,
        command: Sequence[str] = (sys.executable, "-m", "mec_server.learner"),
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
        """Restart the process if it has ended, and show the tiles' histories; raise ``OSError``."""
        process = self._process
        is_over = process is not None and process.poll() is not None
        if process is not None and is_over and self._now_s() - self._started_s >= RESTART_S:
            log.warning("learning process ended", status=process.returncode)
            self.close()
            self.restarts += 1
            self.start()
        self._show(read_histories(self._job.recordings))

    def report(self, harm: BitsIncrease) -> None:
        """Report an increase to the process, if it runs."""
        if self._process is not None and self._process.stdin is not None:
            with suppress(BrokenPipeError, ValueError):  # it has ended, or is being restarted
                self._process.stdin.write(json.dumps(asdict(harm)).encode() + b"\n")
                self._process.stdin.flush()

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


def learning_job(config: ServerConfig, recordings: Path) -> LearningJob:
    """Return the job of the learning process of a server that records into ``recordings``."""
    settings = config.learn
    return LearningJob(
        config.fields,
        recordings,
        settings.learn_as,
        settings.min_identities,
        cpu_s_per_h=settings.cpu_s_per_h,
        max_bytes=round(settings.max_gb * 1e9),
        max_age_s=settings.max_age_h * 3600,
        quiet_s=settings.quiet_s,
        max_field_bytes=config.render.max_field_bytes,
    )


@dataclass(frozen=True)
class _LearntField:
    """A learnt field that vehicles use now."""

    tile: str
    replaced_id: str


class UnrecordedTrials:
    """Tries learnt fields on pictures of vehicles that are not recorded.

    It keeps ``CHECK_FRAMES`` pictures in a row of one camera in memory until they were coded
    against the learnt field and against the field that it replaced, on a thread that works while a
    processor is idle; only the increase in bits is reported. A camera is tried again after
    ``CHECK_EVERY`` frames. ``open_field`` opens fields for that thread alone; ``failed`` is called
    with its errors.
    """

    def __init__(
        self,
        open_field: Callable[[str], RadianceField],
        failed: Callable[[Exception], None],
        report: Callable[[BitsIncrease], None],
    ) -> None:
        self._open_field, self._report = open_field, report
        self._worker = Workers(1, failed, "trials", begin=work_when_idle)
        self._learnt: Mapping[str, _LearntField] = {}
        self._rested: Counter[tuple[CameraKey, str]] = Counter()
        self._taken: list[ReceivedPicture] = []
        self._is_trying = False

    def close(self) -> None:
        """Stop the thread."""
        self._worker.close()

    def watch(self, histories: Mapping[str, TileHistory]) -> None:
        """Try the learnt fields in these histories, unless they were withdrawn."""
        self._learnt = {
            one.field_id: _LearntField(tile, one.replaced_id)
            for tile, history in histories.items()
            for one in history.learnt
            if not one.withdrawn
        }

    def saw(self, view: ReceivedPicture) -> None:
        """Take a picture of a vehicle that is not recorded; called on the event loop."""
        learnt = self._learnt.get(view.field_id)
        if learnt is None or view.frame.pose is None:
            return
        turn = (view.key, view.field_id)
        self._rested[turn] = max(0, self._rested[turn] - 1)
        if self._is_trying:
            return
        if self._taken and view.reconstructed_s - self._taken[-1].reconstructed_s > MOST_PAUSE_S:
            self._taken = []
        if not self._taken and self._rested[turn] == 0:
            self._taken = [view]
        elif self._taken and (self._taken[0].key, self._taken[0].field_id) == turn:
            self._taken.append(view)
        if len(self._taken) == CHECK_FRAMES:
            views, self._taken, self._is_trying = self._taken, [], True
            self._rested[turn] = CHECK_EVERY - CHECK_FRAMES
            self._worker.submit(
                view.vehicle_id, partial(self._tried, learnt, views), self._finished
            )

    def left(self, vehicle_id: str) -> None:
        """Forget a vehicle that is gone."""
        self._taken = [view for view in self._taken if view.vehicle_id != vehicle_id]
        for turn in [turn for turn in self._rested if turn[0][0] == vehicle_id]:
            del self._rested[turn]

    def _finished(self, outcome: BitsIncrease | Exception) -> None:
        self._is_trying = False
        if isinstance(outcome, Exception):
            raise outcome
        self._report(outcome)

    def _tried(self, learnt: _LearntField, views: Sequence[ReceivedPicture]) -> BitsIncrease:
        field_id, vehicle_id = views[0].field_id, views[0].vehicle_id
        before, after = self._open_field(learnt.replaced_id), self._open_field(field_id)
        drive = Pass(vehicle_id, tuple(map(_posed, views)))
        return BitsIncrease(learnt.tile, field_id, vehicle_id, percent_worse(before, after, drive))


def _posed(view: ReceivedPicture) -> PosedPicture:
    assert view.frame.pose is not None
    camera = Camera(view.intrinsics, view.frame.pose)
    return PosedPicture(view.frame.camera_id, camera, partial(rgb_from_i420, view.picture))


def main() -> None:
    """Run the learning process: ``mec_server.learner JOB LOG_FORM``."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    work_when_idle()
    job = _job(json.loads(sys.argv[1]))
    configure_logs(sys.stderr, LogForm(sys.argv[2]))
    rounds = LearningRounds(job, lambda: time.time_ns() // 1_000_000)
    threading.Thread(target=_follow_the_server, args=(rounds,), daemon=True).start()
    folder = job.recordings / LEARNING
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        while True:
            _try(rounds)
            time.sleep(EVERY_S)


def _try(rounds: LearningRounds) -> None:
    try:
        rounds.run()
    except (RfedgeError, OSError) as error:
        log.error("learning failed", problem=str(error))


def _follow_the_server(rounds: LearningRounds) -> None:
    """Read the server's reports, a line each, and end with the server."""
    for line in sys.stdin.buffer:
        rounds.report(BitsIncrease(**json.loads(line)))
    os._exit(0)


def _plain(job: LearningJob) -> dict[str, object]:
    return {**asdict(job), "fields": str(job.fields), "recordings": str(job.recordings)}


def _job(plain: dict[str, object]) -> LearningJob:
    paths = {name: Path(str(plain.pop(name))) for name in ("fields", "recordings")}
    learn_as = LearnAs(str(plain.pop("learn_as")))
    return LearningJob(**paths, learn_as=learn_as, **plain)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
