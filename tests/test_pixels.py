"""Pixels are what their file says: every reader of pictures and videos against the formulas.

The formulas are written out here in float64: ITU-R BT.601, BT.709 and BT.2020 matrices, linear
interpolation of chroma, the curves of sRGB, BT.1886, PQ and HLG. OpenCV and FFmpeg make the files.
"""

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from rfcore.dataset.video import Video
from rfcore.errors import DatasetError
from rfcore.image import read_pixels, read_rgb, rgb_from_bytes
from rfcore.pixels import pixels_of
from rfedge.datasets.video_frames import sharpest_frames

KR_KB = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 9: (0.2627, 0.0593)}
"""By ITU-T H.273's code of the matrix."""
ODD_AND_EVEN = [(96, 64), (96, 63), (95, 64), (95, 63)]


def blocks(width: int, height: int) -> np.ndarray:
    """Random colours with hard edges, uint8 [H, W, 3]."""
    colours = np.random.default_rng(0).integers(0, 256, (8, 12, 3), dtype=np.uint8)
    return np.kron(colours, np.ones((8, 8, 1), np.uint8))[:height, :width]


def planes_of(frame: av.VideoFrame) -> list[np.ndarray]:
    bits = frame.format.components[0].bits
    kind = np.uint8 if bits == 8 else np.dtype("<u2")
    return [
        np.frombuffer(bytes(p), kind).reshape(p.height, -1)[:, : p.width].astype(np.float64)
        for p in frame.planes
    ]


def upsampled(plane: np.ndarray, shape: tuple[int, int], offset_x: float) -> np.ndarray:
    """Interpolate chroma [h, w] linearly; its first sample is ``offset_x`` px right of luma's,
    and vertically in the middle of two."""
    height, width = shape
    x = (np.arange(width) - offset_x) / 2 if plane.shape[1] < width else np.arange(width)
    y = (np.arange(height) - 0.5) / 2 if plane.shape[0] < height else np.arange(height)
    x, y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    return cv2.remap(
        plane.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )


def signal_of(frame: av.VideoFrame, matrix: int, *, full: bool, offset_x: float) -> np.ndarray:
    """Return R'G'B' of a frame, nominally 0..1, float64 [H, W, 3]."""
    bits = frame.format.components[0].bits
    y, u, v = planes_of(frame)
    step = 2.0 ** (bits - 8)
    y = y / (2**bits - 1) if full else (y / step - 16) / 219
    u, v = (
        (upsampled(c, y.shape, offset_x) - 2 ** (bits - 1)) / (2**bits - 1 if full else 224 * step)
        for c in (u, v)
    )
    kr, kb = KR_KB[matrix]
    red, blue = y + 2 * (1 - kr) * v, y + 2 * (1 - kb) * u
    return np.stack([red, (y - kr * red - kb * blue) / (1 - kr - kb), blue], axis=-1).clip(0, 1)


