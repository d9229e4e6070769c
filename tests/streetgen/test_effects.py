"""Effects do what their law says, and one that is not declared does not exist for a scene."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rfcore.camera import Pose
from rfcore.dataset.undistort import pinhole_of, undistorted
from rfcore.errors import InvalidInput
from rfcore.lens import LensCamera
from streetgen.assembly import apply_effects
from streetgen.effects import EFFECTS, load_effect, rng_of
from streetgen.effects.auto_exposure import AutoExposure
from streetgen.effects.exposure import ExposureDrift
from streetgen.effects.haze import Haze
from streetgen.effects.lens import LensDistortion
from streetgen.effects.noise import SensorNoise
from streetgen.effects.rain import Rain
from streetgen.effects.rolling_shutter import RollingShutter
from streetgen.frame import LinearFrame, display_rgb, sampled
from streetgen.plan import plain_frame
from streetgen.scene_file import Scene

ON_FRAMES = tuple(effect for effect in EFFECTS if effect.on_frames)


def rng() -> np.random.Generator:
    return np.random.default_rng(1)


@pytest.fixture
def frame() -> LinearFrame:
    """A road with stripes across, so that displacement shows."""
    plain = plain_frame(160, 90, 90.0)
    waves = 0.4 + 0.3 * np.sin(np.arange(90) / 4)[:, None, None] * np.ones((1, 160, 3))
    return replace(plain, colour=waves.astype(np.float32))


def scene(**effects: Any) -> Scene:
    return Scene("x", "x", effects={e.name: effects[e.name] for e in EFFECTS if e.name in effects})


@pytest.mark.parametrize("effect", ON_FRAMES, ids=lambda effect: effect.name)
def test_an_effect_keeps_the_form_of_a_frame(effect, frame):
    settings = load_effect(effect)()
    before = frame.colour.copy()
    one, other = (settings.apply(frame, rng_of(effect, 1, 7)) for _ in range(2))
    assert one.colour.dtype == np.float32
    assert one.colour.shape == frame.colour.shape
    assert np.isfinite(one.colour).all()
    assert (one.colour == other.colour).all(), "the same seed and frame give the same bytes"
    assert (frame.colour == before).all(), "the rendered frame is not changed"


def test_frames_and_effects_have_their_own_chance():
    noise, rain = (next(e for e in EFFECTS if e.name == n) for n in ("noise", "rain"))
    numbers = {rng_of(e, s, f).random() for e in (noise, rain) for s in (1, 2) for f in (0, 1)}
    assert len(numbers) == 8


def test_haze_leaves_a_twentieth_of_the_contrast_at_its_visibility(frame):
    """Five hundred metres of distance, along each pixel's ray, before the layer ends."""
    k = frame.camera.intrinsics
    x, y = np.meshgrid(np.arange(160) + 0.5 - k.cx_px, np.arange(90) + 0.5 - k.cy_px)
    depth_m = 500.0 / np.sqrt((x / k.fx_px) ** 2 + (y / k.fy_px) ** 2 + 1)
    colour = np.zeros((90, 160, 3), np.float32)
    black = replace(frame, colour=colour, depth_m=depth_m.astype(np.float32))
    seen = Haze(visibility_m=500.0, layer_m=1e4, air=0.8).apply(black, rng()).colour
    np.testing.assert_allclose(seen, 0.8 * 0.95, rtol=1e-5)


def test_haze_hides_the_horizon_and_not_the_sky_above_it(frame):
    """At elevation e a ray leaves the layer after layer_m / sin e; below the horizon, never."""
    level = Pose.from_matrix([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5]])
    camera = replace(frame.camera, world_from_cam=level)
    endless = np.full((90, 160), np.inf, np.float32)
    sky = replace(frame, colour=np.ones((90, 160, 3), np.float32), depth_m=endless, camera=camera)
    seen = Haze(visibility_m=500.0, layer_m=100.0, air=0.0).apply(sky, rng()).colour[:, 80, 0]
    assert (np.diff(seen[:45]) < 0).all()
    assert (seen[45:] < 1e-6).all()
    assert seen[44] < 1e-6
    slope = 44.5 / camera.intrinsics.fy_px
    sine = slope / np.hypot(slope, 1.0)
    assert seen[0] == pytest.approx(20.0 ** (-100.0 / sine / 500.0), rel=1e-3)


def test_rain_does_not_fall_behind_a_wall(frame):
    wall = replace(frame, depth_m=np.full((90, 160), 1.5, np.float32))
    assert (Rain().apply(wall, rng()).colour == wall.colour).all()
    assert (Rain().apply(frame, rng()).colour != frame.colour).mean() > 0.01
    assert (Rain(drops=0).apply(frame, rng()).colour == frame.colour).all()


