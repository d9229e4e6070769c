"""Cameras take turns to be compared; one that is looked at does not wait a second."""

from concurrent.futures import Executor
from dataclasses import replace
from unittest.mock import Mock

from rfcore.field import SplatField
from rfcore.image import rgb_from_bytes
from rfcore.perception.objects import CameraKey
from rfedge.twin.comparing import Comparer, compared
from rfedge.twin.scene import Board, PlacedField, TwinScene
from wall_scene import seen


def street(wall: SplatField, *keys: CameraKey) -> tuple[TwinScene, Comparer]:
    scene = TwinScene(Board())
    scene.place(PlacedField(wall, "tile", b""), 0.0)
    for key in keys:
        scene.show(seen(wall, key=key), 0.0)
    return scene, Comparer(scene, Mock(Executor))


def next_picture(scene: TwinScene, key: CameraKey) -> None:
    newest = scene.newest[key]
    scene.show(replace(newest, sequence=newest.sequence + 1), 0.0)


def test_a_camera_nobody_looks_at_is_compared_once_a_second(wall: SplatField) -> None:
    key = ("cav-1", "front")
    scene, comparer = street(wall, key)
    first = comparer.due(0.0)
    assert first is not None
    comparer.began(first, 0.0)
    assert comparer.due(0.5) is None
    next_picture(scene, key)
    assert comparer.due(0.5) is None
    assert comparer.due(1.0) is scene.newest[key]


def test_a_camera_that_is_looked_at_is_compared_with_every_new_picture(wall: SplatField) -> None:
    key = ("cav-1", "front")
    scene, comparer = street(wall, key)
    comparer.select(key)
    comparer.began(scene.newest[key], 0.0)
    assert comparer.due(0.01) is None, "the same picture again"
    next_picture(scene, key)
    assert comparer.due(0.01) is scene.newest[key]
    comparer.release(key)
    assert comparer.due(0.01) is None


def test_cameras_take_turns(wall: SplatField) -> None:
    keys = [(f"cav-{i}", "front") for i in range(3)]
    scene, comparer = street(wall, *keys)
    for key in keys:
        comparer.select(key)
    compared = []
    for now_ms in range(9):
        picture = comparer.due(now_ms / 1000)
        assert picture is not None
        comparer.began(picture, now_ms / 1000)
        compared.append(picture.key)
        next_picture(scene, picture.key)
    assert sorted(compared[:3]) == keys
    assert compared[:3] == compared[3:6] == compared[6:]


def test_a_picture_waits_for_its_field(wall: SplatField) -> None:
    scene = TwinScene(Board())
    scene.show(seen(wall), 0.0)
    comparer = Comparer(scene, Mock(Executor))
    assert comparer.due(0.0) is None
    scene.place(PlacedField(wall, "tile", b""), 0.0)
    assert comparer.due(0.0) is not None


def test_a_vehicle_that_is_lost_is_compared_with_nothing(wall: SplatField) -> None:
    scene, comparer = street(wall)
    scene.show(replace(seen(wall), pose=None), 0.0)
    assert comparer.due(0.0) is None


def test_a_picture_of_the_field_itself_is_close_and_its_difference_grey(wall: SplatField) -> None:
    picture = seen(wall, object_level=250)
    assert picture.pose is not None
    same = compared(seen(wall), picture.pose, wall).header["psnr_db"]
    assert same is None or same > 35  # JPEG loses little of a plain wall
    render, difference = compared(picture, picture.pose, wall).parts
    shown = rgb_from_bytes(difference, "difference").astype(int)
    assert abs(shown[:8, :8].mean() - 128) < 3
    assert shown[28:36, 44:68].min() > 200
    assert rgb_from_bytes(render, "render").shape == shown.shape
