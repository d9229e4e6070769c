"""Pictures are kept whole and in order, as datasets; a disk that refuses is reported once."""

import errno
import os
import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mec_server import recorder as module
from mec_server.recorder import (
    FieldTiles,
    KeepLimits,
    Recorder,
    SessionRecording,
    picture_name,
)
from recorded import recorded, recorded_parts
from rfcore.camera import TileOrigin
from rfcore.dataset import read_dataset
from rfcore.image import I420, png_bytes
from rfcore.wire.messages import Hello

FIELD, EAST = "ab" * 32, "cd" * 32
ORIGIN = TileOrigin(500_000.0, 5_300_000.0, 500.0)


def grey(level: int) -> I420:
    half = np.full((8, 16), 128, np.uint8)
    return I420(np.full((16, 32), level, np.uint8), half, half)


class Clock:
    def __init__(self) -> None:
        self.ms = 1_000_000_000_000

    def __call__(self) -> int:
        return self.ms


@pytest.fixture
def clock() -> Clock:
    return Clock()


class Folder:
    """A folder that is recorded into: opens recorders, and saves a vehicle's pictures."""

    def __init__(self, path: Path, clock: Clock, hello: Hello, make_frame: Any) -> None:
        self.path = path
        self.lost = 0
        self.make_frame = make_frame
        self._clock = clock
        self._hello = hello

    def open(
        self,
        on_failure: Callable[[Exception], None] = pytest.fail,  # type: ignore[assignment]
        max_bytes: int = 10**9,
        max_age_s: float = 1e9,
    ) -> Recorder:
        limits = KeepLimits(max_bytes, max_age_s)
        origins, names = {FIELD: ORIGIN, EAST: ORIGIN}, {FIELD: "west", EAST: "east", "": ""}
        tiles = FieldTiles(origins.__getitem__, names.__getitem__)
        return Recorder(self.path, limits, tiles, self._clock, on_failure, self.dropped)

    def dropped(self) -> None:
        self.lost += 1

    def session(
        self, recorder: Recorder, session_id: str = "s1", **changes: Any
    ) -> SessionRecording:
        """Return the recording of a vehicle that agreed."""
        hello = replace(self._hello, allow_recording=True, **changes)
        session = recorder.session(session_id, hello)
        assert session is not None
        return session

    def save(self, session: SessionRecording, count: int, field_id: str = FIELD) -> None:
        """Save so many pictures of the front camera."""
        for sequence in range(count):
            session.save(self.make_frame(sequence), field_id, grey(50))

    def size_bytes(self) -> int:
        return sum(p.stat().st_size for p in self.path.rglob("*") if p.is_file())


