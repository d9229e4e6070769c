"""Quality by class: errors are those of each class's own pixels, at the same bits for everybody."""

import io
import json
import math
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from rich.console import Console

from lab.classes import EvalClasses
from lab.classes.measure import (
    GROUPS,
    LEVELS,
    ClassCurve,
    ClassErrors,
    ClassQuality,
    quality_at,
    run_classes,
)
from rfcore.errors import DatasetError, InvalidInput
from rfcore.image import I420
from rfedge.evaluate.clips import Clip, CodedClip, DriveName, luma_mse
from rfedge.evaluate.noted_coder import NotedCoder
from rfedge.evaluate.rivals import CodedPictures
from rfedge.results import read_result
from streetgen.classes import Label

REST, VEHICLE, PERSON, SIGN, MARKING = range(5)


def grey(level: int) -> I420:
    chroma = np.full((4, 4), 128, np.uint8)
    return I420(np.full((8, 8), level, np.uint8), chroma, chroma)


@dataclass(frozen=True)
class WrongInOneGroup:
    """Shows every frame as it is but for ``off`` levels in one group's pixels."""

    groups: list[np.ndarray]
    group: int
    off: int
    name: str = "wrong"
    version: str = "1"
    points: tuple[float, ...] = (20.0,)
    limits: tuple[float, float] = (1.0, 51.0)

    def pictures(self, frames: Any, rate_hz: float, point: float) -> CodedPictures:
        del rate_hz, point
        shown = [
            replace(frame, y=np.where(g == self.group, frame.y + self.off, frame.y).astype("u1"))
            for frame, g in zip(frames, self.groups, strict=False)
        ]
        return CodedPictures([100] * len(frames), shown, 1.0, 1.0)


def quarters(frames: int) -> list[np.ndarray]:
    """A vehicle on the upper left, a person on the upper right, road below."""
    groups = np.zeros((8, 8), np.uint8)
    groups[:4, :4], groups[:4, 4:] = VEHICLE, PERSON
    return [groups] * frames


@pytest.mark.parametrize("group", [REST, VEHICLE, PERSON])
def test_an_error_in_one_class_is_counted_there_and_nowhere_else(group):
    frames, groups = [grey(100)] * 3, quarters(3)
    coder = NotedCoder(WrongInOneGroup(groups, group, 7), ClassErrors(groups))
    coded = coder.code(frames, 10.0, 20.0)
    for index, name in enumerate(GROUPS):
        expected = 49.0 * (groups[0] == group).sum() if index == group else 0.0
        assert coded.notes[f"{name}_sse"] == (expected,) * 3


def test_the_classes_errors_add_up_to_the_pictures():
    rng = np.random.default_rng(1)
    frames = [grey(int(level)) for level in rng.integers(20, 200, 4)]
    groups = [rng.integers(0, len(GROUPS), (8, 8)).astype(np.uint8) for _ in frames]
    coder = WrongInOneGroup(groups, SIGN, 9)
    coded = NotedCoder(coder, ClassErrors(groups)).code(frames, 10.0, 20.0)
    shown = coder.pictures(frames, 10.0, 20.0).decoded
    for i, pair in enumerate(zip(shown, frames, strict=True)):
        total = sum(float(coded.notes[f"{name}_sse"][i]) for name in GROUPS)
        assert total / 64 == pytest.approx(luma_mse(*pair)) == coded.luma_mse[i]


def test_other_classes_make_another_cell():
    groups, others = quarters(2), [LEVELS[np.zeros((8, 8), int)]] * 2
    coder = WrongInOneGroup(groups, REST, 1)
    versions = [NotedCoder(coder, ClassErrors(each)).version for each in (groups, others)]
    assert versions[0] != versions[1]


def test_every_label_belongs_to_a_class_and_bicycles_to_people():
    assert [GROUPS[level] for level in LEVELS[[Label.PERSON, Label.BICYCLE]]] == ["person"] * 2
    assert len(LEVELS) == len(Label)
    named = (Label.VEHICLE, Label.SIGN, Label.MARKING, Label.ROAD)
    assert [GROUPS[LEVELS[label]] for label in named] == ["vehicle", "sign", "marking", "rest"]


def coded_clip(point: float, size: int, mse: dict[str, float], pixels: np.ndarray) -> CodedClip:
    """Three frames, the first of which must not count."""
    sums = {name: mse.get(name, 0.0) * pixels[i] for i, name in enumerate(GROUPS)}
    whole = sum(sums.values()) / pixels.sum()
    return CodedClip(
        point,
        np.array([9999, size, size]),
        np.array([1e4, whole, whole]),
        np.ones(3),
        1.0,
        {f"{name}_sse": (1e9, total, total) for name, total in sums.items()},
    )


