"""Pictures are kept whole and in order; a disk that refuses is reported once."""

import errno
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mec_server import recorder as module
from mec_server.recorder import Recorder, Recording, picture_name
from rfcore.image import I420, read_rgb
from rfcore.wire.messages import Frame

MakeFrame = Callable[..., Frame]


def grey(level: int) -> I420:
    half = np.full((8, 16), 128, np.uint8)
    return I420(np.full((16, 32), level, np.uint8), half, half)


def test_pictures_and_index_agree(make_frame: MakeFrame, tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, on_failure=pytest.fail)
    for sequence in range(3):
        recorder.save(Recording("cav-1", make_frame(sequence), grey(50 + 50 * sequence)))
    recorder.close()
    folder = tmp_path / "cav-1" / "front"
    index = [json.loads(line) for line in (folder / "index.jsonl").read_text().splitlines()]
    assert [line["sequence"] for line in index] == [0, 1, 2]
    for number, line in enumerate(index):
        assert line["digest"] == grey(50 + 50 * number).digest().hex()
        assert read_rgb(folder / line["file"]).shape == (16, 32, 3)
    assert sorted(p.name for p in folder.iterdir()) == [
        "000000.png", "000001.png", "000002.png", "index.jsonl",
    ]  # fmt: skip


def test_a_later_epoch_overwrites_nothing(make_frame: MakeFrame) -> None:
    names = [picture_name(make_frame(7, epoch=epoch)) for epoch in (0, 3)]
    assert names == ["000007.png", "e0003-000007.png"]


def test_a_full_disk_stops_the_recording_once(
    make_frame: MakeFrame, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, _: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(module, "write_png", full)
    failures: list[Exception] = []
    recorder = Recorder(tmp_path, failures.append)
    for sequence in range(100):
        recorder.save(Recording("cav-1", make_frame(sequence), grey(128)))
    recorder.close()
    (error,) = failures
    assert isinstance(error, OSError)
    assert error.errno == errno.ENOSPC


def test_an_error_that_is_not_the_disks_ends_the_recording_and_blocks_no_worker(
    make_frame: MakeFrame, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    error = ValueError("of the writer")

    def broken(_: Path, __: object) -> None:
        raise error

    monkeypatch.setattr(module, "write_png", broken)
    failures: list[Exception] = []
    recorder = Recorder(tmp_path, failures.append)
    for sequence in range(2 * module.MAX_WAITING + 1):
        recorder.save(Recording("cav-1", make_frame(sequence), grey(128)))
    recorder.close()
    assert failures == [error]


def test_two_cameras_have_folders_of_their_own(make_frame: MakeFrame, tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, on_failure=pytest.fail)
    for camera in ("front", "rear"):
        frame = replace(make_frame(0), camera_id=camera)
        recorder.save(Recording("cav-1", frame, grey(100)))
    recorder.close()
    assert sorted(p.name for p in (tmp_path / "cav-1").iterdir()) == ["front", "rear"]
