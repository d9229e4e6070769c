"""The sender orders references by their use, and changes light only when it pays."""

from dataclasses import replace

import numpy as np
import pytest

from codec.pictures import noise, pair, picture, view_of
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.photometric import adapt, check_photometric, solve
from rfcore.codec.prediction import Prediction
from rfcore.codec.references import INTRA, RENDER_ONLY, EncoderState, Past, Reference
from rfcore.codec.sender.encoder import DeltaEncoder, FrameChoice
from rfcore.codec.sender.rate import FrameCosts
from rfcore.codec.sender.reference_choice import (
    choose_photometric,
    choose_references,
    light_differs,
)
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.views import FieldView

SIZE_PX = (320, 192)


def wall(render: I420) -> FieldView:
    """A wall 10 m ahead that shows ``render``."""
    width, height = SIZE_PX
    camera = Camera(Intrinsics(width, height, width, width, 160, 96), Pose.identity())
    return FieldView(camera, render, np.full((height, width), 10, np.float32))


def shade(picture: I420, gain: float, levels: float) -> I420:
    """The same street under another light: every channel of RGB scaled and raised alike."""
    luma = (picture.y - 16.0) * gain + levels + 16
    chroma = [(plane - 128.0) * gain + 128 for plane in picture.planes[1:]]
    y, u, v = (np.clip(np.rint(p), 1, 255).astype(np.uint8) for p in (luma, *chroma))
    return I420(y, u, v)


# --- references


def test_a_render_like_the_frame_is_enough():
    frame, view = pair(*SIZE_PX)
    assert choose_references(FrameCosts(frame), Prediction(view), 23) == RENDER_ONLY


def test_a_render_that_shows_nothing_is_not_used():
    frame, view = pair(*SIZE_PX)
    for render in (noise(*SIZE_PX, 1), shade(noise(*SIZE_PX, 2), 1.0, 0.0)):
        useless = wall(render)
        assert choose_references(FrameCosts(frame), Prediction(useless), 23) == INTRA
        other = Past(noise(*SIZE_PX, 3), wall(noise(*SIZE_PX, 4)))
        chosen = choose_references(FrameCosts(frame), Prediction(useless, other), 23)
        assert chosen == (Reference.PREVIOUS,)
    assert choose_references(FrameCosts(frame), Prediction(view), 23) == RENDER_ONLY