FIRST_PIXELS, PIXELS = np.array([0.0, 0.0, 0.0, 100.0, 0.0]), np.array([60.0, 30.0, 10.0, 0.0, 0.0])
"""In the first frame, which does not count, a sign fills the picture."""


def curve(method: str, factor: float) -> ClassCurve:
    """Halving the bytes doubles the errors; a vehicle's are ``factor`` of the rest's."""
    clips = [
        coded_clip(
            point,
            size,
            {"rest": 32e3 / size, "vehicle": factor * 32e3 / size, "person": 64},
            PIXELS,
        )
        for point, size in ((20.0, 4000), (26.0, 2000), (32.0, 1000), (38.0, 500), (44.0, 250))
    ]
    return ClassCurve(method, clips, np.stack([FIRST_PIXELS, PIXELS, PIXELS]))


CLIP = Clip("alley", 10.0, [], "", None)


def psnr(mse: float) -> float:
    return 10 * math.log10(255**2 / mse)


def test_at_equal_bits_everybody_has_the_bits_of_the_first():
    """At an operating point of both the errors are those of that point."""
    ours, theirs = curve("ours", 0.5), curve("theirs", 2.0)
    at_db = ours.clips[2].psnr_db()
    rows = [row for row in quality_at([ours, theirs], CLIP, at_db) if row.equal == "bits"]
    found = {(row.method, row.class_): row for row in rows}
    assert [row.bytes_per_frame for row in rows] == pytest.approx([1000] * len(rows))
    assert found["ours", "all"].psnr_db == pytest.approx(at_db)
    assert found["ours", "vehicle"].psnr_db == pytest.approx(psnr(16))
    assert found["theirs", "vehicle"].psnr_db == pytest.approx(psnr(64))
    assert found["theirs", "person"].psnr_db == pytest.approx(psnr(64))
    assert found["theirs", "rest"].share_percent == pytest.approx(60)
    assert ("ours", "sign") not in found, "a class without a pixel has no quality"


def test_between_operating_points_errors_follow_the_power_of_the_rate():
    """A straight line over logarithms is kept exactly by the interpolation."""
    between = curve("ours", 0.5).mse_at(1400.0)
    assert between["vehicle"] == pytest.approx(0.5 * 32e3 / 1400, rel=1e-9)
    assert between["person"] == pytest.approx(64)


def test_at_equal_quality_everybody_has_that_quality_for_its_own_bits():
    ours, theirs = curve("ours", 0.5), curve("theirs", 2.0)
    rows = [r for r in quality_at([ours, theirs], CLIP, 33.0) if r.equal == "quality"]
    whole = {row.method: row for row in rows if row.class_ == "all"}
    assert whole["ours"].psnr_db == pytest.approx(33.0, abs=0.02)
    assert whole["theirs"].psnr_db == pytest.approx(33.0, abs=0.02)
    assert whole["theirs"].bytes_per_frame > whole["ours"].bytes_per_frame


def test_what_a_coder_does_not_reach_is_an_error_with_its_range():
    with pytest.raises(InvalidInput, match=r"ours has 27.28..36.80 dB, not 50.00; .*--at-db"):
        list(quality_at([curve("ours", 1.0)], CLIP, 50.0))
    with pytest.raises(InvalidInput, match=r"ours has 250.*4000.* bytes a frame, not 100"):
        curve("ours", 1.0).mse_at(100.0)


def test_a_quality_that_several_points_have_is_had_for_the_fewest_bytes():
    """As with a good field at rates where nothing is sent: its quality does not fall any more."""
    ours = curve("ours", 0.5)
    last = ours.clips[-1]
    idle = replace(last, frame_bytes=np.array([9999, 90, 90]))
    longer = replace(ours, clips=[*ours.clips, idle])
    assert longer.bytes_at(last.psnr_db()) == pytest.approx(90)


def write_classes(folder: Path, labels: np.ndarray) -> None:
    """Write a class picture as PNG of one channel."""
    folder.parent.mkdir(exist_ok=True)
    encoder = av.CodecContext.create("png", "w")
    encoder.height, encoder.width = labels.shape
    encoder.pix_fmt, encoder.time_base = "gray", 1
    folder.write_bytes(bytes(encoder.encode(av.VideoFrame.from_ndarray(labels, "gray"))[0]))


