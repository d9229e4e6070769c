"""Charts are SVG that parses, show every value, and are the same bytes each time."""

import base64
import csv
import re
from xml.etree import ElementTree

import av
import numpy as np
import pytest
from matplotlib import pyplot as plt

from rfcore.errors import InvalidInput
from rfedge.report.charts import (
    DIFFERENCE_GAIN,
    HEADER,
    PAYLOAD,
    RECONSTRUCTION,
    RENDER,
    STAGES,
    amplified_difference,
    bytes_chart,
    curve_chart,
    embedded,
    quality_chart,
    stages_chart,
    write_figure,
)

SVG = "{http://www.w3.org/2000/svg}"
STAGE_MS = {stage: 1.5 + k for k, stage in enumerate(STAGES)}


def parsed(svg: str) -> ElementTree.Element:
    root = ElementTree.fromstring(svg)
    assert root.tag == f"{SVG}svg"
    return root


def texts(svg: str) -> str:
    return " ".join("".join(node.itertext()).strip() for node in parsed(svg).iter(f"{SVG}text"))


def bars(svg: str, colour: str) -> list[float]:
    """Return the heights of the bars of one colour, in the drawing's units."""
    found = []
    for node in parsed(svg).iter(f"{SVG}path"):
        if f"fill: {colour}" in node.get("style", "") and node.get("clip-path"):
            ys = [float(part) for part in node.get("d", "").replace("L", "M").split()[2::3]]
            found.append(max(ys) - min(ys))
    return found


def points(svg: str, colour: str) -> list[tuple[float, float]]:
    """Return the corners of the one line of a colour."""
    (line,) = [
        node.get("d", "")
        for node in parsed(svg).iter(f"{SVG}path")
        if f"stroke: {colour}; stroke-width: 2" in node.get("style", "")
    ]
    numbers = [float(part) for part in line.replace("M", " ").replace("L", " ").split()]
    return list(zip(numbers[::2], numbers[1::2], strict=True))


def test_bars_are_as_high_as_the_bytes_of_their_frames():
    payload, packets = [1000, 2000, 500], [1300, 2300, 800]
    svg = bytes_chart(payload, packets)
    heights = bars(svg, PAYLOAD)[:3]
    assert np.array(heights) / heights[0] == pytest.approx([1.0, 2.0, 0.5], rel=1e-3)
    headers = bars(svg, HEADER)[:3]
    assert headers == pytest.approx([0.3 * heights[0]] * 3, rel=1e-3)


def test_quality_is_drawn_to_one_scale_for_reconstruction_and_render():
    svg = quality_chart([34.0, 35.0, 36.0], [28.0, 28.0, 30.0])
    ours, render = points(svg, RECONSTRUCTION), points(svg, RENDER)
    per_db = ours[0][1] - ours[1][1]
    assert per_db > 0, "up is better"
    assert render[0][1] - ours[0][1] == pytest.approx(6 * per_db, rel=1e-3)
    assert render[0][1] - render[2][1] == pytest.approx(2 * per_db, rel=1e-3)
    assert "reconstruction" in texts(svg)
    assert "render alone" in texts(svg)


def test_a_training_curve_ends_in_its_figure():
    svg = curve_chart([(1.0, 20.0), (2.0, 25.0), (4.0, 27.125)])
    assert "27.12 dB" in texts(svg)
    (x0, _), (x1, _), (x2, _) = points(svg, PAYLOAD)
    assert (x2 - x1) / (x1 - x0) == pytest.approx(2.0, rel=1e-3)


def test_every_stage_is_named_with_its_milliseconds_in_the_frames_order():
    shown = texts(stages_chart({**STAGE_MS, "something else": 99.0}))
    for label, ms in zip(STAGES.values(), STAGE_MS.values(), strict=True):
        assert label in shown
        assert f"{ms:.1f}" in shown
    assert [shown.index(label) for label in STAGES.values()] == sorted(
        shown.index(label) for label in STAGES.values()
    )
    assert "99.0" not in shown


