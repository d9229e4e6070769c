"""Pictures are kept whole and in order, as datasets; a disk that refuses is reported once."""

import errno
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

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
from rfcore.image import I420
from rfcore.wire.messages import Frame, Hello

MakeFrame = Callable[..., Frame]
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


@pytest.fixture
def open_recorder(tmp_path: Path, clock: Clock) -> Callable[..., Recorder]:
    def make(
        on_failure: Callable[[Exception], None] = pytest.fail,  # type: ignore[assignment]
        max_bytes: int = 10**9,
        max_age_s: float = 1e9,
    ) -> Recorder:
        limits = KeepLimits(max_bytes, max_age_s)
        origins, names = {FIELD: ORIGIN, EAST: ORIGIN}, {FIELD: "west", EAST: "east", "": ""}
        tiles = FieldTiles(origins.__getitem__, names.__getitem__)
        return Recorder(tmp_path, limits, tiles, clock, on_failure)

    return make


def agreed(recorder: Recorder, hello: Hello, session_id: str = "s1") -> SessionRecording:
    session = recorder.session(session_id, replace(hello, allow_recording=True))
    assert session is not None
    return session


def test_what_was_recorded_is_a_dataset_in_the_world_of_its_fields(
    make_frame: MakeFrame, hello: Hello, open_recorder: Callable[..., Recorder], tmp_path: Path
) -> None:
    recorder = open_recorder()
    session = agreed(recorder, hello)
    for sequence in range(3):
        frame = replace(make_frame(sequence), capture_time_ns=10**9 + sequence * 10**8)
        session.save(frame, FIELD, grey(50 + 50 * sequence))
    recorder.close()
    (part,) = recorded_parts(tmp_path, "cav-1", "front")
    assert (part.camera.session_id, part.camera.intrinsics) == ("s1", hello.cameras[0].intrinsics)
    assert [picture.sequence for picture in part.pictures] == [0, 1, 2]
    assert {picture.field_id for picture in part.pictures} == {FIELD}
    for number, picture in enumerate(part.pictures):
        assert picture.digest == grey(50 + 50 * number).digest().hex()
    dataset = read_dataset(tmp_path)
    assert dataset.rate_hz == pytest.approx(10)
    assert dataset.tile_origin == ORIGIN
    assert all(p.camera.world_from_cam == make_frame(0).pose for p in dataset.pictures)
    assert dataset.pictures[0].read().shape == (16, 32, 3)


def test_nothing_is_kept_of_a_vehicle_that_did_not_agree(
    hello: Hello, open_recorder: Callable[..., Recorder], tmp_path: Path
) -> None:
    recorder = open_recorder()
    assert recorder.session("s1", hello) is None
    recorder.close()
    assert list(tmp_path.iterdir()) == []


def test_a_picture_of_a_lost_camera_is_kept_and_no_picture_of_the_dataset(
    make_frame: MakeFrame, hello: Hello, open_recorder: Callable[..., Recorder], tmp_path: Path
) -> None:
    recorder = open_recorder()
    session = agreed(recorder, hello)
    session.save(make_frame(0), FIELD, grey(50))
    session.save(replace(make_frame(1), pose=None), FIELD, grey(60))
    recorder.close()
    assert [p.world_from_cam is None for p in recorded(tmp_path)] == [False, True]
    dataset = read_dataset(tmp_path)
    assert (len(dataset.pictures), dataset.sorted_out) == (1, 1)


def test_a_later_epoch_overwrites_nothing(make_frame: MakeFrame) -> None:
    names = [picture_name(make_frame(7, epoch=epoch)) for epoch in (0, 3)]
    assert names == ["000007.png", "e0003-000007.png"]


def test_time_that_goes_back_begins_a_new_part(
    make_frame: MakeFrame, hello: Hello, open_recorder: Callable[..., Recorder], tmp_path: Path
) -> None:
    recorder = open_recorder()
    session = agreed(recorder, hello)
    for sequence, time_ns in enumerate((5, 6, 2, 3)):
        session.save(replace(make_frame(sequence), capture_time_ns=time_ns), FIELD, grey(50))
    recorder.close()
    times = [[p.capture_time_ns for p in part.pictures] for part in recorded_parts(tmp_path)]
    assert times == [[5, 6], [2, 3]]
    assert [p.time_ns for p in read_dataset(tmp_path).pictures] == [2, 3, 5, 6]


def test_two_cameras_have_folders_of_their_own(
    make_frame: MakeFrame, hello: Hello, open_recorder: Callable[..., Recorder], tmp_path: Path
) -> None:
    recorder = open_recorder()
    session = agreed(recorder, hello)
    for camera in ("front", "rear"):
        session.save(make_frame(0, camera_id=camera), FIELD, grey(100))
    recorder.close()
    assert sorted(p.name for p in (tmp_path / "cav-1").iterdir()) == ["front", "rear"]
    names = [picture.name for picture in read_dataset(tmp_path).pictures]
    assert len(set(names)) == 2


