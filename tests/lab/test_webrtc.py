"""``rfedge-lab webrtc`` measures what was shown alike for all, and compares at equal quality."""

import json
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from lab.pages.findings import FINDINGS
from lab.tcp.wire import SteppedRate
from lab.webrtc.bed import numbers_at, numbers_of
from lab.webrtc.camera import CameraPictures, captured, there_and_back
from lab.webrtc.engines import engine_of
from lab.webrtc.measure import (
    Shown,
    ShownPictures,
    Window,
    figures_of,
    frozen_percent,
    luma_psnr,
    numbered,
    read_pictures,
)
from lab.webrtc.report import OURS, WebrtcRow, paired, webrtc_parts
from lab.webrtc.run import crf_at
from rfcore.errors import BackendUnavailable, InvalidData
from rfcore.image import I420

HZ = 10.0
SIZE_PX = (128, 72)
MS = 1_000_000


@pytest.fixture(scope="module")
def camera() -> CameraPictures:
    """A texture that moves four pixels a picture."""
    random = np.random.default_rng(5)
    wide = cv2.resize(random.integers(0, 256, (9, 40), np.uint8), (400, 72))
    chroma = np.full((36, 64), 128, np.uint8)
    lumas = (np.ascontiguousarray(wide[:, 4 * k : 4 * k + 128]) for k in range(12))
    return CameraPictures([I420(luma, chroma, chroma) for luma in lumas])


