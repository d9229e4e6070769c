"""Runs ``rfedge-lab world``: each row a case, its bound, what was measured, whether it held."""

from __future__ import annotations

import asyncio
import os
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event, Thread

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from lab.live.showing import TwinBed, ingest_latencies_ms
from lab.servers.cases import WorldRow, world_parts
from lab.world import EvalWorld
from lab.world.objects import AnnotatedPicture, dusk_rows, object_rows, received
from lab.world.truth import Drive, SceneTruth, aside
from rfcore.camera import Camera
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.field import RadianceField, load_field
from rfcore.image import Rgb
from rfcore.metrics import psnr
from rfcore.perception.composition import LivePicture, compose, live_picture
from rfcore.perception.contacts import cut_out, find
from rfcore.perception.ground import FieldGround
from rfcore.wire.notices import ObjectAhead, StreetNotice
from rfcore.wire.twin import PictureEncoding
from rfcore.wire.twin_client import TwinClient
from rfcore.wire.twin_render import ViewRequest
from rfedge.loadtest.fleet import CONNECT_S, DRAIN_S, SETTLE_S, PrerecordedVehicle
from rfedge.loadtest.prerecorded import PrerecordedDrive, Schedule, prerecorded_drive
from rfedge.processes import command_of
from rfedge.report.tables import print_tables
from rfedge.results import (
    as_json,
    make_result,
    provenance,
    read_result,
    rows_of,
    write_result,
)

MAX_AGE_S = 2.0
LIVE_AGE_S = 0.1
"""Age of the picture that a view is composed of."""
ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
LEAST_TOLD_S = 1e-3
"""Resolution of a notice's ``unseen_s``."""
CHANGED_LEVELS, LEAST_CHANGED = 16, 0.002
"""Pixels of which the truth differs by more from that of the empty street, and the share of a view
from which on they count."""


def run_world(asked: EvalWorld) -> None:
    """Measure the requested rows, write them, print them."""
    field, console = load_field(asked.field), Console()
    asked.work.mkdir(parents=True, exist_ok=True)
    cases: dict[str, Callable[[], list[WorldRow]]] = {
        "objects": lambda: object_rows(asked, field),
        "dusk": lambda: dusk_rows(asked, field),
        "views": lambda: view_rows(asked, field),
        "cost": lambda: cost_rows(asked, field),
        "notices": lambda: notice_rows(asked),
        "ingest": lambda: ingest_rows(asked),
    }
    unknown = set(asked.only) - set(cases)
    if unknown:
        raise InvalidInput("only", f"{sorted(unknown)[0]!r} is none of {', '.join(cases)}")
    paths = [asked.field, *(Path(p) for d in (asked.empty, asked.vehicles) for p in d.split(","))]
    source = provenance(paths)
    kept = _kept(asked.out, source.revision)
    measured = asked.only or tuple(cases)
    for name in measured:
        kept[name] = cases[name]()
        rows = [as_json(row) for part in cases for row in kept.get(part, [])]
        write_result(str(asked.out), make_result("world", source, {"rows": rows}))
    print_tables(world_parts(read_result(asked.out)), console)


def _kept(out: Path, revision: str) -> dict[str, list[WorldRow]]:
    """Return the rows that are there of this revision, by part."""
    kept: dict[str, list[WorldRow]] = {}
    if out.is_file():
        result = read_result(out)
        for row in rows_of(WorldRow, result["rows"]) if result["revision"] == revision else ():
            kept.setdefault(row.part, []).append(row)
    return kept


# --- views


@dataclass(frozen=True)
class Gain:
    """Gain of a view by a live picture: everywhere, and in the pixels that truly changed, None
    where hardly any did."""

    all_db: float
    changed_db: float | None


def view_rows(asked: EvalWorld, field: RadianceField) -> list[WorldRow]:
    """Return how close views from beside the drives come to the generator's pictures."""
    empty, vehicles = Drive.given(asked.empty), Drive.given(asked.vehicles)
    nothing, changed = SceneTruth(empty.scene), SceneTruth(vehicles.scene)
    unchanged_gains = list(_gains(asked, field, empty, nothing, nothing))
    gains = list(_gains(asked, field, vehicles, changed, nothing))
    return [*_unchanged_rows(unchanged_gains), *_changed_rows(gains)]