def test_bytes_stay_within_the_bound_and_the_newest_pictures_stay(
    make_frame: MakeFrame, hello: Hello, open_recorder: Callable[..., Recorder], tmp_path: Path
) -> None:
    recorder = open_recorder(max_bytes=20_000)
    session = agreed(recorder, hello)
    for sequence in range(200):
        session.save(make_frame(sequence), FIELD, grey(50))
    recorder.close()
    assert sum(p.stat().st_size for p in tmp_path.rglob("*") if p.is_file()) <= 20_000
    kept = [picture.sequence for picture in recorded(tmp_path)]
    assert 10 < len(kept) < 200
    assert kept == list(range(200 - len(kept), 200))


@pytest.mark.parametrize("again", [False, True], ids=["in one run", "after a restart"])
def test_a_busy_vehicle_evicts_its_own_pictures_and_no_other_vehicles(
    make_frame: MakeFrame,
    hello: Hello,
    open_recorder: Callable[..., Recorder],
    tmp_path: Path,
    again: bool,
) -> None:
    recorder = open_recorder(max_bytes=20_000)
    quiet = agreed(recorder, replace(hello, vehicle_id="quiet"), "s1")
    for sequence in range(5):
        quiet.save(make_frame(sequence), FIELD, grey(50))
    if again:
        recorder.close()
        recorder = open_recorder(max_bytes=20_000)
    busy = agreed(recorder, replace(hello, vehicle_id="busy"), "s2")
    for sequence in range(300):
        busy.save(make_frame(sequence), FIELD, grey(50))
    recorder.close()
    assert len(recorded(tmp_path, "quiet")) == 5
    assert 10 < len(recorded(tmp_path, "busy")) < 300
    assert sum(p.stat().st_size for p in tmp_path.rglob("*") if p.is_file()) <= 20_000


@pytest.mark.parametrize("again", [False, True], ids=["in one run", "after a restart"])
def test_a_busy_tile_evicts_no_other_tiles_pictures(
    make_frame: MakeFrame,
    hello: Hello,
    open_recorder: Callable[..., Recorder],
    tmp_path: Path,
    again: bool,
) -> None:
    """Many vehicles of one tile, each with fewer bytes than the only one of the other."""
    recorder = open_recorder(max_bytes=20_000)
    hello = replace(hello, field_ids=(FIELD, EAST))
    only = agreed(recorder, replace(hello, vehicle_id="only"), "s1")
    for sequence in range(15):
        only.save(make_frame(sequence), EAST, grey(50))
    if again:
        recorder.close()
        recorder = open_recorder(max_bytes=20_000)
    for number in range(40):
        one = agreed(recorder, replace(hello, vehicle_id=f"v{number}"), f"t{number}")
        for sequence in range(5):
            one.save(make_frame(sequence), FIELD, grey(50))
    recorder.close()
    assert len(recorded(tmp_path, "only")) == 15
    assert recorded(tmp_path, "v0") == []
    assert len(recorded(tmp_path, "v39")) == 5


def test_a_recording_that_is_too_old_is_deleted_by_the_next_picture(
    make_frame: MakeFrame,
    hello: Hello,
    open_recorder: Callable[..., Recorder],
    clock: Clock,
    tmp_path: Path,
) -> None:
    for start_ms, session_id in ((clock.ms, "old"), (clock.ms + 3_600_000, "new")):
        clock.ms = start_ms
        recorder = open_recorder(max_age_s=1800.0)
        agreed(recorder, hello, session_id).save(make_frame(0), FIELD, grey(50))
        recorder.close()
    assert [part.camera.session_id for part in recorded_parts(tmp_path)] == ["new"]


def test_a_full_disk_stops_the_recording_once(
    make_frame: MakeFrame,
    hello: Hello,
    open_recorder: Callable[..., Recorder],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(path: Path, _: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(module, "write_whole", full)
    failures: list[Exception] = []
    recorder = open_recorder(failures.append)
    session = agreed(recorder, hello)
    for sequence in range(100):
        session.save(make_frame(sequence), FIELD, grey(128))
    recorder.close()
    (error,) = failures
    assert isinstance(error, OSError)
    assert error.errno == errno.ENOSPC


def test_an_error_that_is_not_the_disks_ends_the_recording_and_blocks_no_worker(
    make_frame: MakeFrame,
    hello: Hello,
    open_recorder: Callable[..., Recorder],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    error = ValueError("of the writer")

    def broken(_: object) -> bytes:
        raise error

    monkeypatch.setattr(module, "png_bytes", broken)
    failures: list[Exception] = []
    recorder = open_recorder(failures.append)
    session = agreed(recorder, hello)
    for sequence in range(2 * module.MAX_WAITING + 1):
        session.save(make_frame(sequence), FIELD, grey(128))
    recorder.close()
    assert failures == [error]
