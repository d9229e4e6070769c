"""An undistorted picture is what a pinhole would have seen: straight lines, no blank edges."""

from dataclasses import astuple

import cv2
import numpy as np
import pytest

from rfcore.camera import Intrinsics
from rfcore.dataset.undistort import pinhole_of, undistorted
from rfcore.errors import InvalidInput
from rfcore.image import Rgb
from rfcore.lens import BrownLens, FisheyeLens, Lens

K = Intrinsics(320, 240, 250.0, 255.0, 163.0, 117.0)
LENSES: list[Lens] = [
    BrownLens(k1=-0.28, k2=0.07, p1=2e-4, p2=3e-5),
    BrownLens(k1=0.06, k2=-0.08, p1=-1e-3, p2=1.5e-4),
    FisheyeLens(k1=-0.02, k2=0.004),
]


def seen_through(lens: Lens) -> Rgb:
    """A pattern over directions, which needs no resampling: each pixel asks its own direction."""
    u, v = np.meshgrid(np.arange(K.width_px) + 0.5, np.arange(K.height_px) + 0.5)
    sensor = np.stack([(u.ravel() - K.cx_px) / K.fx_px, (v.ravel() - K.cy_px) / K.fy_px], axis=1)
    return pattern(lens.undistort(sensor)).reshape(K.height_px, K.width_px, 3)


def pattern(xy: np.ndarray) -> Rgb:
    waves = [np.sin(9 * xy[:, 0]), np.sin(9 * xy[:, 1]), np.sin(6 * (xy[:, 0] + xy[:, 1]))]
    return np.round(127.5 + 120 * np.stack(waves, axis=1)).astype(np.uint8)


@pytest.mark.parametrize("lens", LENSES)
def test_every_pixel_shows_its_own_direction(lens):
    """Rounding twice is one level; bilinear is off by 120 * 9^2 / 250^2 / 4 < 0.1 of one."""
    pinhole = pinhole_of(K, lens)
    u, v = np.meshgrid(np.arange(K.width_px) + 0.5, np.arange(K.height_px) + 0.5)
    xy = np.stack(
        [(u.ravel() - K.cx_px) / pinhole.fx_px, (v.ravel() - K.cy_px) / pinhole.fy_px], axis=1
    )
    expected = pattern(xy).reshape(K.height_px, K.width_px, 3)
    error = np.abs(undistorted(seen_through(lens), K, lens).astype(int) - expected)
    assert error.max() <= 2
    assert error.mean() < 0.5


@pytest.mark.parametrize(
    "lens",
    [
        BrownLens(k1=0.06, k2=-0.08, p1=-1e-3, p2=1.5e-4),
        BrownLens(0.4, 0.1, 1e-3, -2e-3, 0.02, 0.6, 0.15, 0.03),
    ],
)
def test_the_pixels_are_opencvs(lens):
    """OpenCV counts pixel centres from 0; its weights have 5 bits, which is 120 / 32 / 8 levels."""
    pinhole, rgb = pinhole_of(K, lens), seen_through(lens)
    source, target = (
        np.array([[k.fx_px, 0, k.cx_px - 0.5], [0, k.fy_px, k.cy_px - 0.5], [0, 0, 1]])
        for k in (K, pinhole)
    )
    coefficients = np.array(astuple(lens))
    maps = cv2.initUndistortRectifyMap(
        source, coefficients, None, target, (K.width_px, K.height_px), cv2.CV_32FC1
    )
    expected = cv2.remap(rgb, *maps, cv2.INTER_LINEAR)
    assert np.abs(undistorted(rgb, K, lens).astype(int) - expected).max() <= 1


@pytest.mark.parametrize("lens", LENSES)
def test_the_view_is_the_widest_without_blank_pixels(lens):
    pinhole = pinhole_of(K, lens)
    assert (pinhole.width_px, pinhole.height_px) == (K.width_px, K.height_px)
    assert (pinhole.cx_px, pinhole.cy_px) == (K.cx_px, K.cy_px)
    assert pinhole.fx_px / pinhole.fy_px == pytest.approx(K.fx_px / K.fy_px)
    assert outermost(pinhole, lens) <= 1e-6, "nothing is blank"
    wider = Intrinsics(
        320, 240, pinhole.fx_px * 0.999, pinhole.fy_px * 0.999, pinhole.cx_px, pinhole.cy_px
    )
    assert outermost(wider, lens) > 0, "a wider view is"


def outermost(pinhole: Intrinsics, lens: Lens) -> float:
    """Return the pixels by which the outermost pixel centres reach beyond the source's."""
    u, v = np.meshgrid(np.arange(K.width_px) + 0.5, np.arange(K.height_px) + 0.5)
    edge = np.ones(u.shape, bool)
    edge[1:-1, 1:-1] = False
    xy = np.stack(
        [(u[edge] - pinhole.cx_px) / pinhole.fx_px, (v[edge] - pinhole.cy_px) / pinhole.fy_px],
        axis=1,
    )
    pixels = lens.distort(xy) * (K.fx_px, K.fy_px) + (K.cx_px, K.cy_px)
    beyond = np.maximum(0.5 - pixels, pixels - (K.width_px - 0.5, K.height_px - 0.5))
    return float(beyond.max())


def test_a_wide_fisheye_keeps_half_the_resolution_of_its_middle():
    wide = Intrinsics(100, 100, 30.0, 30.0, 50.0, 50.0)
    assert pinhole_of(wide, FisheyeLens()).fx_px == 15.0


def test_a_lens_that_turns_back_at_once_is_refused():
    with pytest.raises(InvalidInput, match="blank pixels"):
        pinhole_of(K, BrownLens(k1=-1e4))
