"""The slice coder experiment: every coder gets the same work, and its rows can be read back."""

import io
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from lab.slice_coder import run
from lab.slice_coder.report import BdRow, TimeRow, slice_coder_section
from lab.slice_coder.run import (
    SliceCoderJob,
    header_of,
    resized,
    run_slice_coder,
    slice_qp,
    slice_tasks,
    time_rows,
)
from rfcore.codec.h264.bitstream import split_nals
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.h264.ffmpeg import PictureKind, encode_pictures
from rfcore.codec.h264.header import StreamHeader, own_header
from rfcore.codec.h264.parameter_sets import NAL_IDR, NAL_P, nal_type
from rfcore.codec.h264.slice_coder import Effort, SliceCoder
from rfcore.codec.h264.slices import CodedSlice, SliceCoding, encode_slice, slice_options
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfedge.evaluate.clips import DriveName, DriveOfField
from rfedge.results import read_result, rows_of

SAMPLES = Path(__file__).parents[2] / "samples"
DRIVE = f"vehicles@10={SAMPLES / 'street/transforms_drive_vehicles.json'}"
FIELD = SAMPLES / "fields/street.rff"
CONFIG = CodecConfig(64, 48, "x264-medium")


def picture(seed: int) -> I420:
    rng = np.random.default_rng(seed)
    shapes = ((48, 64), (24, 32), (24, 32))
    return I420(*(rng.integers(0, 256, shape).astype(np.uint8) for shape in shapes))


@pytest.mark.parametrize("references", range(4))
@pytest.mark.parametrize("qp", [3, 26, 40])
def test_the_quantiser_is_read_from_slices_of_our_own(references: int, qp: int) -> None:
    header = header_of(CONFIG)
    pictures = [picture(k) for k in range(references)]
    payload = SliceCoder(header).encode(picture(9), pictures, qp).payload
    assert slice_qp(CodedSlice(header, payload)) == qp


@pytest.mark.parametrize("weights", ["1", "2"])
def test_the_quantiser_is_read_from_x264_slices_with_weights(weights: str) -> None:
    """The quantiser is set, not chosen: a zone of the sent picture says it."""
    first = picture(0)
    darker = I420(*((plane // 2).astype(np.uint8) for plane in first.planes))
    options = slice_options(CONFIG)
    params = {**options.params, "weightp": weights, "zones": "1,1,q=31"}
    kinds = [(first, PictureKind.I), (darker, PictureKind.P)]
    unit = encode_pictures(replace(options, params=params), kinds, ())[-1]
    (payload,) = [nal for nal in split_nals(unit) if nal_type(nal) in (NAL_P, NAL_IDR)]
    header = encode_slice(CONFIG, [first], first).header
    assert slice_qp(CodedSlice(header, payload)) == 31


def test_a_drive_may_name_its_own_field() -> None:
    own = DriveOfField.parse("city@5=out/city.json,out/city.rff", FIELD)
    assert (own.name.dataset, own.field) == (Path("out/city.json"), Path("out/city.rff"))
    assert DriveOfField.parse(DRIVE, FIELD).field == FIELD
    noisy = DriveOfField.parse("city@5=out/city.json,out/city.rff,noise=1.5", FIELD)
    assert (noisy.field, noisy.name) == (
        Path("out/city.rff"),
        DriveName("city noise 1.5", 5.0, Path("out/city.json"), 1.5),
    )


def job(tmp_path: Path, *sizes: str) -> SliceCoderJob:
    return SliceCoderJob(
        field=FIELD,
        drives=(DRIVE, f"{DRIVE},noise=3"),
        timed=DRIVE,
        sizes=sizes,
        out=tmp_path / "slice-coder.json",
        quick=True,
    )


def test_a_size_of_another_form_is_refused_before_anything_is_coded(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="'720p' is not WIDTHxHEIGHT"):
        run_slice_coder(job(tmp_path, "720p"), Console(file=io.StringIO()))


def test_all_coders_are_timed_on_the_threads_that_the_rows_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    used: list[tuple[str, int]] = []

    class Recorded(SliceCoder):
        def __init__(self, header: StreamHeader, *, threads: int) -> None:
            used.append(("own", threads))
            super().__init__(header, threads=threads)

    def recorded(
        config: CodecConfig, references: Sequence[I420], frame: I420, coding: SliceCoding
    ) -> CodedSlice:
        used.append(("x264", coding.threads))
        return encode_slice(config, references, frame, coding)

    footage = resized(*DriveOfField.parse(DRIVE, FIELD).read(3), 64, 48)
    tasks = list(slice_tasks(footage, 26.0, []))
    monkeypatch.setattr(run, "slice_tasks", lambda *_: iter(tasks))
    monkeypatch.setattr(run, "header_of", lambda _: own_header(CodecConfig(64, 48)))
    monkeypatch.setattr(run, "CRFS", (26.0,))
    monkeypatch.setattr(run, "SliceCoder", Recorded)
    monkeypatch.setattr(run, "encode_slice", recorded)
    rows = time_rows(footage, threads=2)
    assert set(used) == {("own", 2), ("x264", 2)}
    assert [(row.threads, row.effort) for row in rows] == [
        (2, effort.name.lower()) for effort in Effort
    ]
    assert all((row.wall_ms or 0) > 0 and (row.x264_wall_ms or 0) > 0 for row in rows)


def test_no_threads_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="threads: 0 is less than 1"):
        replace(job(tmp_path), threads=(0,))


def test_times_from_before_the_clock_was_read_have_their_row() -> None:
    path = Path(__file__).parents[2] / "lab/results/slice-coder.json"
    result = json.loads(path.read_text())
    for row in result["times"]:
        row.pop("wall_ms", None), row.pop("x264_wall_ms", None)
    assert "| 1280x720 | 3 | 1 | fast |" in slice_coder_section(path, result)


@pytest.mark.slow
def test_every_effort_is_compared_with_every_rival_and_timed(tmp_path: Path) -> None:
    run_slice_coder(job(tmp_path, "320x180"), Console(file=io.StringIO()))
    path = tmp_path / "slice-coder.json"
    result = read_result(path, "slice-coder")
    rows, times = rows_of(BdRow, result["rows"]), rows_of(TimeRow, result["times"])
    assert {row.drive for row in rows} == {"vehicles", "vehicles noise 3"}
    assert len(rows) == 2 * len(Effort) * 2
    assert all(abs(row.bd_rate_percent) < 15 for row in rows)
    assert [row.effort for row in times] == [effort.name.lower() for effort in Effort]
    assert all(0 < row.encode_ms < row.x264_encode_ms for row in times)
    assert times[0].references == 3
    section = slice_coder_section(path, json.loads(path.read_text()))
    assert "| vehicles noise 3 | 10 | 640x360 | fast | medium |" in section
