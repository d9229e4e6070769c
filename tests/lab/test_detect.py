"""A detector on decoded pictures: boxes where things are, COCO's precision, failures counted."""

import io
import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from lab.detect import EvalDetect, detector, measure
from lab.detect.detector import Box, Detector, DetectorFailed, FastestDet, as_text, of_text, tiles
from lab.detect.measure import (
    GROWN_PX,
    HELD_FRAMES,
    CostRow,
    DetectedBoxes,
    DriveDetection,
    bd_rows,
    equal_bits_rows,
    method_curves,
    object_masks,
    run_detect,
)
from lab.detect.precision import (
    ALL,
    Precision,
    counted_classes,
    drawn_curves,
    interval,
    precision_curve,
)
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import FieldView
from rfedge.evaluate.clips import Clip, CodedClip, Runs
from rfedge.evaluate.field_coder import RenderedClip
from rfedge.evaluate.rate_curve import bd_rate_percent

CAR, CELL_PX, SIDE = 2, 16, 352
SIZE_LOGIT = -2.0


def field(number, content):
    """A field of a protobuf message: a varint, or bytes with their length."""

    def varint(value):
        more, low = value >> 7, value & 127
        return bytes([low | 128]) + varint(more) if more else bytes([low])

    if isinstance(content, int):
        return varint(number << 3) + varint(content)
    return varint(number << 3 | 2) + varint(len(content)) + content


def tensor(name, array):
    dims = b"".join(field(1, n) for n in array.shape)
    return dims + field(2, 1) + field(8, name) + field(9, array.astype("<f4").tobytes())


def value(name, shape):
    dims = b"".join(field(1, field(1, n)) for n in shape)
    return field(1, name) + field(2, field(1, field(1, 1) + field(2, dims)))


def network(channels=85):
    """An ONNX file of one convolution: objectness is the brightness of a cell, all are cars."""
    kernel = np.zeros((channels, 3, CELL_PX, CELL_PX))
    kernel[0] = 1 / (3 * CELL_PX**2)
    bias = np.zeros(channels)
    bias[3:5], bias[5 + CAR] = SIZE_LOGIT, 1.0
    strides = field(1, b"strides") + field(8, CELL_PX) * 2 + field(20, 7)
    node = b"".join(field(1, name) for name in (b"picture", b"kernel", b"bias"))
    node += field(2, b"cells") + field(4, b"Conv") + field(5, strides)
    cells = SIDE // CELL_PX
    graph = field(1, node) + field(2, b"one") + field(5, tensor(b"kernel", kernel))
    graph += field(5, tensor(b"bias", bias)) + field(11, value(b"picture", (1, 3, SIDE, SIDE)))
    graph += field(12, value(b"cells", (1, channels, cells, cells)))
    return field(1, 8) + field(7, graph) + field(8, field(1, b"") + field(2, 13))


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "bright.onnx"
    path.write_bytes(network())
    return path


def street(at, size_px=(800, 352)):
    """A black picture with a bright cell whose corner is at each (x, y)."""
    picture = np.zeros((size_px[1], size_px[0], 3), np.uint8)
    for x, y in at:
        picture[y : y + CELL_PX, x : x + CELL_PX] = 255
    return picture


def test_a_thing_is_found_where_it_is_and_once_in_overlapping_tiles(model):
    picture = street([(224, 160)])
    seen = Detector(model).boxes(picture)
    assert sum(c.start <= 224 and c.stop >= 240 for _, c in tiles(picture)) > 1
    surest = seen[0]
    side = SIDE / (1 + np.exp(-SIZE_LOGIT))
    assert (surest.class_, surest.score) == ("car", pytest.approx(1, abs=1e-4))
    assert (surest.width, surest.height) == pytest.approx((side, side))
    assert (surest.left + side / 2, surest.top + side / 2) == pytest.approx((224, 160), abs=0.1)
    assert len(seen) == 1


