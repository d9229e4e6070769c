"""Picture files: what is read is what was stored, and what cannot be read is said."""

import ctypes
from pathlib import Path
from platform import machine

import cv2
import numpy as np
import pytest

from rfcore.errors import DatasetError, InvalidInput
from rfcore.image import I420, Rgb, jpeg_bytes, png_bytes, read_rgb, write_png


def noise(height: int, width: int) -> Rgb:
    return np.random.default_rng(5).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize("size", [(1, 1), (7, 13), (64, 48)])
def test_a_png_comes_back_byte_for_byte(size, tmp_path):
    rgb = noise(*size)
    write_png(tmp_path / "a.png", rgb)
    assert np.array_equal(read_rgb(tmp_path / "a.png"), rgb)
    assert np.array_equal(cv2.imread(str(tmp_path / "a.png"))[..., ::-1], rgb), "another reader"
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"], "no partial file is left"


def test_a_picture_beyond_the_budget_is_refused_before_it_is_decoded(tmp_path, monkeypatch):
    write_png(tmp_path / "a.png", noise(64, 48))
    monkeypatch.setattr("rfcore.image.MAX_PICTURE_PX", 64 * 48 - 1)
    monkeypatch.setattr("rfcore.image.pixels_of", None)  # none is to get so far
    with pytest.raises(DatasetError, match=r"a\.png: 48x64 px is above 3071 pixels; scale it"):
        read_rgb(tmp_path / "a.png")


def test_a_lossless_webp_comes_back_byte_for_byte(tmp_path):
    rgb = noise(36, 64)
    cv2.imwrite(str(tmp_path / "a.webp"), rgb[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 101])
    assert np.array_equal(read_rgb(tmp_path / "a.webp"), rgb)


@pytest.mark.parametrize("size", [(1, 1), (7, 13), (64, 48)])
@pytest.mark.parametrize("colour", [(0, 0, 0), (255, 255, 255), (255, 153, 51), (10, 20, 200)])
def test_a_jpeg_shows_the_colours_of_the_picture(size, colour):
    """OpenCV's reader is the oracle; two roundings to 8 bits and a quantised mean are 3 levels."""
    rgb = np.full((*size, 3), colour, np.uint8)
    seen = cv2.imdecode(np.frombuffer(jpeg_bytes(rgb), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert seen.shape == rgb.shape
    assert np.abs(seen.astype(int) - rgb).max() <= 3


@pytest.mark.parametrize("size_px", [(1, 1), (7, 13), (64, 48)])
def test_planes_are_packed_and_unpacked(size_px):
    width, height = size_px
    half = ((height + 1) // 2, (width + 1) // 2)
    rng = np.random.default_rng(3)
    picture = I420(
        *(rng.integers(0, 256, s, dtype=np.uint8) for s in ((height, width), half, half))
    )
    packed = picture.packed()
    assert I420.unpacked(size_px, packed).digest() == picture.digest()
    with pytest.raises(InvalidInput, match="bytes for"):
        I420.unpacked(size_px, packed + b"x")


def test_files_are_the_same_without_the_processors_vector_instructions():
    """FFmpeg's own switch turns them off; without a quantiser its JPEG differs by them."""
    maps = Path("/proc/self/maps").read_text().split()
    libavutil = ctypes.CDLL(next(word for word in maps if "av.libs/libavutil" in word))
    v, u = np.mgrid[:360, :640]
    waves = [np.sin(u / 7 + v / 11), np.cos(u / 13), np.sin(v / 5)]
    rgb = (127 + 120 * np.stack(waves, axis=2)).astype(np.uint8)

    def files() -> list[bytes]:
        return [*(jpeg_bytes(rgb, each) for each in (1, 5, 31)), png_bytes(rgb, 1)]

    wanted, usual = files(), jpeg_bytes(rgb)
    libavutil.av_force_cpu_flags(0)
    try:
        assert files() == wanted
        assert jpeg_bytes(rgb) != usual or machine() != "x86_64", "the switch has no effect"
    finally:
        libavutil.av_force_cpu_flags(-1)
    assert len(wanted[0]) > len(wanted[1]) > len(wanted[2])


def test_a_jpeg_is_read_without_a_colour_cast(tmp_path):
    """OpenCV's reader (libjpeg-turbo) is the oracle; a fifth of a level is far below rounding."""
    ramp = np.linspace(0, 255, 64 * 96 * 3).reshape(64, 96, 3).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "a.jpg"), ramp, [cv2.IMWRITE_JPEG_QUALITY, 90])
    other = cv2.imread(str(tmp_path / "a.jpg"))[..., ::-1].astype(float)
    bias = (read_rgb(tmp_path / "a.jpg") - other).mean(axis=(0, 1))
    assert np.abs(bias).max() < 0.2


@pytest.mark.parametrize("content", [b"", b"no picture", b"\x89PNG\r\n\x1a\n"])
def test_what_is_no_picture_is_refused_by_name(content, tmp_path):
    (tmp_path / "bad.png").write_bytes(content)
    with pytest.raises(DatasetError, match=r"bad\.png: not a readable picture"):
        read_rgb(tmp_path / "bad.png")


def test_a_missing_picture_is_refused_by_name(tmp_path):
    with pytest.raises(DatasetError, match=r"none\.png"):
        read_rgb(tmp_path / "none.png")


def test_planes_that_do_not_belong_together_are_refused():
    half, full = np.zeros((2, 2), np.uint8), np.zeros((4, 4), np.uint8)
    I420(full, half, half)
    with pytest.raises(InvalidInput, match="chroma planes"):
        I420(full, full, half)
    with pytest.raises(InvalidInput, match="uint8"):
        I420(full, half, half.astype(np.int16))


def test_a_digest_knows_pixels_planes_and_size():
    y, c = np.zeros((4, 4), np.uint8), np.zeros((2, 2), np.uint8)
    changed = c.copy()
    changed[1, 1] = 1
    wide = I420(np.zeros((2, 8), np.uint8), np.zeros((1, 4), np.uint8), np.zeros((1, 4), np.uint8))
    pictures = [I420(y, c, c), I420(y, changed, c), I420(y, c, changed), wide]
    assert len({picture.digest() for picture in pictures}) == 4
    assert I420(y, c, c).digest() == I420(y.copy(), c.copy(), c.copy()).digest()


def test_the_digest_is_the_same_on_every_machine_and_of_the_samples_shown():
    ramp = np.arange(64, dtype=np.uint8).reshape(8, 8)
    whole = I420(ramp[:4, :6].copy(), ramp[:2, :3].copy(), ramp[2:4, :3].copy())
    part = I420(ramp[:4, :6], ramp[:2, :3], ramp[2:4, :3])
    assert part.digest() == whole.digest() == bytes.fromhex("ee57e1238925474ecea6dcf6ae305b5c")