def _gains(
    asked: EvalWorld, field: RadianceField, drive: Drive, truth: SceneTruth, empty: SceneTruth
) -> Iterator[Gain]:
    """Yield the gain of each view beside every Nth picture of a drive."""
    ground = FieldGround(field.render, field.metadata.vertical)
    for index, seen in enumerate(_received(drive, field)):
        if index % asked.every:
            continue
        live, _ = cut_out(seen, ground)
        for left_m in asked.aside_m:
            camera, time_s = aside(seen.camera, left_m), drive.time_s(index)
            true = truth.picture(camera, time_s)
            unchanged = true if truth is empty else empty.picture(camera, time_s)
            yield gain_of(field, live, TruePictures(camera, true, unchanged))


def _received(drive: Drive, field: RadianceField) -> Iterator[LivePicture]:
    """Yield what a server makes of a drive's pictures."""
    pictures = []
    for index, picture in enumerate(drive.pictures):
        camera = picture.camera.rounded()
        view = field.render(camera)
        pictures.append(AnnotatedPicture(camera, drive.time_s(index), picture.read(), view, ()))
    for each, rgb in zip(pictures, received(pictures, [p.rgb for p in pictures]), strict=True):
        yield live_picture(each.camera, rgb, each.view)


def _unchanged_rows(gains: Sequence[Gain]) -> list[WorldRow]:
    all_db = [gain.all_db for gain in gains]
    told = f"{min(all_db):+.3f} dB (median {np.median(all_db):+.3f})"
    case = f"unchanged street, worst gain of {len(gains)}"
    return [WorldRow("views", case, ">= -0.1 dB", told, min(all_db) >= -0.1)]


def _changed_rows(gains: Sequence[Gain]) -> list[WorldRow]:
    all_db = [gain.all_db for gain in gains]
    changed_db = [gain.changed_db for gain in gains if gain.changed_db is not None] or [np.nan]
    median_db, changed_median_db = float(np.median(all_db)), float(np.median(changed_db))
    name = "vehicles"
    return [
        WorldRow(
            "views",
            f"{name}, median gain of {len(gains)}",
            "> 0 dB",
            f"{median_db:+.2f} dB",
            median_db > 0,
        ),
        WorldRow(
            "views", f"{name}, worst gain of {len(gains)}", "", f"{min(all_db):+.2f} dB", None
        ),
        WorldRow(
            "views",
            f"{name}, median gain in the pixels that differ from the empty street",
            ">= +2 dB",
            f"{changed_median_db:+.2f} dB",
            changed_median_db >= 2,
        ),
        WorldRow(
            "views",
            f"{name}, worst gain in the pixels that differ from the empty street",
            "",
            f"{min(changed_db):+.2f} dB",
            None,
        ),
    ]


@dataclass(frozen=True, eq=False)
class TruePictures:
    """The generator's view of ``camera``: now, and of the empty street."""

    camera: Camera
    now: Rgb
    empty: Rgb

    @property
    def changed(self) -> NDArray[np.bool_]:
        """Return where the street is not as it was, [H, W]."""
        difference = np.abs(self.now.astype(np.int16) - self.empty).max(axis=2)
        return np.asarray(difference > CHANGED_LEVELS)


def gain_of(field: RadianceField, live: LivePicture, true: TruePictures) -> Gain:
    """Return by how much ``live`` betters the view of the field where ``true`` was taken."""
    view = field.render(true.camera)
    alone = compose(true.camera, view, [], MAX_AGE_S)
    composed = compose(true.camera, view, [(live, LIVE_AGE_S)], MAX_AGE_S)
    all_db = psnr(composed.rgb, true.now) - psnr(alone.rgb, true.now)
    changed = true.changed
    if changed.mean() < LEAST_CHANGED:
        return Gain(all_db, None)
    before, after = (
        ((each.rgb.astype(float) - true.now)[changed] ** 2).mean() for each in (alone, composed)
    )
    return Gain(all_db, float(10 * np.log10(before / max(after, 1e-9))))


# --- cost


