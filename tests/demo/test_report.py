"""The demo's report and tables: every figure of the result, in one file that needs no other."""

import base64
import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.metrics import psnr
from rfcore.native.yuv import i420_from_rgb, rgb_from_i420
from rfedge.demo.measure import (
    DriveFigures,
    FrameFigures,
    Pictures,
    Rivals,
    rival_curve,
    saving_at_equal_psnr,
)
from rfedge.demo.report import print_summary, write_report
from rfedge.evaluate.rivals import x264_for_psnr
from rfedge.report.charts import STAGES
from rfedge.results import Provenance, make_result

HOST = {"cpu": "C", "cores": 2, "isa": "avx2"}
MADE = Provenance("rfedge demo", "abc123", False, HOST, {})
STAGE_MS = dict.fromkeys(STAGES, 3.5)


def frame(number: int, psnr_db: float) -> FrameFigures:
    return FrameFigures(
        name=f"drive/{number:03d}.png",
        sequence=number,
        payload_bytes=1000 + number,
        packet_bytes=1100 + number,
        psnr_db=psnr_db,
        ssim=0.9,
        rf_psnr_db=28.0 + number,
        latency_ms=20.0,
        stage_ms=STAGE_MS,
    )


DRIVE = DriveFigures(
    frames=3,
    frames_reconstructed=3,
    digest_matches=2,
    payload_bytes=170_700,
    packet_bytes=173_300,
    wire_bytes=174_800,
    psnr_db=34.584,
    ssim=0.9071,
    rf_psnr_db=28.441,
    paper_savings_percent=45.81,
    paper_savings_percent_wrong_street=30.0,
    paper_savings_percent_grey=12.5,
    saving_vs_intra_percent=64.42,
    latency_ms={"p50": 208.4, "p99": 329.1},
    link_tau_error_percent=0.476,
    stage_ms=STAGE_MS,
    per_frame=[frame(0, 35.0), frame(1, 33.0), frame(2, 34.0)],
    saving_vs_x264_percent=44.77,
    x264_setting="x264-lowdelay-psnr-medium",
)
SETTINGS = {
    "effort": "default",
    "preset": "medium",
    "crf": 23.0,
    "rate_hz": 10.0,
    "link_bps": 4e6,
    "link_delay_ms": 5,
}
FIELD = {"id": "f" * 64, "kind": "splats", "gaussians": 12_345, "held_out_psnr_db": 28.49}


def result_of(**drives: DriveFigures) -> dict[str, Any]:
    return make_result("demo", MADE, {"settings": SETTINGS, "field": FIELD, "sequences": drives})


def pictures(count: int = 3) -> list[Pictures]:
    grey = np.full((16, 24, 3), 128, np.uint8)
    return [Pictures(f"drive/{k:03d}.png", grey, grey + 9, grey + 2) for k in range(count)]


def test_the_page_has_every_drive_and_figure_and_needs_no_other_file(tmp_path):
    path = tmp_path / "report.html"
    result = result_of(empty=DRIVE, vehicles=replace(DRIVE, saving_vs_x264_percent=-3.21))
    write_report(path, result, {"empty": pictures(), "vehicles": pictures()})
    page = path.read_text()
    headline = (
        "Fewer bytes at equal quality than low-delay x264: 45 % (empty), -3 % (vehicles); "
        "than I pictures: 64 % (empty), 64 % (vehicles)"
    )
    assert f"<h1>{headline}</h1>" in page
    for shown in ("3 of 3", "2 of 3", "34.58 dB; 0.907", "64.4 %", "44.8 %", "-3.2 %", "+0.48 %"):
        assert f"<td>{shown}</td>" in page
    assert page.count("<svg") == 6, "bytes, quality and stages of each drive"
    stills = re.findall(r'<img src="data:', page)
    assert len(stills) == 2 * 3 * 4, "first, worst and last frame: four pictures each"
    assert re.findall(r"(?:src|href)=.(?!data:|#)[^>]*", page) == []


