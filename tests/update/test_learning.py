"""Another light and changes are learnt; an update that does not pay is not written."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.field import SplatField
from rfcore.field.interface import base_of
from rfcore.field.store import decode_field, encode_field
from rfcore.harmonics import SH_DC
from rfcore.image import Rgb
from rfcore.raster.gaussians import Gaussians
from rfcore.update.colours import ColourFit, colour_layer
from rfcore.update.passes import Pass, split_frames, trusted_pixels
from rfcore.update.run import LearnAs, Trial, UpdateSettings, learn, saved_percent, try_field
from rfcore.update.splats import FineTuning, fine_tuned
from tests.clouds import upright

QUICK = UpdateSettings(fine_tuning=FineTuning(120, growth=0.0))


def with_vehicle(number: int, rgb: Rgb) -> Rgb:
    """A white block that drives by, a place further in every frame."""
    out = rgb.copy()
    out[24:48, 4 * number + 8 : 4 * number + 32] = 255
    return out


def luma_error(field: SplatField, drive: Pass) -> float:
    shown = [np.clip(field.render_colour(p.camera), 0, 1) * 255 for p in drive.pictures]
    pairs = zip(shown, drive.pictures, strict=True)
    return float(np.mean([np.abs(colour - p.read()).mean() for colour, p in pairs]))


def test_another_light_is_learnt_and_pays(noon, dusk, make_pass):
    passes = [make_pass(dusk, "a"), make_pass(dusk, "b", 0.15)]
    update = learn(noon, passes, QUICK)
    assert not update.refused
    assert update.mean_saved_percent > 10
    third = make_pass(dusk, "c", -0.1)
    assert luma_error(update.learnt, third) < 0.2 * luma_error(noon, third)


def test_a_layer_learns_the_light_on_the_shape_that_is_there(noon, dusk, make_pass):
    passes = [make_pass(dusk, "a"), make_pass(dusk, "b", 0.15)]
    update = learn(noon, passes, replace(QUICK, learn_as=LearnAs.COLOURS))
    assert not update.refused
    third = make_pass(dusk, "c", -0.1)
    assert luma_error(update.learnt, third) < 0.3 * luma_error(noon, third)
    data = encode_field(update.learnt)
    again = decode_field(data, open_base=lambda _: noon)
    assert (again.gaussians.sh == update.learnt.gaussians.sh).all()
    assert (again.gaussians.means == noon.gaussians.means).all()


def test_a_delta_learns_as_much_in_fewer_bytes_and_again_from_what_it_learnt(noon, dusk, make_pass):
    """A second update starts from the first one's field, and is a delta of the same base."""
    base = noon.compressed()
    passes = [make_pass(dusk, "a"), make_pass(dusk, "b", 0.15)]
    whole = learn(base, passes, QUICK)
    delta = learn(base, passes, replace(QUICK, learn_as=LearnAs.DELTA))
    assert not delta.refused
    third = make_pass(dusk, "c", -0.1)
    assert luma_error(delta.learnt, third) < 1.1 * luma_error(whole.learnt, third)
    data = encode_field(delta.learnt)
    assert len(data) < len(encode_field(whole.learnt))
    assert decode_field(data, open_base=lambda _: base).field_id == delta.learnt.field_id
    more = learn(
        delta.learnt, passes, replace(QUICK, learn_as=LearnAs.DELTA, min_saved_percent=-100)
    )
    assert base_of(more.learnt.archive()) == base.field_id
    assert luma_error(more.learnt, third) < 1.1 * luma_error(delta.learnt, third)


def test_a_delta_of_a_field_that_is_not_compressed_is_refused_before_learning(
    noon, dusk, make_pass
):
    passes = [make_pass(dusk, "a"), make_pass(dusk, "b", 0.15)]
    with pytest.raises(InvalidInput, match=r"delta\.base: .* is not a compressed field"):
        learn(noon, passes, replace(QUICK, learn_as=LearnAs.DELTA))


def test_what_is_known_already_is_not_written(noon, make_pass):
    update = learn(noon, [make_pass(noon, "a"), make_pass(noon, "b", 0.1)], QUICK)
    assert "less than 2 %" in update.refused or "rise by" in update.refused


def test_a_pass_that_gets_dearer_withholds_the_update(noon, dusk, make_pass):
    """Two at dusk outvote one at noon, whose bits would rise."""
    passes = [make_pass(dusk, "a"), make_pass(dusk, "b", 0.1), make_pass(noon, "c", 0.05)]
    assert learn(noon, passes, QUICK).refused.startswith("bits rise by")


