"""``rfedge-lab rig`` reads its figures off the twin."""

import pytest

from lab.rig.run import instants_apart, spreads_of
from rfcore.camera import Intrinsics, Pose
from rfcore.wire.twin import PictureEncoding, TwinPicture


def shown(camera_id: str, instant: int, captured_ms: int = 0, age_ms: int = 0) -> TwinPicture:
    return TwinPicture(
        vehicle_id="rig",
        camera_id=camera_id,
        session_id="s",
        epoch=0,
        sequence=instant,
        capture_time_ns=captured_ms * 1_000_000,
        age_ns=age_ms * 1_000_000,
        pose=Pose.identity(),
        intrinsics=Intrinsics(4, 2, 1.0, 1.0, 2.0, 1.0),
        field_id="ab" * 32,
        reconstruction_digest=b"d" * 16,
        encoding=PictureEncoding.NONE,
        picture=b"",
        instant=instant,
    )


def test_the_spread_of_an_instant_is_from_its_first_to_its_last_picture():
    pictures = [
        shown("a", 1, 100, 30),
        shown("b", 1, 100, 75),
        shown("a", 2, 200, 30),
        shown("a", 3, 300, 20),
        shown("b", 3, 305, 25),
    ]
    spread = spreads_of(pictures, 2)
    assert spread.whole == 2, "the second was shown by one camera alone"
    assert spread.milliseconds == pytest.approx((45.0, 10.0))


def test_instants_apart_counts_once_every_camera_has_shown_one():
    pictures = [shown("a", 1), shown("a", 2), shown("b", 2), shown("a", 3), shown("b", 3)]
    assert instants_apart(pictures, 2) == 1
    assert instants_apart([*pictures, shown("a", 4), shown("a", 5)], 2) == 2
    assert instants_apart(pictures, 3) is None
    assert instants_apart([*pictures, shown("a", 9), shown("b", 9)], 2) == 1, "4 to 8 were dropped"
