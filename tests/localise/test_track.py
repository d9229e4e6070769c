"""How far a motion moves pixels, and how far a field of wrong depth lets a camera move."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from localise.planes import INTRINSICS, Planes, picture
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.field import FULL, Quality, render_field_view
from rfcore.localise.structure import Pyramid
from rfcore.localise.track import Effort, TrackSettings, begun, followed, moved_px
from rfcore.motion import quaternion_from_vector
from rfcore.views import FieldView, View

K = Intrinsics(64, 36, 32.0, 32.0, 32.0, 18.0)
DEPTH_M = 10.0
SMALL = st.floats(-1e-3, 1e-3)


def projected_px(motion: Pose) -> float:
    """Return the root mean square displacement of the projections of all pixels at one depth."""
    v, u = np.mgrid[: K.height_px, : K.width_px] + 0.5
    points = np.stack([(u - K.cx_px) / K.fx_px, (v - K.cy_px) / K.fy_px, np.ones_like(u)]) * DEPTH_M
    turn, shift = np.array(motion.rotation_matrix()), np.array(motion.translation_m)
    x, y, z = np.tensordot(turn, points, axes=1) + shift[:, None, None]
    du, dv = K.fx_px * x / z + K.cx_px - u, K.fy_px * y / z + K.cy_px - v
    return math.sqrt(float((du**2 + dv**2).mean()))


@given(SMALL, SMALL, SMALL, SMALL)
def test_of_translations_and_roll_it_is_the_mean_of_the_projection(
    x: float, y: float, z: float, roll: float
) -> None:
    motion = Pose((DEPTH_M * x, DEPTH_M * y, DEPTH_M * z), quaternion_from_vector((0.0, 0.0, roll)))
    assert moved_px(motion, DEPTH_M, K) == pytest.approx(projected_px(motion), rel=0.01, abs=1e-4)


def test_a_turn_to_the_side_that_a_step_undoes_moves_little() -> None:
    turn = quaternion_from_vector((0.0, 1e-3, 0.0))
    undone = Pose((-1e-3 * DEPTH_M, 0.0, 0.0), turn)
    assert moved_px(undone, DEPTH_M, K) < 1e-6 < moved_px(Pose((0.0, 0.0, 0.0), turn), DEPTH_M, K)


class Shallow:
    """The street of planes with depths that are 5 % too small, as a trained field's may be."""

    def __init__(self, share: float) -> None:
        self.share = share

    def render(self, camera: Camera, quality: Quality = FULL) -> View:
        shown = Planes().render(camera, quality)
        return replace(shown, depth=shown.depth * np.float32(self.share))


@pytest.mark.parametrize(("share", "scale"), [(1.0, 1.0), (0.95, 1 / 0.95)])
def test_motions_are_scaled_by_what_the_depth_is_wrong(share: float, scale: float) -> None:
    """Depth of a share makes movements look like that share of what they are."""

    def at(number: int) -> Pose:
        return Pose((0.0, 0.0, 0.4 * number), (1.0, 0.0, 0.0, 0.0))

    def render_at(pose: Pose) -> FieldView:
        return render_field_view(Shallow(share), Camera(INTRINSICS, pose).rounded())

    settings = TrackSettings()
    track = begun(0, at(0), None, Pyramid(picture(at(0)).y), render_at, settings)
    for number in range(1, 10):
        assert track is not None
        levels = Pyramid(picture(at(number)).y)
        track = followed(track, number * 10**8, levels, render_at, settings, Effort(1))
    assert track is not None
    assert track.motion_scale == pytest.approx(scale, abs=0.012)


def test_tracking_from_half_the_resolution_on_leaves_the_finest_level_out() -> None:
    """The finest structure, which is most of the time, is never made; poses stay near."""

    def at(number: int) -> Pose:
        return Pose((0.02 * number, 0.0, 0.1 * number), (1.0, 0.0, 0.0, 0.0))

    def render_at(pose: Pose) -> FieldView:
        return render_field_view(Planes(), Camera(INTRINSICS, pose).rounded())

    settings, half = TrackSettings(), Effort(0, finest=1)
    track = begun(0, at(0), None, Pyramid(picture(at(0)).y), render_at, settings)
    for number in range(1, 6):
        assert track is not None
        levels = Pyramid(picture(at(number)).y)
        track = followed(track, number * 10**8, levels, render_at, settings, half)
        assert track is not None
        assert track.renders == 1
        assert 0 not in levels.made | track.template.structures.made
        assert math.dist(track.world_from_cam.translation_m, at(number).translation_m) < 0.02