def test_tiles_cover_the_picture_and_overlap_by_a_quarter():
    for size_px in ((828, 250), (640, 360), (250, 828), (352, 352)):
        found = tiles(street([], size_px))
        seen = np.zeros((size_px[1], size_px[0]), int)
        for rows, columns in found:
            seen[rows, columns] += 1
        assert seen.min() == 1
        along = sorted(r.start + c.start for r, c in found)
        assert all(b - a <= 0.75 * min(size_px) + 1 for a, b in pairwise(along))


def test_boxes_of_fastestdet_are_those_of_its_formula():
    rng = np.random.default_rng(1)
    out = rng.random((85, 3, 4)).astype("f4")
    boxes, scores, classes = FastestDet().boxes([out[None]])
    for row in range(3):
        for column in range(4):
            o = out[:, row, column].astype(float)
            width, height = 1 / (1 + np.exp(-o[3])), 1 / (1 + np.exp(-o[4]))
            x, y = (column + np.tanh(o[1])) / 4, (row + np.tanh(o[2])) / 3
            k = row * 4 + column
            assert boxes[k] == pytest.approx([x - width / 2, y - height / 2, width, height], 1e-4)
            assert scores[k] == pytest.approx(o[0] ** 0.6 * o[5:].max() ** 0.4, 1e-4)
            assert classes[k] == o[5:].argmax()


def test_what_is_no_such_network_is_refused_before_anything_is_coded(tmp_path, monkeypatch):
    path = tmp_path / "other.onnx"
    with pytest.raises(InvalidInput, match="is no file; name an"):
        Detector(path)
    path.write_bytes(network(channels=84))
    with pytest.raises(InvalidInput, match=r"is not for fastestdet: outputs \[\(1, 84, 22, 22\)\]"):
        Detector(path)
    path.write_bytes(b"not a network")
    with pytest.raises(InvalidInput, match="OpenCV cannot read it"):
        Detector(path)
    with pytest.raises(InvalidInput, match="'yolo' is none of fastestdet, or MODULE:CLASS"):
        Detector(path, "yolo")
    monkeypatch.setattr(detector, "MOST_BYTES", 12)
    with pytest.raises(InvalidInput, match="13 bytes, at most 12"):
        Detector(path)


def test_a_licence_beside_the_file_is_found(model):
    assert Detector(model).licence is None
    (model.parent / "LICENSE.txt").write_text("BSD")
    assert Detector(model).licence == model.parent / "LICENSE.txt"


def test_a_picture_that_the_detector_fails_on_is_counted_and_the_next_one_is_seen():
    class FailsOnDark:
        def boxes(self, picture):
            if not picture.max() > 100:
                raise DetectorFailed("dark")
            return [Box(1, 2, 3, 4, "car", 0.5)]

    noted = DetectedBoxes.__new__(DetectedBoxes)
    noted._detector, noted.failed = FailsOnDark(), 0
    pictures = [i420_from_rgb(street(at, (64, 64))) for at in ([], [(16, 16)])]
    dark, bright = noted.of(pictures, pictures)["boxes"]
    assert (of_text(dark), of_text(bright)) == (None, [Box(1, 2, 3, 4, "car", 0.5)])
    assert noted.failed == 1
    assert of_text(as_text([])) == []


def a_car(left, score=1.0, size=40.0):
    return Box(left, 10.0, size, size, "car", score)


TRUTH = [[a_car(10), a_car(100)], [a_car(10)], [a_car(200, size=20.0)], [a_car(10), a_car(300)]]


def test_precision_is_whole_for_what_is_seen_and_nought_for_nothing():
    assert Precision(TRUTH, TRUTH, ["car"]).percent()[ALL, ALL] == pytest.approx(100)
    assert Precision(TRUTH, [[]] * 4, ["car"]).percent()[ALL, ALL] == 0