def test_a_frame_without_details_is_still_predicted_from_its_render():
    """Each block is of one grey: intra prediction leaves nothing, but has to send the grey."""
    width, height = SIZE_PX
    rng = np.random.default_rng(5)
    greys = np.kron(rng.integers(90, 160, (height // 8, width // 8)), np.ones((8, 8), np.int64))
    chroma = (np.full((height // 2, width // 2), 128, np.uint8),) * 2
    frame = I420(greys.astype(np.uint8), *chroma)
    render = I420((greys + rng.integers(-3, 4, greys.shape)).astype(np.uint8), *chroma)
    chosen = choose_references(FrameCosts(frame), Prediction(wall(render)), 35)
    assert chosen == RENDER_ONLY


def test_what_the_last_frame_taught_comes_first():
    """The cars are not in the render; nobody moved, so the correction has them."""
    frame, view = pair(*SIZE_PX)
    now = wall(view.render)
    chosen = choose_references(FrameCosts(frame), Prediction(now, Past(frame, now)), 23)
    assert chosen[0] is Reference.PREVIOUS
    assert chosen[-1] is Reference.CORRECTION


FIELD_REFERENCES = {Reference.RENDER, Reference.CORRECTION, Reference.WARP}


def half_lost() -> tuple[I420, I420, FieldView]:
    """The last frame, a frame and what the field shows: only the last frame had its cars; left of
    the middle that one was noise."""
    frame, view = pair(*SIZE_PX)
    left = np.arange(SIZE_PX[0]) < SIZE_PX[0] // 2
    planes = zip(frame.planes, noise(*SIZE_PX, 5).planes, (left, left[::2], left[::2]), strict=True)
    last = I420(*(np.where(where, bad, good) for good, bad, where in planes))
    return last, frame, wall(view.render)


def half_known() -> tuple[I420, Prediction]:
    """A frame of ``half_lost`` and what it can be predicted from."""
    last, frame, now = half_lost()
    return frame, Prediction(now, Past(last, now))


def test_a_second_picture_of_the_field_is_taken_where_it_saves():
    """The render has the left half, what was carried from the last frame the right one."""
    frame, prediction = half_known()
    chosen = choose_references(FrameCosts(frame), prediction, 23)
    assert chosen[0] is Reference.PREVIOUS
    assert set(chosen[1:]) > {Reference.RENDER}
    assert set(chosen[1:]) <= FIELD_REFERENCES
    assert len(chosen) == 3


def test_no_second_picture_of_the_field_is_taken_where_the_first_has_everything():
    frame, view = pair(*SIZE_PX)
    now = wall(view.render)
    chosen = choose_references(FrameCosts(frame), Prediction(now, Past(frame, now)), 23)
    assert len(FIELD_REFERENCES & set(chosen)) == 1


@pytest.mark.parametrize("max_references", [1, 2, 3, 4])
def test_no_more_references_than_allowed(max_references):
    frame, view = pair(*SIZE_PX)
    now = wall(view.render)
    prediction = Prediction(now, Past(frame, now))
    chosen = choose_references(FrameCosts(frame), prediction, 23, max_references)
    assert 1 <= len(chosen) <= max_references
    assert (Reference.WARP in chosen) == (max_references == 4)
    assert chosen[-1] in (Reference.RENDER, Reference.CORRECTION)


@pytest.mark.parametrize(("effort", "most"), [("default", 4), ("x264-ultrafast", 3)])
def test_a_coder_is_given_no_more_references_than_it_takes(effort, most):
    """x264 refuses a picture with four."""
    last, frame, now = half_lost()
    encoder = DeltaEncoder(CodecConfig(*SIZE_PX, effort))
    state = EncoderState(1, 1, Past(last, now))
    made = encoder.encode(state, frame, now, FrameChoice(max_references=4, photometric=()))
    assert len(made.packet.references) == most


@pytest.mark.parametrize("size_px", [(1, 1), (7, 40), (40, 7)])
def test_pictures_smaller_than_a_block_have_the_render(size_px):
    frame = picture(*size_px)
    assert choose_references(FrameCosts(frame), Prediction(view_of(frame)), 23) == RENDER_ONLY
    assert not light_differs(shade(frame, 0.5, 0.0), view_of(frame).render)


# --- light


@pytest.mark.parametrize(("gain", "levels"), [(0.6, 0.0), (0.8, 12.0), (1.3, -6.0), (1.0, 20.0)])
def test_a_change_of_light_is_found_and_undone(gain, levels):
    """Rounding twice leaves at most one level each: shading and adapting."""
    frame, render = shade(picture(*SIZE_PX), gain, levels), picture(*SIZE_PX)
    undone = adapt(render, solve(frame, render))
    for a, b in zip(undone.planes, frame.planes, strict=True):
        assert np.abs(a.astype(int) - b).mean() < 1
        assert np.abs(a.astype(int) - b).max() <= 3


@pytest.mark.parametrize("size_px", [(640, 360), (828, 250), (1242, 376), (1281, 721), (64, 48)])
def test_a_wide_picture_has_no_more_equations_than_another(size_px, monkeypatch):
    """With as many as its height let in, one of 828x250 took 72 ms instead of 3."""
    equations = []
    lstsq = np.linalg.lstsq

    def counted(a: np.ndarray, b: np.ndarray, rcond: None) -> object:
        equations.append(len(a))
        return lstsq(a, b, rcond=rcond)

    monkeypatch.setattr(np.linalg, "lstsq", counted)
    render = picture(*size_px)
    matrix = np.array(solve(shade(render, 0.8, 12.0), render)).reshape(3, 4)
    assert 700 < max(equations) <= 1.02 * 14_400
    assert abs(matrix[0, 0] / 4096 - 0.8) < 0.01


def test_what_the_field_has_never_seen_does_not_bend_the_light():
    frame, view = pair(*SIZE_PX)
    dark = shade(frame, 0.7, 0.0)
    matrix = np.array(solve(dark, view.render)).reshape(3, 4)
    assert abs(matrix[0, 0] / 4096 - 0.7) < 0.02
    assert abs(matrix[0, 3] / 16) < 3


def test_light_is_sent_when_it_pays_and_beats_weighted_prediction():
    """A warm light moves chroma with luma, which a gain and an offset a plane cannot say."""
    frame, render = pair(*SIZE_PX)
    warm = adapt(frame, (3300, 0, 0, 0, -500, 3300, 0, 0, 600, 0, 3300, 0))
    encoder = DeltaEncoder(CodecConfig(*SIZE_PX))
    sent = encoder.encode(encoder.start(0), warm, render)
    assert len(sent.packet.photometric) == 12
    without = encoder.encode(
        encoder.start(0), warm, render, choice=FrameChoice(RENDER_ONLY, photometric=())
    )
    assert len(sent.packet.payload) + 24 < 0.8 * len(without.packet.payload)
    decoder = DeltaDecoder(encoder.header)
    decoded = decoder.decode(decoder.start(0), sent.packet, render)
    assert decoded.frame.digest() == sent.reconstruction.digest()


def test_light_that_did_not_change_is_not_sent():
    frame, view = pair(*SIZE_PX)
    assert not light_differs(frame, view.render)
    assert choose_photometric(FrameCosts(frame), view.render, 23) == ()
    assert choose_photometric(FrameCosts(frame), noise(*SIZE_PX, 1), 23) == ()


@pytest.mark.parametrize("size_px", [(1, 1), (2, 2), (3, 5), (101, 67)])
def test_the_identity_changes_no_sample_above_zero(size_px):
    picture = noise(*size_px, 1)
    identity = (4096, 0, 0, 0, 0, 4096, 0, 0, 0, 0, 4096, 0)
    for a, b in zip(adapt(picture, identity).planes, picture.planes, strict=True):
        assert np.array_equal(a, np.maximum(b, 1))
    assert adapt(picture, ()) is picture


@pytest.mark.parametrize("size_px", [(4, 2), (5, 3)])
def test_adapting_is_its_definition(size_px):
    """Sample by sample in Python's integers, with the largest numbers there may be."""
    picture = noise(*size_px, 3)
    rng = np.random.default_rng(1)
    numbers = tuple(int(n) for n in rng.integers(-(1 << 15), 1 << 15, 12))
    m = np.array(numbers, object).reshape(3, 4)
    got = adapt(picture, numbers)
    width, height = size_px
    y, u, v = (plane.astype(object) for plane in picture.planes)

    def value(row: int, luma: int, i: int, j: int, black: int) -> int:
        sum_ = m[row, 0] * luma + m[row, 1] * (u[j, i] - 128) + m[row, 2] * (v[j, i] - 128)
        return min(max(((sum_ + m[row, 3] * 256 + 2048) >> 12) + black, 1), 255)

    for j in range(height):
        for i in range(width):
            assert got.y[j, i] == value(0, y[j, i] - 16, i // 2, j // 2, 16)
    for j in range((height + 1) // 2):
        for i in range((width + 1) // 2):
            rows, columns = (2 * j, min(2 * j + 1, height - 1)), (2 * i, min(2 * i + 1, width - 1))
            mean = (sum(y[r, c] - 16 for r in rows for c in columns) + 2) >> 2
            assert got.u[j, i] == value(1, mean, i, j, 128)
            assert got.v[j, i] == value(2, mean, i, j, 128)


def test_numbers_that_cannot_be_are_refused():
    for numbers, named in (((1, 2), "2 numbers"), ((1 << 15, *[0] * 11), "32768 is outside")):
        with pytest.raises(InvalidInput, match=named):
            check_photometric(numbers)
    encoder = DeltaEncoder(CodecConfig(32, 32))
    packet = encoder.encode(encoder.start(0), *pair(32, 32)).packet
    with pytest.raises(InvalidInput, match="photometric"):
        replace(packet, photometric=(1,))
