"""Where a picture and the field disagree, by algebra: a wall, and a box painted on the picture."""

import numpy as np
import pytest

from rfcore.field import SplatField
from rfcore.image import rgb_from_bytes
from rfedge.twin.comparing import BLOCK_PX, Comparison, compared, largest_disagreement
from rfedge.twin.scene import SeenPicture
from wall_scene import WALL_M, seen


def compared_here(picture: SeenPicture, field: SplatField) -> Comparison:
    assert picture.pose is not None
    return compared(picture, picture.pose, field)


def test_a_picture_of_the_field_itself_is_close_and_unmarked(wall: SplatField) -> None:
    header = compared_here(seen(wall), wall).header
    assert header["psnr_db"] is None or header["psnr_db"] > 35  # JPEG loses little of a plain wall
    assert header["mark"] is None


def test_an_object_is_marked_at_its_foot_in_metres(wall: SplatField) -> None:
    header = compared_here(seen(wall, object_level=250), wall).header
    # 48 px wide, centred at column 56 of focal length 80 px around 48, its foot at row 48 around 32
    assert header["mark"]["width_m"] == pytest.approx(48 / 80 * WALL_M, rel=0.02)
    expected_m = ((56 - 48) / 80 * WALL_M, (47.5 - 32) / 80 * WALL_M, WALL_M)
    assert header["mark"]["position_m"] == pytest.approx(expected_m, rel=0.02)
    assert header["mark"]["blocks"] == 6


def test_the_difference_is_grey_where_both_agree(wall: SplatField) -> None:
    render, difference = compared_here(seen(wall, object_level=250), wall).parts
    shown = rgb_from_bytes(difference, "difference").astype(int)
    assert abs(shown[:8, :8].mean() - 128) < 3
    assert shown[28:36, 44:68].min() > 200
    assert rgb_from_bytes(render, "render").shape == shown.shape


def test_the_largest_group_counts_and_corners_do_not_join() -> None:
    difference = np.zeros((4 * BLOCK_PX, 6 * BLOCK_PX), np.float32)

    def paint(row: int, column: int) -> None:
        rows, columns = (slice(i * BLOCK_PX, (i + 1) * BLOCK_PX) for i in (row, column))
        difference[rows, columns] = -100

    for row, column in ((0, 0), (0, 1), (1, 2)):
        paint(row, column)
    assert largest_disagreement(difference) is None, "two blocks, and a third at their corner"
    for row, column in ((3, 3), (3, 4), (3, 5)):
        paint(row, column)
    blocks = largest_disagreement(difference)
    assert blocks is not None
    assert np.argwhere(blocks).tolist() == [[3, 3], [3, 4], [3, 5]]


def test_a_picture_smaller_than_a_block_has_no_mark() -> None:
    assert largest_disagreement(np.full((3, 5), 200, np.float32)) is None


def test_a_mark_needs_something_that_was_hit(wall: SplatField) -> None:
    behind = seen(wall, object_level=250)
    away = SeenPicture(**{**behind.__dict__, "pose": type(behind.pose)((0, 0, 50), (1, 0, 0, 0))})
    assert compared_here(away, wall).header["mark"] is None