def cost_rows(asked: EvalWorld, field: RadianceField) -> list[WorldRow]:
    """Return what a view takes on one core, beside the field's own render, in turn."""
    drive = Drive.given(asked.vehicles)
    pictures = drive.pictures[-4:]
    lives = [live_picture(p.camera, p.read(), field.render(p.camera)) for p in pictures]
    camera = aside(pictures[-1].camera, 1.0)
    rgb, own = pictures[-1].read(), field.render(pictures[-1].camera)
    ground = FieldGround(field.render, field.metadata.vertical)
    lives = [cut_out(live, ground)[0] for live in lives]
    times: dict[str, list[float]] = {"render": [], "compose": [], "take up": [], "find": []}
    for _ in range(20):
        with _timed(times["render"]):
            view = field.render(camera)
        with _timed(times["compose"]):
            compose(camera, view, [(live, LIVE_AGE_S) for live in lives], MAX_AGE_S)
        with _timed(times["take up"]):
            live = live_picture(pictures[-1].camera, rgb, own)
        with _timed(times["find"]):
            find(live, ground)
    ms = {name: 1e3 * float(np.median(values)) for name, values in times.items()}
    renders = (ms["render"] + ms["compose"]) / ms["render"]
    k = camera.intrinsics
    what = f"{k.width_px}x{k.height_px}, {len(lives)} live pictures, one core"
    return [
        WorldRow(
            "cost",
            f"a view, {what}",
            "<= 2 renders",
            f"{renders:.2f} renders of {ms['render']:.1f} ms",
            renders <= 2,
        ),
        WorldRow(
            "cost",
            "a live picture, once for all views of it, beside its render",
            "",
            f"{ms['take up']:.1f} ms",
            None,
        ),
        WorldRow("cost", "the things in it", "", f"{ms['find']:.1f} ms", None),
    ]


@contextmanager
def _timed(seconds: list[float]) -> Iterator[None]:
    begin = time.process_time()
    yield
    seconds.append(time.process_time() - begin)


# --- processes


def notice_rows(asked: EvalWorld) -> list[WorldRow]:
    """Return the rows of the age of notices at arrival, since the capture of the picture that shows
    the object.

    Both vehicles are prerecorded: the cores are the server's.
    """
    field = load_field(asked.field)
    drives = [
        PrerecordedDrive.read(
            prerecorded_drive(Path(given.split(",")[1]), field, asked.work / "cache")
        )
        for given in (asked.vehicles, asked.empty)
    ]
    bed = TwinBed(asked.field, Path(asked.vehicles.split(",")[1]), asked.work, 0.0, 0.0)
    with bed.server() as server:
        ages_ms = asyncio.run(_ages_told_ms(asked, server.address, *drives))
    p50, p99 = np.percentile(ages_ms, (50, 99)) if ages_ms else (np.nan, np.nan)
    return [
        WorldRow(
            "notices",
            f"age on arrival at the other vehicle, {asked.notices_hz:g} Hz, p99",
            "<= 200 ms",
            f"{p99:.0f} ms (median {p50:.0f}) of {len(ages_ms)}",
            bool(p99 <= 200),
        ),
    ]


async def _ages_told_ms(
    asked: EvalWorld, address: str, seeing: PrerecordedDrive, told: PrerecordedDrive
) -> list[float]:
    """Drive both for a while; return the age of each notified object, in ms.

    Raises ``RfedgeError`` if the server does not take one of them.
    """
    heard: list[tuple[float, float]] = []

    def hear(notice: StreetNotice) -> None:
        if isinstance(notice.subject, ObjectAhead):
            heard.append((time.monotonic(), notice.subject.unseen_s))

    first = PrerecordedVehicle("seeing", address, seeing.hello, seeing)
    second = PrerecordedVehicle("told", address, replace(told.hello, take_notices=True), told)
    second.on_notice = hear
    await asyncio.gather(*(each.connect(CONNECT_S) for each in (first, second)))
    start_s, period_s = time.monotonic() + SETTLE_S, 1 / asked.notices_hz
    for number, vehicle in enumerate((first, second)):
        end_s = start_s + asked.seconds
        schedule = Schedule(start_s + number * period_s / 2, end_s, asked.notices_hz)
        vehicle.depart(schedule, end_s + DRAIN_S)
    await asyncio.gather(*(each.over.wait() for each in (first, second)))
    for each in (first, second):
        if problem := each.refused or each.failed:
            raise RfedgeError(f"a vehicle of the notices lost its stream: {problem}")
    captured_s = [shot.due_s for replay in first.replays for shot in replay.shots]
    return [1e3 * age_on_arrival_s(*each, captured_s) for each in heard]