@pytest.fixture
def folder(
    tmp_path: Path,
    clock: Clock,
    hello: Hello,
    make_frame: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> Folder:
    monkeypatch.setattr(module, "MAX_WAITING", 1000)  # so that tests of what is kept lose nothing
    monkeypatch.setattr(os, "fsync", lambda _: None)  # tests/test_files.py has the power cuts
    return Folder(tmp_path, clock, hello, make_frame)


def test_what_was_recorded_is_a_dataset_in_the_world_of_its_fields(
    folder: Folder, hello: Hello
) -> None:
    recorder = folder.open()
    session = folder.session(recorder)
    for sequence in range(3):
        frame = replace(folder.make_frame(sequence), capture_time_ns=10**9 + sequence * 10**8)
        session.save(frame, FIELD, grey(50 + 50 * sequence))
    recorder.close()
    (part,) = recorded_parts(folder.path, "cav-1", "front")
    assert (part.camera.session_id, part.camera.intrinsics) == ("s1", hello.cameras[0].intrinsics)
    assert [picture.sequence for picture in part.pictures] == [0, 1, 2]
    assert {picture.field_id for picture in part.pictures} == {FIELD}
    for number, picture in enumerate(part.pictures):
        assert picture.digest == grey(50 + 50 * number).digest().hex()
    dataset = read_dataset(folder.path)
    assert dataset.rate_hz == pytest.approx(10)
    assert dataset.tile_origin == ORIGIN
    assert all(p.camera.world_from_cam == folder.make_frame(0).pose for p in dataset.pictures)
    assert dataset.pictures[0].read().shape == (16, 32, 3)


def test_nothing_is_kept_of_a_vehicle_that_did_not_agree(folder: Folder, hello: Hello) -> None:
    recorder = folder.open()
    assert recorder.session("s1", hello) is None
    recorder.close()
    assert list(folder.path.iterdir()) == []


def test_a_picture_of_a_lost_camera_is_kept_and_no_picture_of_the_dataset(folder: Folder) -> None:
    recorder = folder.open()
    session = folder.session(recorder)
    folder.save(session, 1)
    session.save(replace(folder.make_frame(1), pose=None), FIELD, grey(60))
    recorder.close()
    assert [p.world_from_cam is None for p in recorded(folder.path)] == [False, True]
    dataset = read_dataset(folder.path)
    assert (len(dataset.pictures), dataset.sorted_out) == (1, 1)


def test_a_later_epoch_overwrites_nothing(folder: Folder) -> None:
    names = [picture_name(folder.make_frame(7, epoch=epoch)) for epoch in (0, 3)]
    assert names == ["000007.png", "e0003-000007.png"]


def test_time_that_goes_back_begins_a_new_part(folder: Folder) -> None:
    recorder = folder.open()
    session = folder.session(recorder)
    for sequence, time_ns in enumerate((5, 6, 2, 3)):
        frame = replace(folder.make_frame(sequence), capture_time_ns=time_ns)
        session.save(frame, FIELD, grey(50))
    recorder.close()
    times = [[p.capture_time_ns for p in part.pictures] for part in recorded_parts(folder.path)]
    assert times == [[5, 6], [2, 3]]
    assert [p.time_ns for p in read_dataset(folder.path).pictures] == [2, 3, 5, 6]


def test_two_cameras_have_folders_of_their_own(folder: Folder) -> None:
    recorder = folder.open()
    session = folder.session(recorder)
    for camera in ("front", "rear"):
        session.save(folder.make_frame(0, camera_id=camera), FIELD, grey(100))
    recorder.close()
    assert sorted(p.name for p in (folder.path / "cav-1").iterdir()) == ["front", "rear"]
    names = [picture.name for picture in read_dataset(folder.path).pictures]
    assert len(set(names)) == 2


def test_bytes_stay_within_the_bound_and_the_newest_pictures_stay(folder: Folder) -> None:
    recorder = folder.open(max_bytes=20_000)
    folder.save(folder.session(recorder), 200)
    recorder.close()
    assert folder.size_bytes() <= 20_000
    kept = [picture.sequence for picture in recorded(folder.path)]
    assert 10 < len(kept) < 200
    assert kept == list(range(200 - len(kept), 200))


def reopened(folder: Folder, recorder: Recorder, again: bool) -> Recorder:
    """Return a recorder of 20 kB: the same, or one that begins ``again``."""
    if not again:
        return recorder
    recorder.close()
    return folder.open(max_bytes=20_000)


AGAIN = pytest.mark.parametrize("again", [False, True], ids=["in one run", "after a restart"])


@AGAIN
def test_a_busy_vehicle_evicts_its_own_pictures_and_no_other_vehicles(
    folder: Folder, again: bool
) -> None:
    recorder = folder.open(max_bytes=20_000)
    folder.save(folder.session(recorder, "s1", vehicle_id="quiet"), 5)
    recorder = reopened(folder, recorder, again)
    folder.save(folder.session(recorder, "s2", vehicle_id="busy"), 300)
    recorder.close()
    assert len(recorded(folder.path, "quiet")) == 5
    assert 10 < len(recorded(folder.path, "busy")) < 300
    assert folder.size_bytes() <= 20_000


@AGAIN
def test_a_busy_tile_evicts_no_other_tiles_pictures(folder: Folder, again: bool) -> None:
    """Many vehicles of one tile, each with fewer bytes than the only one of the other."""
    recorder = folder.open(max_bytes=20_000)
    both = {"field_ids": (FIELD, EAST)}
    folder.save(folder.session(recorder, "s1", vehicle_id="only", **both), 15, EAST)
    recorder = reopened(folder, recorder, again)
    for number in range(40):
        one = folder.session(recorder, f"t{number}", vehicle_id=f"v{number}", **both)
        folder.save(one, 5)
    recorder.close()
    assert len(recorded(folder.path, "only")) == 15
    assert recorded(folder.path, "v0") == []
    assert len(recorded(folder.path, "v39")) == 5


def test_a_recording_that_is_too_old_is_deleted_by_the_next_picture(
    folder: Folder, clock: Clock
) -> None:
    for start_ms, session_id in ((clock.ms, "old"), (clock.ms + 3_600_000, "new")):
        clock.ms = start_ms
        recorder = folder.open(max_age_s=1800.0)
        folder.save(folder.session(recorder, session_id), 1)
        recorder.close()
    assert [part.camera.session_id for part in recorded_parts(folder.path)] == ["new"]


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("write_whole", OSError(errno.ENOSPC, "No space left on device")),
        ("png_bytes", ValueError("of the writer")),
    ],
    ids=["a full disk", "an error that is not the disk's"],
)
def test_a_failure_stops_the_recording_once_and_blocks_no_worker(
    folder: Folder, monkeypatch: pytest.MonkeyPatch, name: str, error: Exception
) -> None:
    def broken(*_: object) -> None:
        raise error

    monkeypatch.setattr(module, name, broken)
    failures: list[Exception] = []
    recorder = folder.open(failures.append)
    folder.save(folder.session(recorder), 5)
    recorder.close()
    assert failures == [error]


def test_a_slow_disk_loses_pictures_of_the_recording_and_holds_up_nobody(
    folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, may_write = threading.Event(), threading.Event()

    def slow(picture: np.ndarray[Any, Any]) -> bytes:
        begun.set()
        assert may_write.wait(10)
        return png_bytes(picture)

    monkeypatch.setattr(module, "png_bytes", slow)
    monkeypatch.setattr(module, "MAX_WAITING", 4)
    recorder = folder.open()
    session = folder.session(recorder)
    folder.save(session, 1)
    assert begun.wait(10)
    for sequence in range(1, 10):
        session.save(folder.make_frame(sequence), FIELD, grey(50))
    may_write.set()
    recorder.close()
    assert [picture.sequence for picture in recorded(folder.path)] == [0, 1, 2, 3, 4]
    assert folder.lost == 5


def test_a_part_that_somebody_removes_is_begun_anew(folder: Folder) -> None:
    recorder = folder.open()
    session = folder.session(recorder)
    folder.save(session, 1)
    while not recorded(folder.path):
        time.sleep(0.001)
    shutil.rmtree(folder.path / "cav-1")
    session.save(folder.make_frame(7), FIELD, grey(50))
    recorder.close()
    assert [picture.sequence for picture in recorded(folder.path)] == [7]


def test_a_vehicle_of_which_nothing_is_left_leaves_no_folder(folder: Folder, clock: Clock) -> None:
    recorder = folder.open(max_age_s=1800.0)
    folder.save(folder.session(recorder, vehicle_id="gone"), 1)
    recorder.close()
    clock.ms += 3_600_000
    recorder = folder.open(max_age_s=1800.0)
    folder.save(folder.session(recorder), 1)
    recorder.close()
    assert [path.name for path in folder.path.iterdir()] == ["cav-1"]
