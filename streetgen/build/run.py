"""Run a build: estimate its cost, render the missing shots in worker processes, show progress.

The estimate was measured on a busy 2-core x86-64 machine (AVX-512, 2.5 GHz) with Mitsuba 3.9.1 and
LLVM 19, and with CUDA on an H100, where only the work for each pixel is left to the processor. On
other machines the progress bar's remaining time is the better figure.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rfcore.errors import InvalidInput, RfedgeError
from rfedge.arguments import time_text
from rfedge.results import as_json, provenance
from streetgen.build.listing import claim_folder, list_dataset, origin_of
from streetgen.build.scene_renderer import RenderJob, SceneRenderer, ShotFiles
from streetgen.render.backend import CUDA, Backend, Variant, chosen_backend
from streetgen.render.renderer import Sampling
from streetgen.shots import Selection, Shot

_renderer: SceneRenderer | None = None


def take_all(job: RenderJob, shots: Sequence[Shot], workers: int) -> Iterator[Shot]:
    """Take the shots and yield each when its files are written.

    Raises ``RfedgeError`` naming the shot that could not be taken; those before it stay valid.
    """
    taken = _take_here(job, shots) if workers == 1 else _take_apart(job, shots, workers)
    yield from taken


def _take_here(job: RenderJob, shots: Sequence[Shot]) -> Iterator[Shot]:
    renderer = SceneRenderer(job)
    for shot in shots:
        try:
            renderer.take(shot)
        except OSError as error:
            raise _stopped(shot, error) from error
        yield shot


def _take_apart(job: RenderJob, shots: Sequence[Shot], workers: int) -> Iterator[Shot]:
    pool = ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=_open_renderer, initargs=(job,)
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


def _open_renderer(job: RenderJob) -> None:
    global _renderer
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _renderer = SceneRenderer(job)


def _take(shot: Shot) -> None:
    assert _renderer is not None
    _renderer.take(shot)


def _end_with_parent() -> None:
    """End this worker when its parent is killed; it would wait for work for ever otherwise."""
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


START_S = 12.0
"""Time that each worker needs to make the world and compile kernels."""
SAMPLE_US = 2.0
PIXEL_US = 4.0
"""Time for a pixel's guides and depth, and for denoising and writing it."""
SCALAR_TIMES = 3.5
PIXEL_BYTES = 3.2
"""Size on the disk of a pixel's colour, depth and class, with its share of the points."""


def cost_line(
    shots: Sequence[Shot], sampling: Sampling, backend: Backend, cores: int, workers: int
) -> str:
    """Return a line with the number of frames, the time on one core and on all, and the size."""
    pixels = sum(s.camera.intrinsics.width_px * s.camera.intrinsics.height_px for s in shots)
    pixel_us = PIXEL_US if backend == CUDA else sampling.samples * SAMPLE_US + PIXEL_US
    core_s = 1e-6 * pixels * pixel_us * (1.0 if backend.vectorised else SCALAR_TIMES)
    core_s += START_S * workers
    used = min(cores, workers if not backend.vectorised else cores)
    room_mb = pixels * PIXEL_BYTES / 1e6
    return (
        f"{len(shots)} frames, {sampling.samples} samples a pixel: about {time_text(core_s)} of "
        f"one core, {time_text(core_s / used)} on {used}, {room_mb:.0f} MB"
    )


def show_progress(
    done: Iterable[object], total: int, console: Console, now_s: Callable[[], float]
) -> None:
    """Consume ``done``, an iterator over ``total`` finished shots, and show the progress."""
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


@dataclass(frozen=True)
class Settings:
    """Folder of a scene's pictures, their renderer and its precision."""

    out: Path
    samples: int = 16
    workers: int = 1
    renderer: Variant = "auto"

    def __post_init__(self) -> None:
        if not 1 <= self.workers <= 256:
            raise InvalidInput("workers", f"{self.workers} is outside 1..256")


def build_scene(selection: Selection, settings: Settings, console: Console) -> None:
    """Take the shots that are missing in the folder, then list all finished ones as a dataset."""
    sampling = Sampling(settings.samples, selection.scene.geometry.seed)
    backend = chosen_backend(settings.renderer)
    if not backend.vectorised and settings.renderer == "auto":
        console.print("no LLVM that Mitsuba can use (19 is known to work): scalar_rgb, 3-4x slower")
    cores = len(os.sched_getaffinity(0))
    job = RenderJob(
        scene=selection.scene,
        folder=settings.out,
        sampling=sampling,
        backend=backend,
        threads=max(cores // settings.workers, 1),
        size_px=selection.size_px,
    )
    claim_folder(job)
    shots = selection.shots()
    missing = [shot for shot in shots if not ShotFiles.of(job.folder, shot).done]
    if len(missing) < len(shots):
        console.print(f"{len(shots) - len(missing)} of {len(shots)} frames are there already")
    if missing:
        console.print(cost_line(missing, sampling, backend, cores, settings.workers))
        taken = take_all(job, missing, min(settings.workers, len(missing)))
        show_progress(taken, len(missing), console, time.monotonic)
    counts = list_dataset(job, _about(job))
    console.print(f"{settings.out}: " + ", ".join(f"{n} {split}" for split, n in counts.items()))


def _about(job: RenderJob) -> dict[str, Any]:
    return {**as_json(provenance()), "build": origin_of(job)}