@pytest.fixture(scope="module")
def drive(thumbnail: Any, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The thumbnail's drive as `streetgen build` lays one out, its box labelled a vehicle."""
    source = DriveName.parse(thumbnail.drive).dataset
    folder = tmp_path_factory.mktemp("classes")
    (folder / "drive" / "images").mkdir(parents=True)
    content = json.loads(source.read_text())
    for k, frame in enumerate(content["frames"]):
        shutil.copy(source.parent / frame["file_path"], folder / "drive" / "images" / f"{k}.png")
        frame["file_path"] = f"drive/images/{k}.png"
        labels = np.full((64, 96), Label.BUILDING, np.uint8)
        labels[24:48, 16 + 6 * k : 40 + 6 * k] = Label.VEHICLE
        write_classes(folder / "drive" / "classes" / f"{k}.png", labels)
    (folder / "transforms_drive.json").write_text(json.dumps(content))
    return f"wall@10={folder / 'transforms_drive.json'}"


def job_of(field_file: Path, drive: str, folder: Path) -> EvalClasses:
    return EvalClasses(
        field=field_file,
        drives=(drive,),
        at_db=(33.5,),
        effort="fast",
        preset="veryfast",
        out=folder / "classes.json",
        cells=folder / "cells",
    )


def test_a_drive_becomes_rows_and_is_not_coded_twice(thumbnail, drive, tmp_path, monkeypatch):
    job = job_of(thumbnail.field, drive, tmp_path)
    said = io.StringIO()
    run_classes(job, Console(file=said, width=200))
    result = read_result(job.out, "classes")
    rows = ClassQuality.of_rows(result["rows"])
    methods = ("rfedge", "x264-our-tools-veryfast", "x264-lowdelay-veryfast")
    assert {row.method for row in rows} == set(methods)
    assert {row.class_ for row in rows} == {"all", "rest", "vehicle"}
    box = 100 * 24 * 24 / (64 * 96)
    shares = [row.share_percent for row in rows if row.class_ == "vehicle"]
    assert shares == pytest.approx([box] * 6)
    at_bits = [row for row in rows if row.equal == "bits"]
    assert len({row.bytes_per_frame for row in at_bits}) == 1
    ours = next(row for row in at_bits if (row.method, row.class_) == ("rfedge", "all"))
    assert ours.psnr_db == pytest.approx(33.5, abs=0.05)
    assert len(said.getvalue().split("PSNR of the luma")) == 3, "at equal bits and equal quality"
    monkeypatch.setattr(NotedCoder, "code", lambda *_: pytest.fail("a clip was coded again"))
    run_classes(job, Console(file=io.StringIO()))
    assert read_result(job.out)["rows"] == result["rows"]


def test_missing_or_unfit_class_pictures_are_named_before_anything_is_coded(
    thumbnail, drive, tmp_path, monkeypatch
):
    monkeypatch.setattr(NotedCoder, "code", lambda *_: pytest.fail("a clip was coded"))
    with pytest.raises(DatasetError, match=r"0.png: is not in a folder `images`.*streetgen build"):
        run_classes(job_of(thumbnail.field, thumbnail.drive, tmp_path), Console())
    folder = tmp_path / "copy"
    shutil.copytree(DriveName.parse(drive).dataset.parent, folder)
    named = f"wall@10={folder / 'transforms_drive.json'}"
    write_classes(folder / "drive/classes/2.png", np.zeros((32, 48), np.uint8))
    with pytest.raises(InvalidInput, match=r"2.png: \(48, 32\) px, frame \(96, 64\) px"):
        run_classes(job_of(thumbnail.field, named, tmp_path), Console())
    (folder / "drive/classes/2.png").unlink()
    with pytest.raises(DatasetError, match=r"classes/2.png: cannot be read"):
        run_classes(job_of(thumbnail.field, named, tmp_path), Console())


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("drives", (), "drives: there is none"),
        ("at_db", (), r"at_db: \(\) are not"),
        ("at_db", (33.5, float("nan")), "at_db: .*nan.* are not decibels"),
        ("out", Path("rows.txt"), "must end in .json"),
    ],
)
def test_a_job_that_cannot_be_is_refused(key, value, said):
    job = job_of(Path("f.rff"), "a@1=b.json", Path("out"))
    with pytest.raises(InvalidInput, match=said):
        replace(job, **{key: value})
