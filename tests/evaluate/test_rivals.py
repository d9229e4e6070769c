"""The rivals are real encoders: what they send is decoded, and nothing is held back."""

from dataclasses import replace

import numpy as np
import pytest

from rfcore.errors import CodecError, InvalidInput
from rfcore.image import I420
from rfedge.evaluate.compare.drives import rival_families, ssim_rivals
from rfedge.evaluate.rivals import (
    Rival,
    percent_against_x264,
    svtav1_lowdelay,
    x264_for_psnr,
    x264_lowdelay,
    x264_with_our_tools,
    x265_for_psnr,
    x265_lowdelay,
)

RIVALS = [x264_lowdelay("veryfast"), x265_lowdelay("ultrafast"), svtav1_lowdelay(10)]


def panning_clip(frames=5, width_px=128, height_px=96):
    """A texture that moves two pixels a frame."""
    rng = np.random.default_rng(5)
    wide = rng.uniform(40, 210, (height_px // 4, width_px // 4 + 4))
    wide = wide.repeat(4, 0).repeat(4, 1).astype(np.uint8)
    chroma = np.full((height_px // 2, width_px // 2), 128, np.uint8)
    return [
        I420(wide[:height_px, 2 * k : 2 * k + width_px].copy(), chroma, chroma)
        for k in range(frames)
    ]


@pytest.mark.parametrize("rival", RIVALS, ids=lambda rival: rival.name)
def test_a_worse_point_takes_fewer_bytes_and_shows_it(rival):
    clip = panning_clip()
    best, worst = (rival.code(clip, 10, point) for point in (rival.points[0], rival.points[-1]))
    assert worst.frame_bytes.sum() < best.frame_bytes.sum()
    assert worst.luma_mse.mean() > best.luma_mse.mean()
    assert worst.ssim.mean() < best.ssim.mean()


@pytest.mark.parametrize("rival", RIVALS, ids=lambda rival: rival.name)
def test_later_frames_are_predicted_from_earlier_ones(rival):
    coded = rival.code(panning_clip(), 10, rival.points[0])
    assert coded.frame_bytes[1:].mean() < 0.5 * coded.frame_bytes[0]
    assert coded.cpu_ms > 0


@pytest.mark.parametrize("rival", RIVALS, ids=lambda rival: rival.name)
def test_a_static_picture_costs_next_to_nothing_after_the_first(rival):
    clip = panning_clip(frames=1) * 4
    coded = rival.code(clip, 10, 30.0)
    assert coded.frame_bytes[1:].max() < 0.1 * coded.frame_bytes[0]


@pytest.mark.parametrize("rival", RIVALS, ids=lambda rival: rival.name)
def test_pictures_of_odd_size_cost_what_even_ones_with_their_last_row_and_column_repeated_do(rival):
    even = panning_clip()
    odd = [I420(frame.y[:-1, :-1].copy(), frame.u, frame.v) for frame in even]
    padded = [I420(np.pad(frame.y, ((0, 1), (0, 1)), "edge"), frame.u, frame.v) for frame in odd]
    made, expected = rival.pictures(odd, 10, 30.0), rival.pictures(padded, 10, 30.0)
    assert made.frame_bytes == expected.frame_bytes
    assert [picture.size_px for picture in made.decoded] == [(127, 95)] * 5
    for cropped, whole in zip(made.decoded, expected.decoded, strict=True):
        assert np.array_equal(cropped.y, whole.y[:95, :127])
    assert rival.code(odd, 10, 30.0).luma_mse.shape == (5,)


def test_no_frames_are_refused():
    with pytest.raises(InvalidInput, match="at least one frame"):
        RIVALS[0].code([], 10, 23)


def test_keyframes_can_be_asked_of_x264():
    rival = x264_lowdelay("veryfast", "x264-keyint-2", keyint="2")
    sizes = rival.code(panning_clip(), 10, 23.0).frame_bytes
    assert sizes[2] > 3 * sizes[1]
    assert sizes[4] > 3 * sizes[3]


@pytest.mark.parametrize(
    ("plain", "tuned"),
    [
        (x264_lowdelay("veryfast"), x264_for_psnr("veryfast")),
        (x265_lowdelay("ultrafast"), x265_for_psnr("ultrafast")),
    ],
    ids=["x264", "x265"],
)
def test_tuning_for_psnr_changes_the_stream(plain, tuned):
    clip = panning_clip()
    coded = [rival.code(clip, 10, 30.0).frame_bytes.tolist() for rival in (plain, tuned)]
    assert coded[0] != coded[1]


def options_of(rival):
    """Return the options that the encoder says it runs with; ``no-x`` is x = no."""
    text = rival.effective_options.split("options: ")[1]
    words = [word.split("=", 1) for word in text.split()]
    return {
        word[0].removeprefix("no-"): word[1]
        if len(word) == 2
        else ("no" if word[0].startswith("no-") else "yes")
        for word in words
    }


# Settings that decide how strong each H.264 and H.265 rival is. Taken from the encoders' own SEI
# messages (x264 core 165, x265 4.2), presets as documented by `x264 --fullhelp`.
X264 = {
    "cabac": "1",
    "bframes": "0",
    "8x8dct": "1",
    "deblock": "1:0:0",
    "scenecut": "0",
    "threads": "1",
    "sliced_threads": "0",
    "rc": "crf",
    "mbtree": "0",
    "keyint": "infinite",
    "intra_refresh": "0",
}
VERYFAST = X264 | {"ref": "1", "me": "hex", "subme": "2", "trellis": "0", "weightp": "1"}
PLAIN = VERYFAST | {"psy": "1", "psy_rd": "1.00:0.00", "aq": "1:1.00"}
FOR_PSNR = {"psy": "0", "aq": "0"}
MEDIUM = X264 | {"ref": "3", "me": "hex", "subme": "7", "trellis": "1", "weightp": "2"}
VERYSLOW = X264 | {"ref": "16", "me": "umh", "subme": "9", "trellis": "2", "me_range": "24"}
X265 = {"bframes": "0", "scenecut": "0", "rc": "crf", "rc-lookahead": "0", "deblock": "0:0"}
X265_VERYFAST = X265 | {"ref": "2", "rd": "2", "subme": "1", "max-merge": "2", "signhide": "yes"}
X265_MEDIUM = X265 | {"ref": "3", "rd": "3", "subme": "2", "max-merge": "3", "signhide": "yes"}
X265_PLAIN = {"psy-rd": "2.00", "aq-mode": "2", "aq-strength": "1.00"}
X265_FOR_SSIM = {"psy-rd": "0.00", "psy-rdoq": "0.00", "aq-mode": "2"}
X265_FOR_PSNR = {"psy-rd": "0.00", "psy-rdoq": "0.00", "aq-mode": "0"}
OUR_TOOLS = {"trellis": "2", "mixed_ref": "1"}
PINNED = {
    "x264-lowdelay-veryfast": PLAIN,
    "x264-lowdelay-psnr-veryfast": VERYFAST | FOR_PSNR,
    "x264-lowdelay-psnr-medium": MEDIUM | FOR_PSNR,
    "x264-lowdelay-psnr-veryslow": VERYSLOW | FOR_PSNR,
    "x264-our-tools-veryfast": VERYFAST | FOR_PSNR | OUR_TOOLS | {"ref": "3"},
    "x264-our-tools-medium": MEDIUM | FOR_PSNR | OUR_TOOLS,
    "x264-our-tools-veryslow": VERYSLOW | FOR_PSNR | OUR_TOOLS,
    "x264-lowdelay-ssim-veryfast": VERYFAST | {"psy": "0", "aq": "2:1.00"},
    "x264-lowdelay-ssim-medium": MEDIUM | {"psy": "0", "aq": "2:1.00"},
    "x265-lowdelay-ssim-medium": X265_MEDIUM | X265_FOR_SSIM,
    "x264-keyint-10-veryfast": PLAIN | {"keyint": "10"},
    "x264-keyint-30-veryfast": PLAIN | {"keyint": "30"},
    "x264-keyint-250-veryfast": PLAIN | {"keyint": "250"},
    "x264-intra-refresh-10-veryfast": PLAIN | {"keyint": "10", "intra_refresh": "1"},
    "x265-lowdelay-veryfast": X265_VERYFAST | X265_PLAIN,
    "x265-lowdelay-psnr-veryfast": X265_VERYFAST | X265_FOR_PSNR,
    "x265-lowdelay-psnr-medium": X265_MEDIUM | X265_FOR_PSNR,
}
BY_NAME = {
    rival.name: rival
    for families in (rival_families("veryfast"), ssim_rivals())
    for family in families.values()
    for rival in family
}


@pytest.mark.parametrize("name", PINNED)
def test_a_rival_runs_with_the_options_it_is_named_for(name):
    found = options_of(BY_NAME[name])
    assert {key: found.get(key) for key in PINNED[name]} == PINNED[name]


def test_every_rival_whose_options_can_be_read_is_pinned():
    readable = {name for name, rival in BY_NAME.items() if "options: " in rival.effective_options}
    assert readable == set(PINNED)


def test_av1_rivals_run_with_low_delay_at_their_presets():
    av1 = {name: rival for name, rival in BY_NAME.items() if rival.encoder == "libsvtav1"}
    assert {name: rival.options["preset"] for name, rival in av1.items()} == {
        f"svtav1-lowdelay-p{preset}": str(preset) for preset in (6, 10, 8, 4)
    }
    for rival in av1.values():
        assert rival.options["svtav1-params"] == "pred-struct=1:keyint=-1:lp=1:rc=0"


def test_another_option_is_another_version():
    plain = x264_lowdelay("veryfast")
    weaker = x264_lowdelay("veryfast", plain.name, subme="0")
    assert plain.version != weaker.version
    assert plain.version == x264_lowdelay("veryfast").version
    assert svtav1_lowdelay(8).version != svtav1_lowdelay(6).version


def test_an_encoder_that_refuses_its_options_is_named():
    with pytest.raises(CodecError, match="nobody"):
        Rival("nobody", "libx264", "h264", {"preset": "nosuch"}).code(panning_clip(1), 10, 23.0)


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_x264_itself_needs_what_x264_needs(share):
    """A stream of x264's own at CRF 30.5, and the same with half of its bytes."""
    frames = panning_clip()
    own = x264_with_our_tools("medium").code(frames, 10.0, 30.5)
    ours = replace(own, frame_bytes=(share * own.frame_bytes).round().astype(int))
    percent = percent_against_x264(ours, frames, 10.0)
    assert percent == pytest.approx(100 * share - 100, abs=3)


def test_a_quality_that_x264_does_not_reach_is_refused():
    frames = panning_clip()
    coded = x264_with_our_tools("medium").code(frames, 10.0, 30.0)
    exact = replace(coded, luma_mse=np.zeros(len(frames)))
    with pytest.raises(InvalidInput, match=r"inf dB are outside .* choose another --crf"):
        percent_against_x264(exact, frames, 10.0)
