"""Regions of a wall with plain geometry: the content of macroblocks, and their bits."""

from dataclasses import replace

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.image import I420
from rfcore.views import FieldView
from rfedge.evaluate.compare.bits import KINDS, SplitClip, macroblock_kinds, split_rows
from rfedge.evaluate.field_coder import FieldCoder, RenderedClip

SIZE = (96, 64)
INTRINSICS = Intrinsics(*SIZE, 64.0, 64.0, 48.0, 32.0)
EVERYWHERE = np.ones(SIZE[::-1], bool)
NOWHERE = ~EVERYWHERE


def picture(luma):
    chroma = np.full((SIZE[1] // 2, SIZE[0] // 2), 128, np.uint8)
    return I420(luma, chroma, chroma)


FLAT = picture(np.full(SIZE[::-1], 90, np.uint8))


def wall(x_m=0.0, depth_m=4.0):
    camera = Camera(INTRINSICS, Pose((x_m, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
    return FieldView(camera, FLAT, np.full(SIZE[::-1], depth_m, np.float32))


def names(*args):
    return [[KINDS[kind] for kind in row] for row in macroblock_kinds(*args)]


def test_a_camera_that_stands_still_sees_what_it_saw():
    assert names(wall(), wall(), EVERYWHERE, NOWHERE) == [["static"] * 6] * 4


def test_a_camera_that_goes_right_sees_its_right_edge_for_the_first_time():
    # 1 m at 4 m depth and f = 64 px is 16 px: one macroblock.
    assert names(wall(), wall(1.0), EVERYWHERE, NOWHERE) == [["static"] * 5 + ["entering"]] * 4


def test_a_wall_that_stood_behind_another_is_disoccluded():
    front = wall().depth.copy()
    front[:, :32] = 2.0
    before = replace(wall(), depth=front)
    assert names(before, wall(), EVERYWHERE, NOWHERE)[0] == ["disoccluded"] * 2 + ["static"] * 4


def test_what_the_field_lacks_comes_before_what_moves():
    covered, moving = EVERYWHERE.copy(), NOWHERE.copy()
    covered[:16, :16] = False
    moving[:16, :32] = True
    assert names(wall(), wall(), covered, moving)[0][:3] == ["off-map", "moving", "static"]


def test_bits_go_where_the_frame_differs_from_the_field():
    rng = np.random.default_rng(3)
    moving = NOWHERE.copy()
    moving[16:48, 16:48] = True
    noisy = [FLAT.y.copy() for _ in range(3)]
    for luma in noisy:
        luma[moving] = rng.integers(30, 220, moving.sum())
    seen = RenderedClip((wall(),) * 3, (EVERYWHERE,) * 3, "field", 0.0)
    rows = split_rows([SplitClip([picture(y) for y in noisy], seen, [moving] * 3, "fast", 26.0)])
    shares = {row["shows"]: row for row in rows}
    assert shares["moving"]["slice_percent"] > 90
    assert shares["moving"]["area_percent"] == pytest.approx(100 * 4 / 24)
    assert sum(row["slice_percent"] for row in rows) == pytest.approx(100)


def test_without_anything_new_every_macroblock_is_of_one_kind():
    kinds = macroblock_kinds(wall(), wall(), EVERYWHERE, NOWHERE)
    assert kinds.shape == (4, 6)
    assert len(np.unique(kinds)) == 1


def test_a_field_that_covers_nothing_is_off_the_map_whatever_moves():
    moving = NOWHERE.copy()
    moving[:32] = True
    assert names(wall(), wall(1.0), NOWHERE, moving) == [["off-map"] * 6] * 4


@pytest.mark.parametrize(("rows", "kind"), [(3, "static"), (4, "moving")])
def test_a_macroblock_is_of_a_kind_that_covers_a_quarter_of_it(rows, kind):
    moving = NOWHERE.copy()
    moving[:rows, :16] = True
    assert names(wall(), wall(), EVERYWHERE, moving)[0][0] == kind


def test_shares_are_whole_and_bytes_are_those_of_the_slices():
    rng = np.random.default_rng(4)
    frames = [picture(rng.integers(60, 200, SIZE[::-1]).astype(np.uint8)) for _ in range(3)]
    still = picture(np.full(SIZE[::-1], 120, np.uint8))
    views = (replace(wall(), render=still),) * 3
    rendered = RenderedClip(views, (EVERYWHERE,) * 3, "field", 0.0)
    rows = split_rows([SplitClip(frames, rendered, [NOWHERE] * 3, "fast", 30.0)])
    assert sum(row["area_percent"] for row in rows) == pytest.approx(100)
    assert sum(row["slice_percent"] for row in rows) == pytest.approx(100)
    clip = FieldCoder(rendered, "ours", "test", effort="fast").code(frames, 10, 30.0)
    slices = np.array(clip.notes["slice_bytes"])[1:]
    assert sum(row["bytes_per_frame"] for row in rows) == pytest.approx(slices.mean())
