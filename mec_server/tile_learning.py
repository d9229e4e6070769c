"""The work of the learning process: one round over the published tiles at a time.

Files: the recordings of ``mec_server.recorder``, the folder of fields, and RECORDINGS/.learning/:
``tiles.json``, what was learnt, tried and withdrawn of each tile (``TileHistory``), and a lock that
one process holds. A round first checks what was published (``withdraw_worse``): the newest frames
that vehicles coded against a learnt field are coded again against it and against the field that it
replaced; for vehicles that are not recorded the server does that, and reports the result
(``report``). Then it learns (``learn``): from passes that are over and were not used before, sorted
by light, without outliers; the result is tried on frames held back and published as ``rfedge field
publish --light`` does. Publishing is one rename of the manifest, so a round may end anywhere. An
identity is the id of a vehicle, which a certificate ties to it where the server asks for one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import structlog

from mec_server.recorded_passes import (
    RecordedPass,
    Recordings,
    by_light,
    hour_of,
    light_of,
    pass_of,
    readable,
)
from mec_server.tile_history import LEARNING, Learnt, TileHistory, read_histories, write_histories
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.field import RadianceField, save_field
from rfcore.field.store import load_checked
from rfcore.update.passes import (
    FEWEST_FRAMES,
    Pass,
    SeenFrame,
    split_frames,
    without_outliers,
)
from rfcore.update.run import LearnAs, Update, UpdateSettings, learn_from, saved_percent, try_field
from rfcore.update.splats import FineTuning
from rfcore.views import spread
from rfcore.wire.tile_manifest import (
    Ground,
    TileVersions,
    VersionLabel,
    publish,
    read_publication,
    roll_back,
)
from rfcore.wire.tiles import Tile

log = structlog.get_logger()

MOST_PASSES = 6
CHECK_FRAMES = 8
"""Frames in a row that are coded to check whether a published field increases bits."""
CHECK_EVERY = 24
"""Frames of one camera between two checks; an increase is seen after at most twice as many."""
HOUR_MS = 3_600_000
WATCH_EVERY_MS = 500
"""Period of checks of published fields while another is learnt or tried: with 24 frames between two
checks an increase in bits is seen within 50 frames, at 10 and 30 Hz."""
AGAIN_MS = 600_000
"""Recordings that could not be learnt from are tried again after this time, or when there are
more."""
FRESH_S = 120.0
"""A recording to which nothing was added for this long is not checked for withdrawals."""


@dataclass(frozen=True)
class LearningJob:
    """The settings of the learning process; see ``mec_server.config.LearnSettings``."""

    fields: Path
    recordings: Path
    learn_as: LearnAs = LearnAs.COLOURS
    min_identities: int = 2
    frames: int = 48
    iterations: int = 600
    cpu_s_per_h: float = 900.0
    max_bytes: int = 10**9
    max_age_s: float = 86_400.0
    quiet_s: float = 20.0
    """A pass is over when nothing was added to its recording for this long."""
    max_field_bytes: int = 2 << 30

    def settings(self) -> UpdateSettings:
        """Return how an update is made and judged."""
        fine_tuning = FineTuning(self.iterations)
        return UpdateSettings(
            self.learn_as, self.frames, self.min_identities, fine_tuning=fine_tuning
        )


@dataclass(frozen=True)
class BitsIncrease:
    """The increase in bits, in percent, of a vehicle that is not recorded, for a learnt field over
    the field that it replaced; negative for a decrease."""

    tile: str
    field_id: str
    vehicle: str
    percent: float


def percent_worse(before: RadianceField, after: RadianceField, drive: Pass) -> float:
    """Return the increase in bits, in percent, of the newest ``CHECK_FRAMES`` of a pass for
    ``after`` over ``before``; 0 for fewer frames, or for frames that agree with no field."""
    newest = Pass(drive.identity, drive.pictures[-CHECK_FRAMES:])
    if len(newest.pictures) < CHECK_FRAMES or not without_outliers(after, [newest]):
        return 0.0
    frames = [SeenFrame(one.camera.rounded(), one.read(), 0) for one in newest.pictures]
    return -saved_percent(try_field(before, frames), try_field(after, frames))[0]


class BudgetSpent(Exception):
    """The CPU time of this hour is spent; the round goes on when there is more."""


class LearningRounds:
    """Runs one round after the other; ``now_ms`` is the time of the Unix epoch."""

    def __init__(self, job: LearningJob, now_ms: Callable[[], int]) -> None:
        self._job, self._now_ms = job, now_ms
        self._learners: dict[str, TileLearner] = {}
        self._reports: SimpleQueue[BitsIncrease] = SimpleQueue()

    def report(self, harm: BitsIncrease) -> None:
        """Take a report of the server; may be called by another thread than ``run``."""
        self._reports.put(harm)

    def run(self) -> None:
        """Withdraw fields that increased bits, then learn.

        A tile or a disk that fails is logged, and tried again later. Raises ``InvalidInput`` for a
        damaged history, ``FieldFormatError`` for a damaged manifest, ``OSError``.
        """
        (self._job.recordings / LEARNING).mkdir(parents=True, exist_ok=True)
        histories = read_histories(self._job.recordings)
        for name in read_publication(self._job.fields).tiles:
            if name not in self._learners:
                self._learners[name] = TileLearner(self._job, name, self._now_ms)
        for learner in self._learners.values():
            learner.histories = histories
        self._watch()
        for learner in self._learners.values():
            _attempt(learner, partial(learner.learn, self._watch))

    def _watch(self) -> None:
        while not self._reports.empty():
            harm = self._reports.get()
            if harm.tile in self._learners:
                learner = self._learners[harm.tile]
                _attempt(learner, partial(learner.withdraw_reported, harm))
        for learner in self._learners.values():
            _attempt(learner, learner.withdraw_worse)


def _attempt(learner: TileLearner, work: Callable[[], None]) -> None:
    try:
        work()
    except BudgetSpent as error:
        log.info("learning postponed", tile=learner.name, reason=str(error))
    except (RfedgeError, OSError) as error:
        log.error("learning failed", tile=learner.name, problem=str(error))


class TileLearner:
    """Learns about one tile; ``histories`` are written at each change."""

    def __init__(self, job: LearningJob, name: str, now_ms: Callable[[], int]) -> None:
        self.name = name
        self.histories: dict[str, TileHistory] = {}
        self._job, self._now_ms = job, now_ms
        self._recordings = Recordings(job.recordings, now_ms)
        self._watched_ms = now_ms()
        self._fields: dict[str, RadianceField] = {}
        self._looked_at: object = None

    @property
    def history(self) -> TileHistory:
        """The tile's history so far."""
        return self.histories.get(self.name, TileHistory())

    def _keep(self, **changes: Any) -> None:
        self.histories[self.name] = replace(self.history, **changes)
        write_histories(self._job.recordings, self.histories)

    # --- what was published

    def withdraw_worse(self) -> None:
        """Withdraw each current learnt field that increases the bits of a vehicle, and count it."""
        for one in self._current():
            self._check(one)

    def withdraw_reported(self, harm: BitsIncrease) -> None:
        """Withdraw a current field that increases the bits of a vehicle that is not recorded, and
        count it."""
        if harm.percent > self._job.settings().max_loss_percent:
            for one in self._current():
                if one.field_id == harm.field_id:
                    self._withdraw(one, harm.vehicle, harm.percent)

    def _current(self) -> Iterator[Learnt]:
        """Yield the learnt lights that are published."""
        versions = self._versions()
        for light in ("", *versions.lights):
            number = versions.lights[light] if light else versions.current
            for one in self.history.learnt:
                if one.field_id == versions.version(number).field_id and not one.withdrawn:
                    yield one

    def _check(self, one: Learnt) -> None:
        for part in readable(self._recordings.files(FRESH_S)):
            pictures = [p for p in part.pictures if p.field_id == one.field_id]
            key = f"{self._recordings.name_of(part.file)} {one.field_id}"
            new = len(pictures) - self.history.checked.get(key, 0)
            if new < CHECK_EVERY:
                continue
            self._keep(checked={**self.history.checked, key: len(pictures)})
            origin = self._open(one.replaced_id).metadata.tile_origin
            drive = pass_of(part, {one.field_id}, origin)
            before, after = self._open(one.replaced_id), self._open(one.field_id)
            worse = percent_worse(before, after, drive)
            if worse > self._job.settings().max_loss_percent:
                self._withdraw(one, drive.identity, worse)
                return

    def _withdraw(self, one: Learnt, identity: str, worse_percent: float) -> None:
        versions = self._versions()
        before = [n for n in versions.of_light(one.light) if _id(versions, n) == one.replaced_id]
        to = before[-1] if before else None
        tile = roll_back(self._job.fields, self.name, to, one.light)
        learnt = (replace(x, withdrawn=x.withdrawn or x == one) for x in self.history.learnt)
        self._keep(learnt=tuple(learnt))
        log.warning(
            "update withdrawn",
            tile=tile.name,
            light=one.light,
            field=one.field_id,
            vehicle=identity,
            bits_worse_percent=round(worse_percent, 1),
        )

    # --- what is to be learnt

    def learn(self, watch: Callable[[], None]) -> None:
        """Learn from each light's passes that were not used, and publish what pays.

        ``watch`` is called twice a second. Raises ``BudgetSpent``, ``RfedgeError``, ``OSError``.
        """
        versions = self._versions()
        files = self._new_files()
        looked_at = (files, versions, self._now_ms() // AGAIN_MS)
        if looked_at == self._looked_at:
            return
        self._looked_at = looked_at
        self._fields.clear()
        seen = list(self._seen_passes(files, versions))
        for light, group in by_light(seen, versions):
            of_light = group[-MOST_PASSES:]
            if len({one.drive.identity for one in of_light}) >= self._job.min_identities:
                self._learn_light(versions.tile(self.name), light, of_light, watch)

    def _learn_light(
        self, tile: Tile, light: str, group: Sequence[RecordedPass], watch: Callable[[], None]
    ) -> None:
        current = {"": tile.field_id, **{one.name: one.field_id for one in tile.lights}}
        replaced_id = current.get(light, tile.field_id)
        judged_by = self._open(replaced_id)
        honest = without_outliers(judged_by, [one.drive for one in group])
        dropped = len(group) - len(honest)
        lines = log.bind(tile=tile.name, light=light, passes=len(honest), dropped=dropped)
        if len({drive.identity for drive in honest}) < self._job.min_identities:
            self._tried([one for one in group if one.drive.identity not in _identities(honest)])
            lines.info("not learnt", reason="passes of too few vehicles agree with each other")
            return
        learn_as = self._job.learn_as if light else LearnAs.ALL
        base = self._open(tile.field_id) if learn_as is LearnAs.COLOURS else judged_by
        update = self._within_budget(base, honest, learn_as, watch)
        refused = update.refused or self._refused_beside(update, judged_by, base, honest, watch)
        if refused:
            lines.info("update not kept", reason=refused)
        else:
            self._publish(tile, light, replaced_id, update, group, honest)
        self._tried(group)

    def _refused_beside(
        self,
        update: Update,
        current: RadianceField,
        base: RadianceField,
        passes: Sequence[Pass],
        watch: Callable[[], None],
    ) -> str:
        """Return why an update that beats the tile's own field is no better than the light's; empty
        if it is."""
        if current is base:
            return ""
        _, held_back = split_frames(passes, self._job.frames)
        told = partial(self._watch_now_and_then, watch)
        saved = saved_percent(
            *(try_field(field, held_back, told) for field in (current, update.learnt))
        )
        settings = self._job.settings()
        if min(saved.values()) < -settings.max_loss_percent:
            return "bits rise against the light's field"
        mean = float(np.mean(list(saved.values())))
        return "" if mean >= settings.min_saved_percent else "no better than the light's field"

    def _within_budget(
        self,
        base: RadianceField,
        passes: Sequence[Pass],
        learn_as: LearnAs,
        watch: Callable[[], None],
    ) -> Update:
        left_s, began_s = self._cpu_left_s(), time.process_time()

        def told(doing: str, done: int, total: int) -> None:
            if time.process_time() - began_s > left_s:
                limit = f"{self._job.cpu_s_per_h:g} s of this hour are spent"
                raise BudgetSpent(f"{limit}, {doing}: {done} of {total}")
            self._watch_now_and_then(watch)

        told("learning", 0, 1)
        try:
            settings = replace(self._job.settings(), learn_as=learn_as)
            return learn_from(base, passes, settings, told)
        finally:
            spent = (self._now_ms(), time.process_time() - began_s)
            self._keep(cpu=(*self._cpu_of_the_hour(), spent))

    def _watch_now_and_then(self, watch: Callable[[], None]) -> None:
        if self._now_ms() - self._watched_ms > WATCH_EVERY_MS:
            self._watched_ms = self._now_ms()
            watch()

    def _cpu_of_the_hour(self) -> tuple[tuple[int, float], ...]:
        since_ms = self._now_ms() - HOUR_MS
        return tuple((at, spent) for at, spent in self.history.cpu if at > since_ms)

    def _cpu_left_s(self) -> float:
        return self._job.cpu_s_per_h - sum(spent for _, spent in self._cpu_of_the_hour())

    def _publish(
        self,
        tile: Tile,
        light: str,
        replaced_id: str,
        update: Update,
        group: Sequence[RecordedPass],
        honest: Sequence[Pass],
    ) -> None:
        passes, identities = len(honest), len(_identities(honest))
        hour = float(np.mean([hour_of(one.first_ns) for one in group]))
        archive = self._job.recordings / LEARNING / f"{tile.name}.rff"
        field_id = save_field(update.learnt, archive)
        self._check_room(archive.stat().st_size)
        now_ms = self._now_ms()
        saved = Learnt(
            field_id,
            light,
            replaced_id,
            passes,
            update.mean_saved_percent,
            now_ms,
            identities=identities,
        )
        self._keep(learnt=(*self.history.learnt, saved))
        label = VersionLabel(light, "", passes, hour if light else None)
        now = datetime.fromtimestamp(now_ms / 1e3, UTC)
        try:
            publish(self._job.fields, tile.name, archive, Ground(), now, label, only_after=tile)
        finally:
            archive.unlink()
        log.info(
            "update published",
            tile=tile.name,
            light=light,
            field=field_id,
            passes=passes,
            identities=identities,
            saved_percent=round(update.mean_saved_percent, 1),
        )

    def _check_room(self, wanted_bytes: int) -> None:
        """Remove the oldest learnt archives that no vehicle is sent any more, until one more
        fits."""
        tile = self._versions().tile(self.name)
        paths = {
            one.field_id: self._job.fields / f"{one.field_id}.rff"
            for history in self.histories.values()
            for one in history.learnt
        }
        sizes = {name: path.stat().st_size for name, path in paths.items() if path.exists()}
        for one in self.history.learnt:
            if sum(sizes.values()) + wanted_bytes <= self._job.max_bytes:
                return
            if one.field_id in sizes and one.field_id not in tile.archive_ids:
                paths[one.field_id].unlink()
                del sizes[one.field_id]
        if sum(sizes.values()) + wanted_bytes > self._job.max_bytes:
            raise InvalidInput(
                "learn-max-gb",
                f"{self._job.max_bytes / 1e9:g} do not hold {wanted_bytes} bytes more; give more, "
                "or withdraw lights that are not needed",
            )

    # --- recordings

    def _tried(self, group: Sequence[RecordedPass]) -> None:
        there = {
            self._recordings.name_of(file) for file in self._recordings.files(self._job.max_age_s)
        }
        tried = there & {*self.history.tried, *(one.name for one in group)}
        checked = {key: n for key, n in self.history.checked.items() if key.split()[0] in there}
        self._keep(tried=tuple(sorted(tried)), checked=checked)

    def _new_files(self) -> list[Path]:
        """Return the recordings that are over and were not used, oldest first."""
        return [
            file
            for file in self._recordings.files(self._job.max_age_s)
            if self._recordings.name_of(file) not in self.history.tried
            and self._recordings.age_s(file) >= self._job.quiet_s
        ]

    def _seen_passes(self, files: Sequence[Path], versions: TileVersions) -> Iterator[RecordedPass]:
        tile = versions.tile(self.name)
        own = self._open(tile.field_id)
        fields = {"": own, **{one.name: self._open(one.field_id) for one in tile.other_lights}}
        for part in readable(files):
            drive = pass_of(part, frozenset(versions.field_ids), own.metadata.tile_origin)
            if len(drive.pictures) >= FEWEST_FRAMES:
                few = replace(drive, pictures=tuple(spread(drive.pictures, self._job.frames)))
                first_ns = part.pictures[0].capture_time_ns
                yield RecordedPass(
                    self._recordings.name_of(part.file), few, first_ns, *light_of(few, fields)
                )

    # --- fields

    def _versions(self) -> TileVersions:
        return read_publication(self._job.fields).tiles[self.name]

    def _open(self, field_id: str) -> RadianceField:
        if field_id not in self._fields:
            path = self._job.fields / f"{field_id}.rff"
            self._fields[field_id] = load_checked(
                path, field_id, max_bytes=self._job.max_field_bytes, open_base=self._open
            )
        return self._fields[field_id]


def _id(versions: TileVersions, number: int) -> str:
    return versions.version(number).field_id


def _identities(passes: Sequence[Pass]) -> frozenset[str]:
    return frozenset(drive.identity for drive in passes)
