"""MP4 files for people have the colours that were given, at every height, and name their matrix."""

from dataclasses import replace

import av
import numpy as np
import pytest

from rfcore.codec.h264.ffmpeg import picture_of
from rfcore.dataset.video import Video
from rfcore.native.yuv import i420_from_rgb, rgb_from_i420
from rfcore.wire.twin import PictureEncoding
from rfedge.video import write_mp4
from rfedge.watch import PictureVideo
from tests.wall_scene import seen, wall_field

COLOURS = ((200, 30, 40), (30, 160, 60), (40, 60, 220), (220, 210, 40), (128, 128, 128))


@pytest.mark.parametrize("height", [63, 360, 720])
@pytest.mark.parametrize("as_i420", [False, True])
def test_colours_survive_and_the_file_names_their_matrix(tmp_path, height, as_i420):
    rgb = np.repeat(np.array(COLOURS, np.uint8), 16, axis=0)[None].repeat(height, axis=0)
    given = i420_from_rgb(rgb) if as_i420 else rgb
    write_mp4(tmp_path / "a.mp4", [given] * 2, 10.0)
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        codec = stream.codec_context
        assert (codec.color_range, codec.colorspace) == (1, 1), "limited range, BT.709"
        assert (codec.color_primaries, codec.color_trc) == (1, 1)
        frames = list(container.decode(stream))
    assert [(f.width, f.height) for f in frames] == [(80, height - height % 2)] * 2
    shown = rgb_from_i420(picture_of(frames[1]))
    np.testing.assert_allclose(shown[8, 8::16].astype(int), COLOURS, atol=4)


@pytest.mark.parametrize("height", [64, 720])
def test_a_watched_video_names_its_matrix(tmp_path, height):
    picture = seen(wall_field(0.5))
    rgb = np.full((height, 96, 3), (40, 200, 40), np.uint8)
    picture = replace(
        picture,
        intrinsics=replace(picture.intrinsics, height_px=height),
        encoding=PictureEncoding.I420,
        picture=i420_from_rgb(rgb).packed(),
    )
    with PictureVideo(tmp_path / "a.mp4") as video:
        video.keep(picture)
    assert np.abs(Video(tmp_path / "a.mp4").read(0).astype(int) - (40, 200, 40)).max() <= 4
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].codec_context.colorspace == 1
