"""Runs every experiment: finished pieces are taken from disk, and results are recorded.

A ``Run`` is made before anything is measured, so that the result says of which revision it is. It
hands out finished pieces (``store``), has pieces measured in several processes or on Ray
(``parallel``), and writes the result and prints its tables at the end (``finish``).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from rfedge.evaluate import Experiment
from rfedge.evaluate.clips import BoundCoder, Clip, ClipCoder, CodedClip
from rfedge.jobs import Cell, CellKey, CellStore, Job, run_jobs
from rfedge.report.tables import Parts, Table, print_tables
from rfedge.results import CHECKOUT, Provenance, make_result, provenance, write_result

PROGRAM = ("rfcore", "rfedge/evaluate", "rfedge/offline.py")
"""Code that every finished piece depends on."""


@dataclass(frozen=True)
class Run:
    """One run of an experiment, from before it measures until its result is written."""

    kind: str
    job: Experiment
    made: Provenance
    store: CellStore
    console: Console

    @staticmethod
    def begin(kind: str, job: Experiment, inputs: Iterable[Path], console: Console) -> Run:
        """Begin a run that reads the files ``inputs``."""
        return Run(kind, job, provenance(inputs), CellStore(job.cells), console)

    def tell(self, text: str) -> None:
        """Print a line about how the run goes."""
        self.console.print(text, markup=False, highlight=False)

    def parallel(self, jobs: Sequence[Job], processes: int, ray: str | None = None) -> None:
        """Do jobs that leave finished pieces; without several processes or Ray, do nothing.

        What they would leave is then measured where it is asked for.
        """
        if processes > 1 or ray is not None:
            run_jobs(jobs, partial(print, flush=True), ray, processes)

    def finish(self, content: Mapping[str, Any], parts: Parts) -> dict[str, Any]:
        """Write the result, print its ``parts`` and where it is, and return it."""
        result = make_result(self.kind, self.made, {"quick": self.job.quick, **content})
        write_result(self.job.out, result)
        print_tables(map(self._labelled, parts(result)), self.console)
        told = f"written to {self.job.out}"
        self.console.print(told, markup=False, highlight=False, soft_wrap=True)
        return result

    def _labelled(self, part: Table | str) -> Table | str:
        if not self.job.quick:
            return part
        if isinstance(part, str):
            return f"QUICK, not for figures. {part}"
        return replace(part, title=f"QUICK, not for figures. {part.title}".rstrip())


@cache
def program_version(*also: str, root: Path = CHECKOUT) -> str:
    """Return the digest of the modules and kernels that a finished piece depends on.

    ``also`` are the folders of code that only some experiments depend on. A revision would do only
    in a clean checkout: it keeps its name when files change.
    """
    total = hashlib.sha256()
    for path in sorted(_program_files(root, also)):
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        total.update(f"{path.relative_to(root)} {content}\n".encode())
    return f"program {total.hexdigest()[:16]}"


def _program_files(root: Path, also: Sequence[str]) -> Iterator[Path]:
    for name in (*PROGRAM, *also):
        path = root / name
        if path.is_file():
            yield path
        else:
            for pattern in ("*.py", "*.so"):
                yield from path.rglob(pattern)


def clip_key(clip: Clip, coder: ClipCoder, point: float) -> CellKey:
    """Return the key of ``clip`` coded by ``coder`` at ``point``."""
    part = {} if clip.part is None else {"part": str(clip.part)}
    return {
        **part,
        "scene": clip.scene,
        "hz": clip.rate_hz,
        "frames": clip.frames_digest,
        "method": coder.name,
        "point": point,
        "version": coder.version,
    }


def coded_clip(clip: Clip, coder: ClipCoder, point: float, store: CellStore) -> CodedClip:
    """Return ``clip`` coded at ``point``, from ``store`` or coded now and then kept.

    Each run of a clip is coded on its own, and of what was coded ``Clip.coded`` is kept, so that
    all frames but the first are steady, as those of a whole drive. Raises ``InvalidData`` naming
    the file if a stored cell is damaged.
    """
    cell = store.cell(clip_key(clip, coder, point))
    if cell.path.exists():
        return _clip_of(cell)
    if clip.part is None:
        coded = coder.code(clip.frames, clip.rate_hz, point)
    else:
        coded = _joined([_coded_run(clip, coder, point, run) for run in clip.runs])
        coded = coded.of_frames(clip.coded)
    cell.keep(_fields(coded))
    return coded


def _coded_run(clip: Clip, coder: ClipCoder, point: float, run: slice) -> CodedClip:
    if isinstance(coder, BoundCoder):
        coder = coder.of_run(run)
    return coder.code(clip.frames[run], clip.rate_hz, point)


def _joined(runs: Sequence[CodedClip]) -> CodedClip:
    receivers_ms = [run.receiver_cpu_ms for run in runs if run.receiver_cpu_ms is not None]
    notes = {name: [run.notes[name] for run in runs] for name in runs[0].notes}
    return CodedClip(
        runs[0].point,
        np.concatenate([run.frame_bytes for run in runs]),
        np.concatenate([run.luma_mse for run in runs]),
        np.concatenate([run.ssim for run in runs]),
        sum(run.cpu_ms for run in runs),
        {name: tuple(chain.from_iterable(values)) for name, values in notes.items()},
        sum(receivers_ms) if len(receivers_ms) == len(runs) else None,
    )


def _fields(coded: CodedClip) -> dict[str, Any]:
    return {
        "point": coded.point,
        "frame_bytes": coded.frame_bytes.tolist(),
        "luma_mse": coded.luma_mse.tolist(),
        "ssim": coded.ssim.tolist(),
        "cpu_ms": coded.cpu_ms,
        "notes": {name: list(values) for name, values in coded.notes.items()},
        "receiver_cpu_ms": coded.receiver_cpu_ms,
    }


def _clip_of(cell: Cell) -> CodedClip:
    stored = cell.result()
    try:
        return CodedClip(
            stored["point"],
            np.array(stored["frame_bytes"], np.int64),
            np.array(stored["luma_mse"], np.float64),
            np.array(stored["ssim"], np.float64),
            stored["cpu_ms"],
            {name: tuple(values) for name, values in stored["notes"].items()},
            stored["receiver_cpu_ms"],
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise cell.damaged(error) from error