def test_a_distorted_frame_comes_back_by_the_readers_undistortion():
    """Smooth enough for two bilinear samplings: the curvature is 120 / 20^2 levels a px^2 / 8."""
    frame = plain_frame(160, 90, 80.0)
    u, v = np.meshgrid(np.arange(160), np.arange(90))
    waves = np.stack([np.sin(u / 20), np.sin(v / 20), np.sin((u + v) / 25)], axis=2)
    frame = replace(frame, colour=(0.5 + 0.3 * waves).astype(np.float32))
    bent = LensDistortion(k1=-0.12, k2=0.02).apply(frame, rng())
    assert isinstance(bent.camera, LensCamera)
    k = bent.camera.intrinsics
    rgb = np.round(bent.colour * 255).astype(np.uint8)
    straight = undistorted(rgb, k, bent.camera.lens)
    pinhole, source = pinhole_of(k, bent.camera.lens), frame.camera.intrinsics
    columns = (np.arange(160) + 0.5 - pinhole.cx_px) / pinhole.fx_px * source.fx_px + source.cx_px
    rows = (np.arange(90) + 0.5 - pinhole.cy_px) / pinhole.fy_px * source.fy_px + source.cy_px
    at_u, at_v = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
    expected = sampled(frame.colour, at_u, at_v) * 255
    inner = np.s_[2:-2, 2:-2]
    assert np.abs(straight.astype(float) - expected)[inner].max() < 2.5


def test_a_camera_that_stands_still_has_no_rolling_shutter(frame):
    still = replace(frame, velocity_mps=(0, 0, 0))
    moved = RollingShutter(readout_s=0.05).apply(still, rng()).colour
    np.testing.assert_allclose(moved, still.colour, atol=1e-4)


def test_a_sideways_camera_shears_what_stands_upright():
    """At depth z, a row is shifted by f v_x t / z: here 80 * 10 * 0.02 / 8 = 2 px."""
    plain = plain_frame(160, 90, 90.0)
    ramp = (np.arange(160, dtype=np.float32) / 160)[None, :, None] * np.ones((90, 1, 3), np.float32)
    wall = replace(
        plain,
        colour=ramp.astype(np.float32),
        depth_m=np.full((90, 160), 8.0, np.float32),
        velocity_mps=(10.0, 0.0, 0.0),
    )
    seen = RollingShutter(readout_s=0.02).apply(wall, rng()).colour[:, 80, 0] * 160
    late = (np.arange(90) + 0.5) / 90 - 0.5
    np.testing.assert_allclose(seen, 80 + 2 * late, atol=1e-3)


def test_exposure_swings_by_its_stops(frame):
    drift = ExposureDrift(stops=1.0, period_s=4.0)
    for time_s, gain in ((0.0, 1.0), (1.0, 2.0), (3.0, 0.5)):
        seen = drift.apply(replace(frame, time_s=time_s), rng()).colour
        np.testing.assert_allclose(seen, frame.colour * gain, rtol=1e-6)


def test_automatic_exposure_overshoots_and_settles(frame):
    """After half a period the gain is past its aim by exp(-t / settle), a whole one before it."""
    hunting = AutoExposure(at_s=(1.0,), steps=(1.0,), settle_s=0.5, period_s=0.4)
    expected = {
        0.9: 0.0,
        1.0: 0.0,
        1.2: 1 + math.exp(-0.4),
        1.4: 1 - math.exp(-0.8),
        11.0: 1.0,
    }
    for time_s, stops in expected.items():
        seen = hunting.apply(replace(frame, time_s=time_s), rng()).colour
        np.testing.assert_allclose(seen, frame.colour * 2.0**stops, rtol=1e-5)
    with pytest.raises(InvalidInput, match="steps: are 1 at 2 times"):
        AutoExposure(at_s=(1.0, 2.0), steps=(1.0,))


def test_noise_has_the_mean_and_the_variance_of_its_electrons():
    """43,200 samples: the mean is known to 1 / sqrt(n), the variance to sqrt(2 / n) of itself."""
    grey = replace(plain_frame(160, 90, 90.0), colour=np.full((90, 160, 3), 0.25, np.float32))
    seen = SensorNoise(full_well_e=2000.0, read_e=5.0).apply(grey, rng()).colour.astype(float)
    variance = (0.25 * 2000 + 25) / 2000**2
    n = seen.size
    assert seen.mean() == pytest.approx(0.25, abs=5 * (variance / n) ** 0.5)
    assert seen.var() == pytest.approx(variance, rel=5 * (2 / n) ** 0.5)


def test_without_effects_the_frame_is_the_same_object(frame):
    assert apply_effects(scene(), frame, 3) is frame


def test_effects_run_one_after_the_other(frame):
    haze, drift = Haze(), ExposureDrift()
    late = replace(frame, time_s=1.0)
    both = apply_effects(scene(exposure=drift, haze=haze), late, 0).colour
    expected = drift.apply(haze.apply(late, rng()), rng()).colour
    np.testing.assert_array_equal(both, expected)


def test_the_display_curve_is_srgb(frame):
    """IEC 61966-2-1: linear 0.2159 is code 128."""
    for linear, code in ((0.0, 0), (0.002, 7), (0.2159, 128), (1.0, 255), (3.0, 255)):
        grey = replace(frame, colour=np.full((2, 2, 3), linear, np.float32))
        assert (display_rgb(grey) == code).all()