def test_the_player_has_every_frame_the_strips_the_worst_and_the_video_is_within(tmp_path):
    frames = [frame(k, 40.0 - 5 * (k == 3)) for k in range(7)]
    video = tmp_path / "v.mp4"
    video.write_bytes(b"a film")
    result = result_of(empty=replace(DRIVE, per_frame=frames))
    write_report(tmp_path / "r.html", result, {"empty": pictures(7)}, video)
    page = _page(tmp_path)
    (player,) = re.findall(r'<script type="application/json">(.*?)</script>', page)
    shown = json.loads(player)
    assert [f"drive/{k:03d}.png" in entry["said"] for k, entry in enumerate(shown)] == [True] * 7
    assert {"camera", "reconstruction"} <= set(shown[0])
    captions = re.findall(r"camera, frame (drive/\d+\.png)</figcaption>", page)
    assert captions == ["drive/000.png", "drive/003.png", "drive/006.png"], "first, worst, last"
    assert f"data:video/mp4;base64,{base64.b64encode(b'a film').decode()}" in page
    write_report(tmp_path / "r.html", result, {"empty": pictures(7)})
    assert "<video" not in _page(tmp_path)


def _page(folder: Path) -> str:
    return (folder / "r.html").read_text()


def test_names_from_outside_cannot_break_the_page(tmp_path):
    frames = [replace(frame(0, 35.0), name="<b>x</b>")]
    shots = [replace(pictures(1)[0], name="<b>x</b>")]
    result = result_of(**{"<i>empty</i>": replace(DRIVE, per_frame=frames)})
    write_report(tmp_path / "r.html", result, {"<i>empty</i>": shots})
    assert "<b>x" not in _page(tmp_path)
    assert "<i>empty" not in _page(tmp_path)


def test_at_80_columns_the_summary_has_each_figure_whole(tmp_path):
    console = Console(file=io.StringIO(), width=80)
    print_summary(console, result_of(empty=DRIVE, vehicles=DRIVE), tmp_path)
    text = console.file.getvalue()
    for shown in ("170.7 / 173.3 / 174.8", "34.58 dB; 0.907", "44.8 %", "208 / 329 ms"):
        (line,) = [x for x in text.splitlines() if shown in x]
        assert line.count(shown) == 2
    assert str(tmp_path / "report.html") in text.replace("\n", "")


# --- rivals at equal quality


def moving(count: int = 4) -> list[Any]:
    rng = np.random.default_rng(5)
    base = rng.integers(40, 215, (8, 12, 3)).repeat(8, 0).repeat(8, 1).astype(np.uint8)
    return [np.roll(base, 2 * k, axis=1) for k in range(count)]


def rgb_psnr_db(decoded: I420, frame: I420) -> float:
    return psnr(rgb_from_i420(decoded), rgb_from_i420(frame))


def test_more_bytes_buy_more_quality_on_a_rivals_curve():
    frames = [i420_from_rgb(rgb) for rgb in moving()]
    crfs = (38.0, 18.0, 26.0, 32.0)
    curve = rival_curve(frames, x264_for_psnr("veryfast"), 10.0, crfs, rgb_psnr_db)
    assert [point.crf for point in curve] == sorted(crfs)
    assert [p.mean_bytes for p in curve] == sorted((p.mean_bytes for p in curve), reverse=True)
    assert [p.mean_psnr_db for p in curve] == sorted((p.mean_psnr_db for p in curve), reverse=True)
    middle = curve[1]
    saving = saving_at_equal_psnr(curve, middle.mean_bytes / 2, middle.mean_psnr_db)
    assert saving == pytest.approx(50.0)


def test_prediction_makes_x264_cheaper_than_its_i_pictures():
    """Against the stronger rival the same packets save less."""
    rivals = Rivals(moving(), "veryfast", 10.0)
    intra, x264 = (f(400.0, 36.0) for f in (rivals.saving_vs_intra, rivals.saving_vs_x264))
    assert x264 < intra


def test_a_curve_of_nothing_is_refused():
    with pytest.raises(InvalidInput, match="at least one frame"):
        rival_curve([], x264_for_psnr("veryfast"), 10.0, (20.0,), rgb_psnr_db)