def frame_of(width: int, height: int, pixel_format: str, matrix: int, *, full: bool):
    """Return a frame of random planes: blocks of luma, smooth chroma with edges."""
    frame = av.VideoFrame(width, height, pixel_format)
    frame.colorspace, frame.color_range = matrix, 2 if full else 1
    bits = frame.format.components[0].bits
    rng = np.random.default_rng(3)
    for plane in frame.planes:
        low = rng.integers(60, 190, (plane.height // 8 + 1, plane.width // 8 + 1))
        values = np.kron(low, np.ones((8, 8)))[: plane.height, : plane.width] * 2.0 ** (bits - 8)
        padded = np.zeros((plane.height, plane.line_size * 8 // (8 if bits == 8 else 16)))
        padded[:, : plane.width] = values
        plane.update(padded.astype(np.uint8 if bits == 8 else np.dtype("<u2")).tobytes())
    return frame


def write_video(path: Path, codec: str, frames: list[av.VideoFrame], rate: int = 10) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.width, stream.height = frames[0].width, frames[0].height
        stream.pix_fmt = frames[0].format.name
        for name in ("color_range", "colorspace", "color_trc", "color_primaries"):
            setattr(stream.codec_context, name, getattr(frames[0], name))
        for number, frame in enumerate(frames):
            frame.pts, frame.time_base = number, Fraction(1, rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def from_file(path: Path) -> np.ndarray:
    return read_rgb(path)


def from_bytes(path: Path) -> np.ndarray:
    return rgb_from_bytes(path.read_bytes(), "x")


def from_video(path: Path) -> np.ndarray:
    return Video(path).read(0)


def from_sharpest(path: Path) -> np.ndarray:
    sharpest_frames(path, path.parent / "frames", 1.0, lambda _: None)
    return read_rgb(path.parent / "frames" / "00000.png")


@pytest.mark.parametrize("size", ODD_AND_EVEN)
@pytest.mark.parametrize("pixel_format", ["yuv420p", "yuv422p", "yuv444p", "yuv420p10le"])
@pytest.mark.parametrize(("matrix", "full"), [(5, False), (1, False), (9, False), (5, True)])
def test_a_frame_is_converted_by_the_formula(size, pixel_format, matrix, full):
    frame = frame_of(*size, pixel_format, matrix, full=full)
    wanted = signal_of(frame, matrix, full=full, offset_x=0.5) * 255
    found = pixels_of(frame, "x").rgb
    assert np.abs(found - wanted).max() <= 0.6


@pytest.mark.parametrize("size", ODD_AND_EVEN)
@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("a.jpg", from_file),
        ("a.jpg", from_bytes),
        ("a.webp", from_file),
        ("a.mkv", from_video),
        ("a.mkv", from_sharpest),
    ],
)
def test_every_reader_of_pictures_follows_the_formula(
    size, name, read: Callable[[Path], np.ndarray], tmp_path
):
    """The encoder's own loss is left out: the formula starts at the planes that are stored."""
    path = tmp_path / name
    if name == "a.mkv":
        write_video(path, "ffv1", [frame_of(*size, "yuv420p", 5, full=False)])
    else:
        cv2.imwrite(str(path), blocks(*size)[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 95])
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
    wanted = signal_of(frame, 5, full=name == "a.jpg", offset_x=0.5) * 255
    assert np.abs(read(path) - wanted).max() <= 0.6


@pytest.mark.parametrize(
    ("values", "kind"),
    [("uint16", "rgb48be"), ("uint16", "gray16be"), ("uint8", "rgb24"), ("uint8", "gray")],
)
def test_a_png_of_any_depth_is_rounded_to_nearest(values, kind, tmp_path):
    top = np.iinfo(values).max
    shape = (16, 64, 3) if kind.startswith("rgb") else (16, 64)
    stored = np.random.default_rng(1).integers(0, top + 1, shape).astype(values)
    cv2.imwrite(str(tmp_path / "a.png"), stored[..., ::-1] if stored.ndim == 3 else stored)
    wanted = np.floor(stored / top * 255 + 0.5).astype(np.uint8)
    found = read_rgb(tmp_path / "a.png")
    assert np.array_equal(found, wanted if stored.ndim == 3 else wanted[..., None].repeat(3, 2))


def write_frame(path: Path, codec: str, frame: av.VideoFrame) -> None:
    encoder = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height, encoder.pix_fmt = frame.width, frame.height, frame.format.name
    encoder.time_base = Fraction(1, 1)
    packets = [*encoder.encode(frame), *encoder.encode(None)]
    path.write_bytes(b"".join(map(bytes, packets)))


def srgb(light: np.ndarray) -> np.ndarray:
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def linear(code: np.ndarray) -> np.ndarray:
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def test_linear_light_of_an_exr_gets_the_curve_of_srgb(tmp_path):
    rgb = blocks(40, 30)
    light = linear(rgb / 255).astype(np.float32)
    write_frame(tmp_path / "a.exr", "exr", av.VideoFrame.from_ndarray(light, "gbrpf32le"))
    assert np.array_equal(read_rgb(tmp_path / "a.exr"), rgb)


def test_an_exr_that_is_not_finite_is_refused(tmp_path):
    light = np.full((8, 8, 3), np.nan, np.float32)
    write_frame(tmp_path / "a.exr", "exr", av.VideoFrame.from_ndarray(light, "gbrpf32le"))
    with pytest.raises(DatasetError, match=r"a\.exr: has NaN or infinite values; save it as sRGB"):
        read_rgb(tmp_path / "a.exr")
    saved = np.nan_to_num(light * 255).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), saved)
    assert np.array_equal(read_rgb(tmp_path / "a.png"), saved)


def test_what_is_refused_for_its_matrix_is_read_when_it_is_saved_as_rgb(tmp_path):
    write_video(tmp_path / "a.mkv", "ffv1", [frame_of(96, 64, "yuv420p", 8, full=False)])
    with pytest.raises(DatasetError, match="save it as sRGB"):
        from_video(tmp_path / "a.mkv")
    rgb = av.VideoFrame.from_ndarray(blocks(96, 64), "rgb24").reformat(format="bgr0")
    write_video(tmp_path / "b.mkv", "ffv1", [rgb])
    assert np.array_equal(from_video(tmp_path / "b.mkv"), blocks(96, 64))


@pytest.mark.parametrize("name", ["a.png", "a.webp"])
def test_what_is_transparent_is_black_and_known(name, tmp_path):
    rgba = np.dstack([blocks(40, 30), np.full((30, 40), 255, np.uint8)])
    rgba[:, 20:, 3] = 0
    rgba[:, 30:, 3] = 128
    bgra = rgba[..., [2, 1, 0, 3]]
    cv2.imwrite(str(tmp_path / name), bgra, [cv2.IMWRITE_WEBP_QUALITY, 101])
    pixels = read_pixels(tmp_path / name)
    assert np.array_equal(pixels.opaque, rgba[..., 3] == 255)
    wanted = np.floor(rgba[..., :3] * (rgba[..., 3:] / 255) + 0.5)
    if name == "a.png":
        assert np.array_equal(pixels.rgb, wanted)
    assert np.array_equal(pixels.rgb[:, :20], rgba[:, :20, :3])
    assert not pixels.rgb[:, 20:30].any()


def hlg_signal(light: np.ndarray) -> np.ndarray:
    """The inverse EOTF of HLG, BT.2100, at 1000 cd/m2, each channel by itself."""
    scene = light ** (1 / 1.2)
    high = 0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073
    return np.where(scene <= 1 / 12, np.sqrt(3 * scene), high)


def pq_signal(light: np.ndarray) -> np.ndarray:
    """The inverse EOTF of PQ, SMPTE ST 2084; ``light`` 1 is 10000 cd/m2."""
    power = light**0.1593017578125
    return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


TO_2020 = np.array(
    [[0.627404, 0.329283, 0.043313], [0.069097, 0.919540, 0.011362], [0.016391, 0.088013, 0.895595]]
)
"""ITU-R BT.2087."""


@pytest.mark.parametrize(
    ("trc", "signal", "peak"), [(18, hlg_signal, 1000), (16, pq_signal, 10000)]
)
def test_hdr_video_becomes_what_the_display_shows(trc, signal, peak, tmp_path):
    """A picture that was coded with white at 203 cd/m2 comes back; 10 bits leave 38 dB."""
    rgb = np.repeat(np.repeat(blocks(96, 64)[::8, ::8], 8, 0), 8, 1)
    light = (rgb / 255) ** 2.4 @ TO_2020.T * 203 / peak
    code = signal(light)
    y = code @ (0.2627, 0.678, 0.0593)
    cb, cr = (code[..., 2] - y) / 1.8814, (code[..., 0] - y) / 1.4746
    frame = av.VideoFrame(96, 64, "yuv444p10le")
    frame.colorspace, frame.color_range, frame.color_trc, frame.color_primaries = 9, 1, trc, 9
    for plane, values in zip(
        frame.planes, (64 + 876 * y, 512 + 896 * cb, 512 + 896 * cr), strict=True
    ):
        row = np.zeros((64, plane.line_size // 2), "<u2")
        row[:, :96] = np.round(values)
        plane.update(row.tobytes())
    write_video(tmp_path / "a.mkv", "ffv1", [frame])
    found = from_video(tmp_path / "a.mkv").astype(int)
    assert np.abs(found - rgb)[rgb > 30].max() <= 6
    assert np.mean((found - rgb) ** 2) < 10


def test_a_matrix_that_is_not_read_is_named():
    frame = frame_of(16, 16, "yuv420p", 8, full=False)
    with pytest.raises(DatasetError, match=r"drive\.mp4: yuv420p with colour matrix 8"):
        pixels_of(frame, "drive.mp4")
