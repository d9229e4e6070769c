"""Our codec as a coder of clips: real packets of a real field, decoded by a receiver."""

from dataclasses import replace

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.references import RENDER_ONLY
from rfcore.errors import InvalidInput
from rfcore.native.yuv import i420_from_colour
from rfedge.evaluate import field_coder
from rfedge.evaluate.field_coder import WITHOUT_FIELD, FieldCoder, render_clip
from tests.clouds import cloud

INTRINSICS = Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0)


def street(seed):
    return cloud(seed, 300, [-3, -2, 4], [3, 2, 8], 0.25)


CAMERAS = [Camera(INTRINSICS, Pose((0.05 * k, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))) for k in range(4)]
FRAMES = [i420_from_colour(street(1).render_colour(camera)) for camera in CAMERAS]


def coded(field, point=23.0, **how):
    coder = FieldCoder(render_clip(field, CAMERAS), "ours", "test", effort="fast", **how)
    return coder.code(FRAMES, 10, point)


def test_the_right_field_costs_less_and_shows_more_than_a_wrong_one():
    right, wrong = coded(street(1)), coded(street(2))
    assert right.frame_bytes.sum() < wrong.frame_bytes.sum()
    assert right.luma_mse.mean() < wrong.luma_mse.mean()


def test_a_frame_costs_its_slice_and_its_header():
    clip = coded(street(2))
    headers = clip.frame_bytes - np.array(clip.notes["slice_bytes"])
    assert (headers > 18).all()
    assert (headers < 60).all()


def test_the_references_are_told_frame_by_frame():
    assert coded(street(2), references=RENDER_ONLY).notes["references"] == ("render",) * 4


def test_processor_time_holds_the_render():
    seen = render_clip(street(2), CAMERAS)
    slow = replace(seen, render_cpu_ms=1e6)
    clip = FieldCoder(slow, "ours", "test", effort="fast").code(FRAMES[:2], 10, 30.0)
    assert clip.cpu_ms == pytest.approx(5e5, rel=0.1)


def test_processor_time_is_coding_and_the_frames_share_of_rendering(monkeypatch):
    """7 ms of coding and 3 of decoding by a stopped clock, and 2 of 4 frames that took 40 ms to
    render, at either end."""
    clock = iter((1_000_000, 8_000_000, 9_000_000, 12_000_000))
    seen = replace(render_clip(street(2), CAMERAS), render_cpu_ms=40.0)
    monkeypatch.setattr(field_coder, "process_time_ns", lambda: next(clock))
    clip = FieldCoder(seen, "ours", "test", effort="fast").code(FRAMES[:2], 10, 30.0)
    assert clip.cpu_ms == pytest.approx(7 + 20)
    assert clip.receiver_cpu_ms == pytest.approx(3 + 20)


def test_without_the_field_nothing_is_rendered_and_nothing_of_it_is_referred_to(monkeypatch):
    clock = iter((1_000_000, 8_000_000, 9_000_000, 12_000_000))
    seen = replace(render_clip(street(2), CAMERAS), render_cpu_ms=40.0)
    monkeypatch.setattr(field_coder, "process_time_ns", lambda: next(clock))
    coder = FieldCoder(seen, "ours", "test", effort="fast", references=WITHOUT_FIELD)
    clip = coder.code(FRAMES, 10, 30.0)
    assert clip.notes["references"] == ("intra", "previous", "previous", "previous")
    assert (clip.cpu_ms, clip.receiver_cpu_ms) == (7, 3)


def test_squared_errors_of_the_foreground_are_noted_frame_by_frame():
    everything = [np.ones(frame.y.shape, bool) for frame in FRAMES]
    clip = coded(street(2), foregrounds=everything)
    np.testing.assert_allclose(
        clip.notes["foreground_sse"], clip.luma_mse * FRAMES[0].y.size, rtol=1e-12
    )


def versions(**change):
    given = {"field": street(2), "effort": "fast", "program": "a"} | change
    field, program = given.pop("field"), given.pop("program")
    return FieldCoder(render_clip(field, CAMERAS), "ours", program, **given).version


@pytest.mark.parametrize(
    "change",
    [
        {"effort": "x264-medium"},
        {"program": "b"},
        {"field": street(3)},
        {"references": RENDER_ONLY},
        {"photometric": ()},
        {"foregrounds": [np.ones((48, 64), bool)] * 4},
    ],
    ids=lambda change: next(iter(change)),
)
def test_whatever_changes_the_result_is_another_version(change):
    assert versions(**change) != versions()


def test_the_same_codec_has_the_same_version_again():
    assert versions() == versions()


def test_other_poses_are_another_version():
    near = FieldCoder(render_clip(street(2), CAMERAS), "ours", "a", effort="fast").version
    far = FieldCoder(render_clip(street(2), CAMERAS[::-1]), "ours", "a", effort="fast").version
    assert near != far


def test_more_frames_than_were_rendered_are_refused():
    coder = FieldCoder(render_clip(street(1), CAMERAS[:2]), "ours", "test", effort="fast")
    with pytest.raises(InvalidInput, match=r"1\.\.2"):
        coder.code(FRAMES, 10, 23.0)