def test_a_missing_stage_is_named():
    partial = {k: v for k, v in STAGE_MS.items() if k not in ("link", "encode")}
    with pytest.raises(InvalidInput, match="no value for encode, link"):
        stages_chart(partial)


@pytest.mark.parametrize(
    "draw",
    [
        lambda: bytes_chart([], []),
        lambda: bytes_chart([1, 2], [3]),
        lambda: quality_chart([], []),
        lambda: quality_chart([1.0], []),
        lambda: curve_chart([]),
    ],
)
def test_nothing_to_draw_is_an_error(draw):
    with pytest.raises(InvalidInput, match="give one or more of each"):
        draw()


def test_equal_charts_are_equal_bytes_and_no_figure_stays_open():
    before = plt.get_fignums()
    for draw in (
        lambda: bytes_chart([1, 2], [3, 4]),
        lambda: quality_chart([30.0, 31.0], [20.0, 21.0]),
        lambda: stages_chart(STAGE_MS),
    ):
        assert draw() == draw()
    assert plt.get_fignums() == before


def test_a_figure_has_its_numbers_beside_it_and_no_date(tmp_path):
    lines = [["scene", "ms"], ["a, b", "1.5"], ['say "c"', "2"]]
    for folder in ("one", "two"):
        figure, axes = plt.subplots()
        axes.plot([1, 2])
        drawing, numbers = write_figure(tmp_path / folder / "fig", figure, lines)
        assert (drawing.name, numbers.name) == ("fig.svg", "fig.csv")
        with numbers.open(newline="") as file:
            assert list(csv.reader(file)) == lines
    assert drawing.read_bytes() == (tmp_path / "one" / "fig.svg").read_bytes()
    assert b"<dc:date>" not in drawing.read_bytes()
    ElementTree.fromstring(drawing.read_text())


@pytest.mark.parametrize("lines", [[], [["a", "b"]], [["a", "b"], ["1"]]])
def test_a_figure_without_its_numbers_is_refused(tmp_path, lines):
    figure, _ = plt.subplots()
    with pytest.raises(InvalidInput, match="fig: its CSV needs"):
        write_figure(tmp_path / "fig", figure, lines)
    plt.close(figure)
    assert list(tmp_path.iterdir()) == []


def test_a_difference_is_amplified_and_never_wraps():
    shown = np.array([[[0, 100, 255]]], np.uint8)
    camera = np.array([[[10, 90, 0]]], np.uint8)
    step = 10 * DIFFERENCE_GAIN
    assert amplified_difference(shown, camera).tolist() == [[[128 - step, 128 + step, 255]]]
    assert amplified_difference(camera, shown).tolist() == [[[128 + step, 128 - step, 0]]]


def test_the_charts_of_the_frames_lie_in_one_frame():
    """Side by side, frame k stands over frame k, and the axes at one height."""
    drawn = [bytes_chart([9, 8, 7], [10, 9, 8]), quality_chart([34.0, 35.0, 36.0], [28.0] * 3)]
    boxes = [parsed(svg).get("viewBox") for svg in drawn]
    assert boxes[0] == boxes[1]
    axes = [re.findall(r"<clipPath.*?>\s*<rect (.*?)/>", svg, re.DOTALL) for svg in drawn]
    assert axes[0] == axes[1] != []


def test_pictures_are_embedded_whole_with_their_captions():
    picture = np.full((16, 24, 3), 128, np.uint8)
    (entry,) = embedded([("camera <a>", picture)])
    assert entry["caption"] == "camera <a>"
    decoder = av.CodecContext.create("mjpeg", "r")
    packet = av.Packet(base64.b64decode(entry["data"]))
    frames = [*decoder.decode(packet), *decoder.decode(None)]
    (shown,) = [frame.to_ndarray(format="rgb24") for frame in frames]
    assert shown.shape == picture.shape
    assert np.abs(shown.astype(int) - 128).max() <= 3
