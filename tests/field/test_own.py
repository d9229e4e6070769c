"""Fields that a user's class renders: what is checked of it, and that its ``render`` is used."""

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field import FULL
from rfcore.field.own import OwnField, own_field
from rfcore.views import View

CAMERA = Camera(Intrinsics(20, 12, 15.0, 15.0, 10.0, 6.0), Pose.identity())
ID = "5a" * 32


class Wall:
    """A grey wall at 3 m; a picture's arrays can be replaced by ``changes``."""

    field_id = ID

    def __init__(self, **changes):
        self.changes = changes

    def render(self, camera, _quality):
        size = camera.intrinsics.height_px, camera.intrinsics.width_px
        ones = np.ones(size, np.float32)
        grey = np.full((*size, 3), 0.5, np.float32)
        arrays = {"colour": grey, "depth": 3 * ones, "opacity": ones}
        return View(**{k: self.changes.get(k, lambda a: a)(a) for k, a in arrays.items()})


def test_a_class_with_an_id_and_render_is_a_field():
    field = OwnField(Wall(), "walls.Wall")
    view = field.render(CAMERA)
    assert view.colour.shape == (12, 20, 3)
    assert (view.depth == 3).all()
    assert np.array_equal(field.render_colour(CAMERA, FULL), view.colour)
    assert (field.field_id, field.exact, field.size_bytes) == (ID, False, 0)
    assert field.with_threads(4) is field


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("colour", lambda a: a[..., :1]),
        ("colour", lambda a: a.astype(np.float64)),
        ("depth", lambda a: a.T),
        ("depth", lambda a: a * np.float32(np.inf)),
        ("opacity", lambda a: a.tolist()),
        ("colour", lambda a: a * np.float32(np.nan)),
    ],
)
def test_a_view_of_another_form_is_refused_when_the_class_is_loaded(key, change):
    with pytest.raises(InvalidInput, match=f"walls.Wall.render: {key}"):
        OwnField(Wall(**{key: change}), "walls.Wall")


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("colour", lambda a: 255 * a),
        ("colour", lambda a: (255 * a).astype(np.uint8)),
        ("opacity", lambda a: 255 * a),
    ],
)
def test_a_picture_in_levels_is_named_as_such(key, change):
    with pytest.raises(InvalidInput, match=rf"{key}.* 0\.\.1"):
        OwnField(Wall(**{key: change}), "walls.Wall")
    bright = np.float32(1.5)
    assert (
        OwnField(Wall(colour=lambda a: a * 2 * bright), "w").render(CAMERA).colour.max() == bright
    )


@pytest.mark.parametrize("field_id", ["", "street", "5A" * 32, None, 7])
def test_an_id_that_is_no_digest_is_refused(field_id):
    wall = Wall()
    wall.field_id = field_id
    with pytest.raises(InvalidInput, match="64 hexadecimal digits"):
        OwnField(wall, "walls.Wall")


def test_an_error_of_the_class_and_a_view_of_another_type_are_one_line():
    wall = Wall()
    wall.render = lambda *_: 1 / 0
    with pytest.raises(InvalidInput, match="render raised ZeroDivisionError"):
        OwnField(wall, "walls.Wall")
    wall.render = lambda *_: (1, 2)
    with pytest.raises(InvalidInput, match="returned tuple, not a View"):
        OwnField(wall, "walls.Wall")


def test_a_class_without_the_members_is_refused_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rooms_here.py").write_text("class Empty:\n    pass\n")
    with pytest.raises(InvalidInput, match=r"rooms_here\.Empty lacks field_id, render"):
        own_field("rooms_here:Empty")
    with pytest.raises(InvalidInput, match="no 'Full'"):
        own_field("rooms_here:Full")
    with pytest.raises(InvalidInput, match="no_module_here"):
        own_field("no_module_here:Full")