def age_on_arrival_s(arrived_s: float, unseen_s: float, captured_s: Sequence[float]) -> float:
    """Return the age of a notice that arrived, which said ``unseen_s`` when it was sent: since the
    newest capture that can have been so old then.

    Right unless the notice was on its way for longer than from one capture to the next; one clock.
    Raises ``InvalidInput`` if there was no capture that early.
    """
    seen_by_s = arrived_s - unseen_s + LEAST_TOLD_S
    earlier_s = [at_s for at_s in captured_s if at_s <= seen_by_s]
    if not earlier_s:
        raise InvalidInput("unseen_s", f"{unseen_s:g} s is before the first capture")
    return arrived_s - max(earlier_s)


def ingest_rows(asked: EvalWorld) -> list[WorldRow]:
    """Return the rows of the p99 of ingest: alone, and beside work that runs on idle processors
    (live views requested again and again, and learning)."""
    drive = Drive.given(asked.vehicles)
    path = Path(asked.vehicles.split(",")[1])
    bed = TwinBed(asked.field, path, asked.work, asked.notices_hz, asked.seconds / 3)
    request = ViewRequest(
        aside(drive.pictures[len(drive.pictures) // 2].camera, 1.0),
        field_id=load_field(asked.field).field_id,
        encoding=PictureEncoding.JPEG,
    )
    alone_ms: list[float] = []
    viewed_ms: list[float] = []
    learning_ms: list[float] = []
    views = 0
    with bed.server() as server:
        for _ in range(asked.rounds):
            alone_ms += ingest_latencies_ms(bed, server)
            with _viewing(server.address, request) as seen:
                viewed_ms += ingest_latencies_ms(bed, server)
            views += len(seen)
            with _learning(asked, path):
                learning_ms += ingest_latencies_ms(bed, server)
    return [
        _beside(
            alone_ms, viewed_ms, "with a live view asked for again and again", f", {views} views"
        ),
        _beside(alone_ms, learning_ms, "while a field is learnt from the drive", ""),
    ]


def _beside(
    alone_ms: Sequence[float], beside_ms: Sequence[float], what: str, told: str
) -> WorldRow:
    alone, beside = (float(np.percentile(values, 99)) for values in (alone_ms, beside_ms))
    bound_ms = max(1.1 * alone, alone + 5)
    return WorldRow(
        "ingest",
        f"p99 {what}",
        f"<= {bound_ms:.0f} ms (+10 % or +5 ms)",
        f"{alone:.0f} -> {beside:.0f} ms{told}",
        beside <= bound_ms,
    )


@contextmanager
def _learning(asked: EvalWorld, drive: Path) -> Iterator[None]:
    """Learn from a drive as the server's learning process does, on one core and while it is idle;
    raise ``RfedgeError`` if it ended with an error before the block did."""
    out, log = asked.work / "learnt.rff", asked.work / "learning.log"
    update = (
        "field",
        "update",
        asked.field,
        "--from",
        drive,
        "--min-identities",
        "1",
        "--out",
        out,
    )
    command = [*command_of("rfedge"), *map(str, update)]
    with log.open("wb") as file:
        learning = subprocess.Popen(
            command,
            stdout=file,
            stderr=file,
            env={**os.environ, **ONE_THREAD},
            preexec_fn=lambda: os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0)),
        )
    try:
        yield
        if learning.poll():
            raise RfedgeError(f"learning failed; see {log}")
    finally:
        learning.kill()
        learning.wait()


@contextmanager
def _viewing(address: str, request: ViewRequest) -> Iterator[list[int]]:
    """Ask for views, one after the other, until the block ends; yield the numbers of those seen."""
    seen: list[int] = []
    over = Event()

    def look() -> None:
        with TwinClient(address) as client:
            while not over.is_set():
                seen.append(client.render(replace(request, number=len(seen))).number)

    thread = Thread(target=look, name="viewer")
    thread.start()
    try:
        yield seen
    finally:
        over.set()
        thread.join()