def noisy(luma: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(7).normal(0, 6, luma.shape)
    return np.clip(luma + noise, 0, 255).astype(np.uint8)


# --- the camera


def test_a_drive_there_and_back_has_no_cut():
    cycle = there_and_back(5)
    assert sorted(cycle) == [0, 1, 1, 2, 2, 3, 3, 4]
    steps = np.diff([*cycle, cycle[0]])
    assert set(np.abs(steps)) == {1}


def test_pictures_reach_another_process(camera, tmp_path):
    camera.write(tmp_path / "pictures.npz")
    read = CameraPictures.read(tmp_path / "pictures.npz")
    for number in (0, 3, len(camera.cycle) + 2):
        assert read.at(number).packed() == camera.at(number).packed()


async def test_a_camera_does_not_wait_for_a_slow_consumer(camera):
    numbers = []
    async for capture in captured(camera, 1e5):  # as many periods pass between two pictures
        numbers.append(capture.number)
        if len(numbers) == 200:
            break
    assert all(np.diff(numbers) >= 1)
    assert numbers[-1] > 199


# --- what was shown


@pytest.mark.parametrize("origin", [0, 7, 20])
def test_pictures_are_known_by_what_they_show(camera, origin):
    """Of shown pictures some are missing, and time stamps are off by up to a third of a period."""
    random = np.random.default_rng(origin)
    numbers = np.flatnonzero(random.random(80) < 0.7)
    numbers += origin - numbers[0]
    lumas = [noisy(camera.at(int(number)).y) for number in numbers]
    about = numbers - numbers[0] + random.uniform(-0.33, 0.33, len(numbers))
    assert numbered(lumas, about - about[0], camera) == numbers.tolist()


def test_pictures_of_elsewhere_are_refused(camera):
    other = np.random.default_rng(1).integers(0, 256, (72, 128), np.uint8)
    with pytest.raises(InvalidData):
        numbered([other] * 20, np.arange(20.0), camera)


def test_ages_and_quality_are_of_the_pictures_captured_in_the_window(camera):
    captures = {k: 1000 * MS + k * 100 * MS for k in range(40)}
    ages_ms = {k: 50 + k for k in range(40)}
    shown = Shown(
        [captures[k] + ages_ms[k] * MS for k in range(40)],
        list(range(40)),
        [camera.at(k).y for k in range(40)],
    )
    window = Window(captures[10], captures[30], HZ)
    figures = figures_of(shown, captures, camera, window)
    assert figures.p50_ms == pytest.approx(np.median(range(60, 80)))
    assert figures.p99_ms == pytest.approx(np.percentile(range(60, 80), 99))
    assert figures.frozen_percent == 0.0
    assert figures.shown_hz == pytest.approx(HZ, abs=1)
    worse = replace(shown, lumas=[noisy(luma) for luma in shown.lumas])
    assert figures_of(worse, captures, camera, window).psnr_db == pytest.approx(32.6, abs=0.5)
    early = replace(shown, times_ns=[time_ns - 100 * MS for time_ns in shown.times_ns])
    with pytest.raises(InvalidData):
        figures_of(early, captures, camera, window)


def test_a_screen_that_shows_nothing_is_frozen(camera):
    window = Window(0, 10_000 * MS, HZ)
    figures = figures_of(Shown([], numbered([], np.zeros(0), camera), []), {}, camera, window)
    assert (figures.p99_ms, figures.psnr_db, figures.shown_hz) == (None, None, 0)
    assert figures.frozen_percent == 100


def test_a_freeze_is_a_gap_of_three_periods_also_at_the_end():
    window = Window(0, 10_000 * MS, HZ)
    times = np.arange(50, 10_000, 100) * MS
    assert frozen_percent(times.tolist(), window) == 0
    without = [t for t in times.tolist() if not 2000 * MS < t < 2500 * MS]
    assert frozen_percent(without, window) == pytest.approx(6.0)
    assert frozen_percent(times[::2].tolist(), window) == 0, "a low rate is no freeze"
    assert frozen_percent(times[:50].tolist(), window) == pytest.approx(50.5)


def test_a_smaller_picture_is_judged_as_large_as_the_cameras(camera):
    truth = camera.at(0)
    assert luma_psnr(truth.y, truth) > 90
    small = cv2.resize(truth.y, (64, 36), interpolation=cv2.INTER_AREA)
    assert 25 < luma_psnr(small, truth) < 60


def test_what_a_screen_collects_is_read_back(tmp_path):
    shown = ShownPictures()
    shown.take(5, 9000, np.ones((4, 6), np.uint8))
    shown.take(7, 18000, np.zeros((2, 3), np.uint8))
    shown.write(tmp_path / "shown.npz")
    times_ns, stamps, lumas = read_pictures(tmp_path / "shown.npz")
    assert times_ns == [5, 7]
    assert stamps.tolist() == [9000, 18000]
    assert [luma.shape for luma in lumas] == [(4, 6), (2, 3)]


def test_an_agents_report_gives_each_capture_its_number():
    """The drive has four pictures; one was captured late, two were not captured."""
    at_ms = {0: 0, 1: 100, 2: 204, 3: 300, 4: 400, 7: 749, 8: 800}
    lines = [{"capture_time_ns": ms * MS, "index": k % 4} for k, ms in at_ms.items()]
    assert numbers_of(lines, 4, HZ) == {k: ms * MS for k, ms in at_ms.items()}
    with pytest.raises(InvalidData):
        numbers_of([lines[0], lines[0]], 4, HZ)


def test_a_capture_time_that_was_rounded_has_its_number():
    captured_ns = {0: 1_000_000_999, 1: 1_100_000_001}
    assert numbers_at([1_100_000_000, 1_000_000_000], captured_ns) == [1, 0]
    with pytest.raises(InvalidData):
        numbers_at([1_050_000_000], captured_ns)


# --- equal quality


def test_the_crf_is_the_highest_that_gives_the_quality():
    qualities = [(12.0, 44.0), (22.0, 38.0), (32.0, 33.0)]
    assert crf_at(qualities, 41.0) == 17.0
    assert crf_at(qualities, 38.0) == 22.0
    assert crf_at(qualities, 37.9) == 22.0
    assert crf_at(qualities, 50.0) == 12.0, "none is as good: the best"
    assert crf_at(qualities, 20.0) == 32.0, "all are better: the cheapest"


ROW = WebrtcRow(
    peer="libwebrtc-av1", rate_bps=1e6, rtt_ms=20.0, loss_percent=0.0, p50_ms=100.0, p95_ms=120.0,
    p99_ms=150.0, frozen_percent=0.0, psnr_db=36.0, bytes=200_000, shown_hz=10.0, seconds=2.0,
)  # fmt: skip


def ours(psnr_db: float, sent_bytes: int, **changed: float) -> WebrtcRow:
    return replace(ROW, peer=OURS, crf=23.0, psnr_db=psnr_db, bytes=sent_bytes, **changed)


def test_a_peer_is_compared_with_our_cheapest_row_of_its_quality():
    enough, more, less = ours(36.2, 80_000), ours(39.0, 150_000), ours(35.0, 50_000)
    elsewhere = ours(36.2, 1000, rtt_ms=200.0)
    (pair,) = paired([ROW, more, enough, less, elsewhere])
    assert pair.ours == enough
    assert pair.bytes_percent == pytest.approx(40)
    assert pair.is_equal
    (pair,) = paired([ROW, less, ours(35.5, 60_000)])
    assert pair.ours.psnr_db == 35.5
    assert not pair.is_equal


def test_showing_fewer_pictures_saves_nothing():
    (pair,) = paired([ROW, ours(36.0, 100_000, shown_hz=5.0)])
    assert pair.bytes_percent == pytest.approx(100)


def test_a_peer_that_shows_nothing_is_no_better():
    nothing = dict.fromkeys(("p50_ms", "p95_ms", "p99_ms", "psnr_db"))
    dead = replace(ROW, frozen_percent=100.0, shown_hz=0.0, **nothing)
    (pair,) = paired([dead, ours(36.0, 100_000)])
    assert pair.is_no_later
    assert pair.is_no_more_frozen
    (pair,) = paired([ROW, replace(dead, peer=OURS)])
    assert not any((pair.is_equal, pair.is_no_later, pair.is_no_more_frozen))


def test_the_page_says_who_was_better():
    rows = [ROW, ours(36.2, 80_000), ours(37.0, 90_000, p99_ms=300.0, rtt_ms=200.0)]
    rows.append(replace(ROW, rtt_ms=200.0, step_bps=5e5))
    rows.append(replace(rows[2], step_bps=5e5))
    result = {
        "hz": HZ, "field_bytes": 800_000, "engines": ["wrtc 0.1.0"], "tcp": "cubic",
        "delay_ms": 300.0, "rows": [vars(row) for row in rows],
    }  # fmt: skip
    parts = webrtc_parts(json.loads(json.dumps(result)))
    page = "\n".join(part if isinstance(part, str) else part.markdown() for part in parts)
    assert FINDINGS["webrtc"]([("webrtc", result)]) in page
    assert "Beside libwebrtc-av1 on 2 links" in page
    assert "at most half in 2; p99 no higher in 1" in page
    assert "1, then 0.5" in page


# --- the bed


@pytest.mark.parametrize(("engine", "package"), [("aiortc", "aiortc"), ("libwebrtc", "wrtc")])
def test_a_missing_engine_says_what_to_install(monkeypatch, engine, package):
    monkeypatch.setitem(sys.modules, {"libwebrtc": "webrtc"}.get(engine, engine), None)
    with pytest.raises(BackendUnavailable, match=f"pip install {package}"):
        engine_of(engine, "vp8")


def test_a_rate_steps_for_what_comes_then():
    rate = SteppedRate([8000.0, 4000.0])
    assert rate.schedule(1000, 10.0) == (10.0, 11.0)
    rate.step()
    assert rate.schedule(1000, 10.5) == (11.0, 13.0)
    rate.step()
    assert rate.schedule(500, 20.0) == (20.0, 21.0), "the last rate stays"