def test_the_same_passes_give_the_same_field(noon, dusk, make_pass):
    frames, _ = split_frames([make_pass(dusk, "a"), make_pass(dusk, "b", 0.1)], 24)
    config = FineTuning(30)
    first = fine_tuned(noon, frames, config)
    second = fine_tuned(noon, frames, replace(config, threads=2))
    assert first.field_id == second.field_id
    fit = ColourFit(2, 2)
    layers = [colour_layer(noon, frames, replace(fit, threads=t)) for t in (1, 2)]
    assert layers[0].field_id == layers[1].field_id


def test_what_drives_by_in_one_pass_is_not_trusted(noon, make_pass):
    passes = [make_pass(noon, "a", paint=with_vehicle), make_pass(noon, "b", 0.03)]
    frames, _ = split_frames(passes, 24)
    trusted = trusted_pixels(noon, frames)
    first = trusted[0]
    assert not first[28:44, 16:24].any()
    assert first[:, 72:].all()
    assert all(mask is None for mask in trusted[len(frames) // 2 :])


def test_what_all_passes_see_is_trusted(noon, make_pass):
    def parked(_: int, rgb: Rgb) -> Rgb:
        return with_vehicle(5, rgb)

    passes = [make_pass(noon, "a", paint=parked), make_pass(noon, "b", 0.01, paint=parked)]
    frames, _ = split_frames(passes, 24)
    masks = trusted_pixels(noon, frames)
    assert all(mask is None or mask[28:44, 32:44].all() for mask in masks)


def test_a_vehicle_in_one_of_two_passes_is_not_baked_in(noon, make_pass):
    """A wall in white before the first vehicle; against the same update without votes."""

    def walled(_: int, rgb: Rgb) -> Rgb:
        out = rgb.copy()
        out[16:] = 255
        return out

    passes = [make_pass(noon, "a", paint=walled), make_pass(noon, "b", 0.03)]
    frames, _ = split_frames(passes, 24)
    empty = make_pass(noon, "c", 0.06)
    believed = [replace(frame, pass_number=0) for frame in frames]
    config = FineTuning(80, sh_dc=2e-2, growth=0.0)
    voted = luma_error(fine_tuned(noon, frames, config), empty)
    assert voted < 0.5 * luma_error(fine_tuned(noon, believed, config), empty)


def test_bits_are_compared_at_equal_quality():
    """Two lines of equal slope in log(rate), a factor of two apart."""
    before = Trial({0: ((30.0, 100.0), (33.0, 200.0), (36.0, 400.0))})
    after = Trial({0: ((31.0, 100 * 2 ** (1 / 3) / 2), (37.0, 100 * 2 ** (7 / 3) / 2))})
    assert saved_percent(before, after)[0] == pytest.approx(50.0)
    assert saved_percent(after, before)[0] == pytest.approx(-100.0)


def test_a_trial_without_frames_is_refused(noon):
    with pytest.raises(InvalidInput, match="no frames are held back"):
        try_field(noon, [])


# --- what comes to stay


def with_box(field: SplatField) -> SplatField:
    """A white box of 80 splats, 0.8 by 0.6 m, half a metre before the wall."""
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 10), np.linspace(-0.3, 0.3, 8))
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, BOX_M)], axis=1)
    colours = 0.9 + 0.1 * rng.uniform(-1, 1, (x.size, 3))
    size_m = np.float32([0.06, 0.06, 0.02])
    box = upright(means, (colours - 0.5) / SH_DC, size_m, 3.0).gaussians
    parts = (field.gaussians, box)
    names = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return SplatField(Gaussians(**joined))


BOX_M = 3.5
STAYS = FineTuning(300, growth=0.1)


def where_the_box_is(gaussians: Gaussians) -> NDArray[np.bool_]:
    """Tell which splats are seen, from the middle of the drives, within the box's outline."""
    x, y, z = gaussians.means.T
    return (np.abs(x / z * BOX_M) < 0.5) & (np.abs(y / z * BOX_M) < 0.4)


def test_gaussians_are_added_where_something_has_come_to_stay(noon, make_pass):
    """The share of new ones there is several times that of the rest of the wall."""
    parked = with_box(noon)
    frames, _ = split_frames([make_pass(parked, "a"), make_pass(parked, "b", 0.15)], 24)
    learnt = fine_tuned(noon, frames, STAYS)
    assert noon.primitives < learnt.primitives <= 1.1 * noon.primitives + 1
    before, after = (where_the_box_is(f.gaussians) for f in (noon, learnt))
    added_there = after.sum() / before.sum() - 1
    added_elsewhere = (~after).sum() / (~before).sum() - 1
    assert added_there > 3 * max(added_elsewhere, 0.02)
    third = make_pass(parked, "c", -0.1)
    assert luma_error(learnt, third) < 0.6 * luma_error(noon, third)