def test_precision_by_size_counts_the_boxes_of_that_size():
    found = Precision(TRUTH, [TRUTH[0], TRUTH[1], [], TRUTH[3]], ["car"]).percent()
    assert found["car", "small"] == 0
    assert found["car", "medium"] == pytest.approx(100)
    assert ("car", "large") not in found


def test_precision_of_half_of_what_is_there_is_the_recall_reached():
    """Three of six, none false: precision 1 up to a recall of 0.5, at 51 of COCO's 101 steps."""
    found = [[a_car(10, 0.9)], [a_car(10, 0.8)], [], [a_car(300, 0.7)]]
    assert Precision(TRUTH, found, ["car"]).percent()[ALL, ALL] == pytest.approx(100 * 51 / 101)


def test_precision_of_drawn_frames_is_that_of_a_drive_of_these_frames():
    found = [[a_car(12, 0.9)], [a_car(10, 0.3), a_car(50, 0.8)], [], [a_car(305, 0.7)]]
    drawn = [3, 1, 1, 0]
    of_all = Precision(TRUTH, found, ["car"])
    alone = Precision([TRUTH[k] for k in drawn], [found[k] for k in drawn], ["car"])
    assert of_all.percent(drawn) == alone.percent()


def test_classes_of_few_boxes_do_not_count():
    boxes = [[a_car(k) for k in range(10)], [Box(0, 0, 9, 9, "bus")] * 9]
    assert counted_classes(boxes) == ["car"]


def test_a_point_that_another_one_beats_is_left_out_of_the_curve():
    percents, rates = [10, 30, 25, 40, 60, 70], [100, 200, 300, 400, 500, 600]
    curve = precision_curve(percents, rates)
    assert curve.psnr_db.tolist() == [10, 30, 40, 60, 70]
    half = precision_curve(percents, [rate / 2 for rate in rates])
    assert bd_rate_percent(curve, half, (10, 70)) == pytest.approx(-50)


