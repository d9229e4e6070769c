"""A delta: a version of a field out of its base and what differs, and nothing else."""

from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from field.test_compressed import harmed, levels_of
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import FieldFormatError, InvalidInput, UnknownField
from rfcore.field import FieldMetadata, FieldStore, SplatField, load_field, save_field
from rfcore.field.archive import Archive, encode_archive
from rfcore.field.delta import SMALLEST_BAND, delta_of
from rfcore.field.interface import base_of
from rfcore.field.quality import splats_in
from rfcore.field.splat_grid import Steps
from rfcore.field.store import decode_field, encode_field
from rfcore.raster.gaussians import Gaussians
from tests.field.some import make_gaussians

CAMERA = Camera(Intrinsics(48, 36, 40.0, 40.0, 24.0, 18.0), Pose((0, 0, -5), (1, 0, 0, 0)))
STEPS = Steps()


def compressed(gaussians: Gaussians, *details: float) -> SplatField:
    levels = levels_of(gaussians, *details)
    return SplatField(gaussians, FieldMetadata("noon"), levels=levels).compressed()


def joined(first: Gaussians, second: Gaussians) -> Gaussians:
    return Gaussians(
        **{
            f.name: np.concatenate([getattr(first, f.name), getattr(second, f.name)])
            for f in fields(Gaussians)
        }
    )


def moved(gaussians: Gaussians, seed: int, share: float = 1.0) -> Gaussians:
    """A share of the splats a little elsewhere, larger, fainter and of another colour."""
    rng = np.random.default_rng(seed)
    some = rng.random(len(gaussians)) < share

    def off(values: np.ndarray, by: float) -> np.ndarray:
        noise = rng.normal(0, by, values.shape) * some.reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray(values + noise, np.float32)

    return Gaussians(
        off(gaussians.means, 0.05),
        off(gaussians.quaternions, 0.02),
        off(gaussians.log_scales, 0.2),
        off(gaussians.opacity_logits, 0.5),
        off(gaussians.sh, 0.2),
    )


@pytest.mark.parametrize("sh_degree", [0, 3])
@pytest.mark.parametrize(("n", "more"), [(0, 0), (1, 2), (700, 0), (700, 30)])
def test_a_version_is_within_half_a_step_and_its_archive_makes_it_again(n, more, sh_degree):
    base = compressed(make_gaussians(n, sh_degree), 0.5, 0.1)
    behind = make_gaussians(n + more, sh_degree)
    wanted = joined(moved(base.gaussians, 3), splats_in(behind, slice(n, None)))
    version = SplatField(wanted, FieldMetadata("dusk"), levels=levels_of(wanted, 0.5, 0.1))
    made = delta_of(base, version)
    assert (made.primitives, made.metadata.name) == (n + more, "dusk")
    got = made.gaussians
    for name, bits in (("log_scales", STEPS.log_scales), ("opacity_logits", STEPS.opacity_logits)):
        off = np.abs(getattr(got, name) - getattr(wanted, name))
        assert off.max(initial=0) <= 2.0**-bits / 2
    assert np.abs(got.sh - wanted.sh).max(initial=0) <= (SMALLEST_BAND + 2) * 2.0**-STEPS.sh_rest
    for detail, own in made.levels.items():
        off = np.abs(own.log_scales - version.levels[detail].log_scales)
        assert off.max(initial=0) <= 2.0**-STEPS.log_scales / 2
    again = decode_field(encode_field(made), open_base=lambda _: base)
    assert isinstance(again, SplatField)
    assert again.field_id == made.field_id
    assert base_of(again.archive()) == base.field_id
    for f in fields(Gaussians):
        np.testing.assert_array_equal(getattr(again.gaussians, f.name), getattr(got, f.name))
    assert set(again.levels) == {0.5, 0.1}


def test_what_did_not_change_takes_no_bytes_and_stays_to_the_bit():
    base = compressed(make_gaussians(3000, 3), 0.5, 0.25, 0.1)
    same = delta_of(base, base)
    assert same.archive().arrays == {}
    for f in fields(Gaussians):
        np.testing.assert_array_equal(
            getattr(same.gaussians, f.name), getattr(base.gaussians, f.name)
        )
    few = SplatField(moved(base.gaussians, 5, 0.05), levels=base.levels)
    whole_bytes, delta_bytes = (
        len(encode_field(f)) for f in (few.compressed(), delta_of(base, few))
    )
    assert delta_bytes < 0.15 * whole_bytes


