"""Which passes are learnt from, and which frames of them are held back."""

import pytest

from rfcore.errors import InvalidInput
from rfcore.update.passes import Pass, check_passes, split_frames


def test_a_quarter_of_each_pass_is_held_back(noon, make_pass):
    passes = [make_pass(noon, "a"), make_pass(noon, "b")]
    learnt, held_back = split_frames(passes, 16)
    assert [frame.pass_number for frame in held_back] == [0, 0, 1, 1]
    assert len(learnt) == 12
    cameras = {frame.camera.world_from_cam for frame in learnt}
    assert not cameras & {frame.camera.world_from_cam for frame in held_back[:2]}


def test_one_vehicle_alone_is_not_believed(noon, make_pass):
    twice = [make_pass(noon, "a"), make_pass(noon, "a", 0.1)]
    with pytest.raises(InvalidInput, match=r"passes of 1 vehicle\(s\) \(a\), at least 2"):
        check_passes(twice, 2)
    check_passes(twice, 1)


def test_a_pass_of_a_few_frames_is_refused(noon, make_pass):
    short = Pass("a", make_pass(noon).pictures[:7])
    with pytest.raises(InvalidInput, match="a: 7 frames, at least 8"):
        check_passes([short], 1)
