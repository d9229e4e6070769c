"""Drives of the command line, and feeds in other axes than the field's."""

import math
from pathlib import Path

import numpy as np
import pytest

from lab.localisation.given import GivenDrive, aligned_poses, read_pose_lines
from rfcore.camera import Pose
from rfcore.errors import InvalidInput
from rfcore.motion import quaternion_from_vector
from rfedge.localisation.searches import StartError

SAMPLES = Path(__file__).parents[2] / "samples"


def pose(x: float, yaw: float) -> Pose:
    return Pose((x, 0.1 * x, 2.0), quaternion_from_vector((0.0, yaw, 0.02)))


def test_every_key_is_taken():
    given = GivenDrive.parse("a=d.json,f.rff,units=2,hz=5,frames=9,noise=3,rows=bits")
    assert (given.name, given.drive, given.field) == ("a", Path("d.json"), Path("f.rff"))
    assert (given.units, given.hz, given.frames, given.noise) == (2.0, 5.0, 9, 3.0)
    assert given.rows == "bits"
    assert GivenDrive.parse("a=d.json,f.rff,rows=2m:3deg").rows == StartError(2, 3)
    fed = GivenDrive.parse("a=d.json,f.rff,feed=p.txt,feed_map=m.txt,map=m.json")
    assert (fed.feed, fed.feed_map, fed.map) == (Path("p.txt"), Path("m.txt"), Path("m.json"))


@pytest.mark.parametrize(
    "text",
    [
        "here",
        "a=d.json",
        "a=d.json,f.rff,speed=3",
        "a=d.json,f.rff,units=0",
        "a=d.json,f.rff,units=x",
        "a=d.json,f.rff,rows=2m",
        "a=d.json,f.rff,feed=p.txt",
    ],
)
def test_other_text_is_refused(text):
    with pytest.raises(InvalidInput, match=r"drives|start_error: '2m' is not"):
        GivenDrive.parse(text)


def test_a_feed_in_other_axes_is_put_where_the_map_lies_and_keeps_its_drift():
    truth = [pose(float(n), 0.1 * n) for n in range(6)]
    axes = Pose((5.0, -3.0, 1.0), quaternion_from_vector((0.3, -1.0, 0.4)))
    known = [axes.compose(p) for p in truth]
    second = Pose((3.0, 0.7, 2.0), quaternion_from_vector((0.0, 0.2, 0.0)))
    (found,) = aligned_poses([axes.compose(second)], known, truth)
    off = second.inverse().compose(found)
    assert math.hypot(*off.translation_m) < 1e-9
    assert abs(off.rotation[0]) == pytest.approx(1.0, abs=1e-12)


def test_a_map_with_another_number_of_poses_is_refused():
    with pytest.raises(InvalidInput, match="2 poses for 1 pictures"):
        aligned_poses([], [pose(0, 0), pose(1, 0)], [pose(0, 0)])


def test_pose_lines_are_read_and_others_refused(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("1 0 0 4 0 1 0 5 0 0 1 6\n0 -1 0 0 1 0 0 0 0 0 1 0\n")
    first, second = read_pose_lines(path)
    assert first == Pose((4.0, 5.0, 6.0), (1.0, 0.0, 0.0, 0.0))
    assert second.apply((1.0, 0.0, 0.0)) == pytest.approx((0.0, 1.0, 0.0))
    path.write_text("1 2 3\n")
    with pytest.raises(InvalidInput, match="12 numbers"):
        read_pose_lines(path)


@pytest.mark.sample
def test_noise_has_the_deviation_asked_for_and_is_the_same_each_time():
    drive = SAMPLES / "street/transforms_drive_empty.json"
    plain, noisy = (
        GivenDrive("a", drive, SAMPLES / "fields/street.rff", noise=sigma).read(1)[1][0]
        for sigma in (0.0, 3.0)
    )
    difference = noisy.read().astype(float) - plain.read()
    assert difference.std() == pytest.approx(3.0, rel=0.05)
    assert np.array_equal(noisy.read(), noisy.read())