def test_small_differences_of_higher_bands_are_left_out_and_others_kept():
    base = compressed(make_gaussians(5, 1))
    sh, step = base.gaussians.sh.copy(), np.float32(2.0**-STEPS.sh_rest)
    sh[0, 0] += step  # the constant colour: always
    sh[1, 1] += step
    sh[2, 1] += 2 * step
    got = delta_of(base, SplatField(replace(base.gaussians, sh=sh))).gaussians.sh
    np.testing.assert_array_equal(got[[0, 2]], sh[[0, 2]])
    np.testing.assert_array_equal(got[1], base.gaussians.sh[1])


def test_a_version_of_a_version_is_of_the_first_base():
    base = compressed(make_gaussians(100, 1))
    once = delta_of(base, SplatField(moved(base.gaussians, 1)))
    assert once.base is base
    with pytest.raises(InvalidInput, match=r"delta\.base: .* is not a compressed field"):
        delta_of(once, once)
    twice = delta_of(base, SplatField(moved(once.gaussians, 2)))
    assert base_of(twice.archive()) == base.field_id


def test_a_base_that_cannot_be_one_is_refused():
    raw = SplatField(make_gaussians(20, 1))
    with pytest.raises(InvalidInput, match="not a compressed field of splats; learn another"):
        delta_of(raw, raw)
    base = raw.compressed()
    fewer = SplatField(splats_in(base.gaussians, slice(0, 19)))
    with pytest.raises(InvalidInput, match="19 splats are fewer than the base's 20"):
        delta_of(base, fewer)
    with pytest.raises(InvalidInput, match="SH degree 0 is not the base's"):
        delta_of(base, SplatField(make_gaussians(20, 0)))
    far = base.gaussians.means.copy()
    far[3] = 1e9
    with pytest.raises(InvalidInput, match="went further than the base's grid reaches"):
        delta_of(base, SplatField(replace(base.gaussians, means=far)))


def test_another_base_is_refused_and_a_missing_one_named(tmp_path):
    base, other = compressed(make_gaussians(20, 1)), compressed(make_gaussians(21, 1))
    made = delta_of(base, SplatField(moved(base.gaussians, 1)))
    with pytest.raises(FieldFormatError, match=r"delta\.base: is for field"):
        decode_field(encode_field(made), open_base=lambda _: other)
    save_field(made, tmp_path / "dusk.rff")
    with pytest.raises(UnknownField, match=base.field_id):
        load_field(tmp_path / "dusk.rff")
    save_field(base, tmp_path / "noon.rff")
    assert load_field(tmp_path / "dusk.rff").field_id == made.field_id
    store = FieldStore(tmp_path / "store")
    with pytest.raises(UnknownField, match=base.field_id):
        store.add(encode_field(made))
    store.add(encode_field(base))
    assert store.load(store.add(encode_field(made))).field_id == made.field_id


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": "delta-2"}, "is not 'delta-1'"),
        ({"count": 19}, r"19 is not a whole number 20\.\."),
        ({"count": 2.5}, "2.5 is not a whole number"),
        ({"count": 50_000_000}, "is not a whole number|raise it"),
        ({"count": 9_000}, r"lack added\.means of 8980 splats"),
        ({"levels": [0.3]}, r"\(0\.3,\) are not of"),
        ({"streams": {}}, "are not its streams"),
    ],
)
def test_an_encoding_that_lies_is_refused_by_name(change, message):
    base = compressed(make_gaussians(20, 1))
    archive = delta_of(base, SplatField(moved(base.gaussians, 1))).archive()
    encoding = {**archive.metadata["encoding"], **change}
    lie = Archive(archive.kind, {**archive.metadata, "encoding": encoding}, archive.arrays)
    with pytest.raises(FieldFormatError, match=message):
        decode_field(encode_archive(lie), open_base=lambda _: base)


@cache
def base_and_delta():
    base = compressed(make_gaussians(20, 1), 0.5)
    wanted = joined(moved(base.gaussians, 1), make_gaussians(3, 1))
    return base, delta_of(base, SplatField(wanted, levels=levels_of(wanted, 0.5))).archive()


@given(st.data())
def test_streams_made_to_harm_give_splats_or_are_refused(data):
    """Whoever writes the file writes its digests: beneath them anything may stand."""
    base, archive = base_and_delta()
    harmful = harmed(archive, data)
    try:
        field = decode_field(encode_archive(harmful), open_base=lambda _: base)
    except FieldFormatError:
        return
    assert np.isfinite(field.render_colour(CAMERA)).all()