def test_the_interval_of_half_the_bytes_is_half_the_bytes():
    cars = [[a_car(10 * k) for k in range(8)]] * 6
    points = [Precision(cars, [each[:seen] for each in cars], ["car"]) for seen in (2, 4, 6, 8)]
    rates = [np.full(6, n) for n in (100, 200, 400, 800)]
    draws = [np.random.default_rng(k).integers(0, 6, 6) for k in range(5)]
    theirs = drawn_curves(list(zip(points, rates, strict=True)), draws)
    ours = drawn_curves([(p, r // 2) for p, r in zip(points, rates, strict=True)], draws)
    assert interval(ours, theirs) == pytest.approx((-50, -50))
    assert interval(ours, [None, *theirs[1:]]) is None


def test_masks_hold_a_box_that_is_missed_and_both_is_where_the_field_errs_too():
    size = (64, 96)
    flat = np.full(size, 100, np.uint8)
    chroma = np.full((32, 48), 128, np.uint8)
    seen = flat.copy()
    seen[16:48, 60:80] = 180
    frames = [I420(seen, chroma, chroma)] * (HELD_FRAMES + 3)
    camera = Camera(Intrinsics(96, 64, 80.0, 80.0, 48.0, 32.0), Pose.identity())
    view = FieldView(camera, I420(flat, chroma, chroma), np.ones(size, "f4"), np.ones(size, "f4"))
    rendered = RenderedClip((view,) * len(frames), (), "", 0.0)
    box = Box(40, 20, 24, 16, "car", 0.9)
    boxes = [[box], None, *[[]] * (HELD_FRAMES + 1)]
    masks = object_masks(boxes, rendered, frames)
    held = [mask.any() for mask in masks["detector"]]
    assert held == [True] * (1 + HELD_FRAMES) + [False] * 2
    rows, columns = np.nonzero(masks["detector"][0])
    assert (columns.min(), rows.min()) == (40 - GROWN_PX, 20 - GROWN_PX)
    assert masks["unexplained"][0][32, 70]
    assert not masks["unexplained"][0][32, 30]
    both = masks["detector"][0] & masks["unexplained"][0]
    assert np.array_equal(masks["both"][0], both)
    assert both.any()


def seen_drive():
    """Twelve frames with eight cars; the more bytes, the more of them are seen. One is not seen."""
    cars = [a_car(50 * k, size=20.0 if k < 4 else 50.0) for k in range(8)]
    clip = Clip("cars", 10.0, [I420.filled((16, 16), 0)] * 12, "", None)

    def coded(seen, size):
        boxes = [as_text(cars[:seen])] * 11 + ["null"]
        mse = np.full(12, 1000 / size)
        notes = {"boxes": tuple(boxes)}
        return CodedClip(seen, np.full(12, size), mse, np.ones(12), 1.0, notes)

    def clips(factor):
        return [coded(seen, factor * 100 * 2**seen) for seen in (2, 4, 5, 6, 7, 8)]

    cost = CostRow("cars@10", 12, 0, 1.0, 1.0)
    detection = DriveDetection("cars@10", clip, {}, {"itself": [cars] * 12}, (3,), cost)
    methods = {"rfedge": clips(1), "rfedge-both": clips(2), "x264": clips(4)}
    return detection, method_curves(detection, "itself", methods)


def test_bd_rates_over_precision_are_the_ratios_of_bytes(monkeypatch):
    monkeypatch.setattr(measure, "REPETITIONS", 10)
    detection, curves = seen_drive()
    rows = bd_rows(detection, "itself", curves, quick=False)
    found = {(row.method, row.rival): row for row in rows}
    percents = {"rfedge": {"x264": -75}, "rfedge-both": {"x264": -50, "rfedge": 100}}
    assert found.keys() == {(m, r) for m, rivals in percents.items() for r in rivals}
    for (method, rival), row in found.items():
        assert row.bd_rate_percent == pytest.approx(percents[method][rival])
        assert row.ci95 == pytest.approx((row.bd_rate_percent,) * 2)


def test_at_equal_bits_the_dearer_coder_sees_less_and_a_failed_frame_sees_nothing():
    detection, curves = seen_drive()
    assert detection.counted == [1, 2, *range(4, 12)]
    at_db = curves[0].clips[2].psnr_db()  # five of eight
    rows = list(equal_bits_rows(detection, "itself", curves, at_db))
    whole = {r.method: r for r in rows if r.class_ == r.size == ALL}
    assert {round(r.bytes_per_frame) for r in rows} == {3200}
    assert whole["rfedge"].map > whole["rfedge-both"].map > whole["x264"].map
    assert whole["rfedge"].boxes == 80
    best = curves[0].precisions[-1].percent()[ALL, ALL]
    assert best == pytest.approx(100 * 91 / 101)  # nine tenths of what is there
    with pytest.raises(InvalidInput, match="choose another --at-db"):
        list(equal_bits_rows(detection, "itself", curves, 10.0))


@pytest.mark.slow
@pytest.mark.sample
def test_a_drive_has_rows_for_every_method_and_the_missing_licence_is_said(
    model, tmp_path, monkeypatch
):
    monkeypatch.setattr(measure, "QUICK", Runs(1, 4))
    console = Console(file=io.StringIO(), width=200)
    drive = "vehicles@10=samples/street/transforms_drive_vehicles.json"
    out = tmp_path / "detect.json"
    options = {"out": out, "cells": tmp_path / "cells", "quick": True, "detector": model}
    run_detect(
        EvalDetect(field=Path("samples/fields/street.rff"), drives=(drive,), **options), console
    )
    result = json.loads(out.read_text())
    whole = [r for r in result["rows"] if r["class"] == r["size"] == "all"]
    methods = ["rfedge", "rfedge-detector", "rfedge-unexplained", "rfedge-both"]
    assert [r["method"] for r in whole][:4] == methods
    assert len({r["bytes_per_frame"] for r in whole}) == 1
    assert all(0 <= r["map"] <= 100 for r in result["rows"])
    assert "no licence" in console.file.getvalue()
