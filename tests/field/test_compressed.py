"""A compressed archive holds nearly the same splats, the same for everybody, and no surprise."""

import hashlib
import tracemalloc
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.field import (
    FieldMetadata,
    Quality,
    SplatField,
    load_field,
    save_field,
    splat_archive,
)
from rfcore.field.archive import (
    PREFIX_BYTES,
    Archive,
    array_ends,
    decode_archive,
    encode_archive,
    header_end,
)
from rfcore.field.quality import DETAILS, LevelOfDetail, kept_of
from rfcore.field.splat_archive import compressed_archive, detail_ends, splats_of_compressed
from rfcore.field.splat_grid import BLOCK, Grain, Steps, gaussians_of, numbers_of
from rfcore.field.store import decode_beginning, decode_field, encode_field
from rfcore.raster.gaussians import Gaussians, sky_of
from tests.field.some import make_gaussians

GOLDEN = Path(__file__).parent / "golden"
GOLDEN_SPLATS = "3597093196fa52eeb631e76985d822af7bb577ea11ec70dd24045f1194120adf"
CAMERA = Camera(Intrinsics(48, 36, 40.0, 40.0, 24.0, 18.0), Pose((0, 0, -5), (1, 0, 0, 0)))
STEPS = Steps()


def levels_of(gaussians: Gaussians, *details: float) -> dict[float, LevelOfDetail]:
    """Levels a little wider than their prefix."""
    levels = {}
    for detail in details:
        kept = kept_of(len(gaussians), detail)
        wider = gaussians.log_scales[:kept] + np.float32(1 / detail / 16)
        levels[detail] = LevelOfDetail(wider, gaussians.opacity_logits[:kept] + np.float32(0.5))
    return levels


def field_of(gaussians: Gaussians, *details: float) -> SplatField:
    metadata = FieldMetadata("street", held_out_psnr_db=27.0)
    return SplatField(gaussians, metadata, levels=levels_of(gaussians, *details))


def harmed(archive: Archive, data: st.DataObject) -> Archive:
    """The archive with a byte of one of its streams and what its header says of that changed."""
    name = data.draw(st.sampled_from(sorted(archive.arrays)))
    numbers = archive.metadata["encoding"]["streams"][name]
    stream = archive.arrays[name].copy()
    stream[data.draw(st.integers(0, len(stream) - 1))] ^= data.draw(st.integers(0, 255))
    lowest = [data.draw(st.integers(-(2**24), 2**24)) for _ in numbers["lowest"]]
    streams = {**archive.metadata["encoding"]["streams"], name: {**numbers, "lowest": lowest}}
    encoding = {**archive.metadata["encoding"], "streams": streams}
    metadata = {**archive.metadata, "encoding": encoding}
    return Archive(archive.kind, metadata, {**archive.arrays, name: stream})


def digest_of(field: SplatField) -> str:
    """SHA-256 over every array of the splats and levels."""
    digest = hashlib.sha256()
    for f in fields(Gaussians):
        digest.update(getattr(field.gaussians, f.name).tobytes())
    for own in field.levels.values():
        digest.update(own.log_scales.tobytes() + own.opacity_logits.tobytes())
    return digest.hexdigest()


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 700])
def test_a_compressed_field_survives_its_file(tmp_path, n, sh_degree):
    field = field_of(make_gaussians(n, sh_degree), 0.5, 0.1).compressed()
    field_id = save_field(field, tmp_path / "a.rff")
    back = load_field(tmp_path / "a.rff")
    assert isinstance(back, SplatField)
    assert back.field_id == field.field_id == field_id
    assert (back.metadata, back.bounds) == (field.metadata, field.bounds)
    assert digest_of(back) == digest_of(field)
    assert set(back.levels) == {0.5, 0.1}
    assert back.compressed() is back
    assert save_field(back, tmp_path / "b.rff") == field_id, "what was loaded is saved as it was"


def test_the_decoded_bytes_are_pinned():
    """Both ends of a session decode for themselves; ``golden_field`` made the file."""
    path = GOLDEN / "grid-2.rff"
    field = load_field(path)
    assert isinstance(field, SplatField)
    assert digest_of(field) == GOLDEN_SPLATS
    assert field.field_id == hashlib.sha256(path.read_bytes()).hexdigest()


def golden_field(gaussians: Gaussians) -> bytes:
    """Return the field of the golden files: ``make_gaussians(300, 1)``."""
    return encode_field(field_of(gaussians, 0.5, 0.25).compressed())


def test_the_golden_file_is_what_its_maker_makes():
    data = golden_field(make_gaussians(300, 1))
    made = decode_field(data)
    assert isinstance(made, SplatField)
    assert digest_of(made) == GOLDEN_SPLATS
    assert data == (GOLDEN / "grid-2.rff").read_bytes()


def test_every_value_is_within_half_a_step():
    g = make_gaussians(600, 2)
    back = gaussians_of(numbers_of(g, STEPS), STEPS)
    assert np.abs(back.log_scales - g.log_scales).max() <= 2.0**-STEPS.log_scales / 2
    assert np.abs(back.opacity_logits - g.opacity_logits).max() <= 2.0**-STEPS.opacity_logits / 2
    assert np.abs(back.sh[:, 0] - g.sh[:, 0]).max() <= 2.0**-STEPS.sh_dc / 2
    assert np.abs(back.sh[:, 1:] - g.sh[:, 1:]).max() <= 2.0**-STEPS.sh_rest / 2
    for start in range(0, 600, BLOCK):
        part = slice(start, start + BLOCK)
        narrow = np.exp(np.quantile(np.sort(g.log_scales[part], axis=1)[:, 1], 0.1))
        assert np.abs(back.means[part] - g.means[part]).max() <= narrow / 8 / 2 * 1.01


def test_a_rotation_turns_by_less_than_a_degree():
    """Each of three components is off by at most 1/254 of the largest: |dq| <= sqrt(3)/254,
    and a rotation's angle is at most 2 asin of that, 0.8 degrees."""
    g = make_gaussians(600, 0)
    back = gaussians_of(numbers_of(g, STEPS), STEPS)
    a = g.quaternions / np.linalg.norm(g.quaternions, axis=1, keepdims=True)
    b = back.quaternions / np.linalg.norm(back.quaternions, axis=1, keepdims=True)
    angles = 2 * np.arccos(np.clip(np.abs((a * b).sum(axis=1)), 0, 1))
    assert np.degrees(angles).max() < 0.8
    still = replace(g, quaternions=np.zeros_like(g.quaternions))
    want = [[1, 0, 0, 0]] * 600
    np.testing.assert_array_equal(gaussians_of(numbers_of(still, STEPS), STEPS).quaternions, want)


def test_a_coarser_grain_takes_fewer_bytes_and_is_read_like_any_other():
    """Means are off by half a step of at most the narrow widths, rotations by 4 of 127 steps.

    Two bits less of three numbers a splat are 450 of 9,000 bytes.
    """

    def stream_bytes(field: SplatField) -> int:
        return sum(array.nbytes for array in field.archive().arrays.values())

    g = make_gaussians(600, 0)
    field = SplatField(g)
    coarse = field.compressed(STEPS, Grain(0, 8))
    assert stream_bytes(coarse) < 0.95 * stream_bytes(field.compressed())
    back = decode_field(encode_field(coarse))
    assert isinstance(back, SplatField)
    assert digest_of(back) == digest_of(coarse)
    numbers = numbers_of(g, STEPS, Grain(0, 8))
    assert not (numbers.rotations[:, 1:] % 8).any()
    off = np.abs(numbers.rotations - numbers_of(g, STEPS).rotations)
    assert off.max() <= 8, "8 steps at the end of the range, 4 elsewhere"
    for start in range(0, 600, BLOCK):
        part = slice(start, start + BLOCK)
        narrow = np.exp(np.quantile(np.sort(g.log_scales[part], axis=1)[:, 1], 0.1))
        moved = gaussians_of(numbers, STEPS).means[part] - g.means[part]
        assert np.abs(moved).max() <= narrow / 2 * 1.01


@pytest.mark.parametrize("grain", [(-1, 1), (17, 1), (3, 0), (3, 128)])
def test_a_grain_that_cannot_be_is_refused(grain):
    with pytest.raises(InvalidInput, match="grain: "):
        Grain(*grain)


def test_splats_far_from_the_origin_keep_what_float32_keeps():
    g = make_gaussians(300, 0)
    distant = replace(g, means=g.means + np.float32(1e6), log_scales=g.log_scales - 9)
    back = gaussians_of(numbers_of(distant, STEPS), STEPS)
    assert np.abs(back.means - distant.means).max() <= 2.0 ** (20 - 23) / 2


def test_a_field_with_sky_keeps_the_places_of_its_street():
    """Only the block of a band that has both takes the sky's steps, and they are 8 mm."""
    g = make_gaussians(3000, 0)
    g.means[::7] *= 1e5 / np.linalg.norm(g.means[::7], axis=1, keepdims=True)
    marked = replace(g, opacity_logits=np.arange(3000, dtype=np.float32))
    field = field_of(marked)
    back = decode_field(encode_field(field)).gaussians
    moved_m = np.abs(back.means - g.means[back.opacity_logits.astype(int)]).max(axis=1)
    is_sky = sky_of(back.means)
    assert is_sky.sum() == len(g.means[::7])
    assert moved_m.max() <= 2.0**-7
    assert (moved_m[~is_sky] > 2.0**-9).sum() < len(DETAILS) * BLOCK
    assert np.abs(field.bounds.low_m).max() < 10 > np.abs(field.bounds.high_m).max()


def test_every_level_keeps_its_splats():
    """Neighbours are brought together within a band only; opacity tells which splat is which."""
    g = make_gaussians(1000, 0)
    marked = replace(g, opacity_logits=np.arange(1000, dtype=np.float32))
    back, _ = splats_of_compressed(compressed_archive(marked, {}, FieldMetadata()))
    for detail in DETAILS:
        kept = kept_of(1000, detail)
        assert sorted(back.opacity_logits[:kept]) == list(range(kept))
    distance = np.linalg.norm(np.diff(back.means[500:], axis=0), axis=1).mean()
    assert distance < 0.5 * np.linalg.norm(np.diff(g.means[500:], axis=0), axis=1).mean()


def test_pictures_of_every_level_stay_close():
    field = field_of(make_gaussians(700, 1), 0.5, 0.25)
    small = field.compressed()
    for detail in DETAILS:
        quality = Quality(detail)
        difference = small.render_colour(CAMERA, quality) - field.render_colour(CAMERA, quality)
        assert np.sqrt(np.mean(np.square(difference))) < 0.04


def test_other_metadata_make_another_field_of_the_same_splats():
    field = field_of(make_gaussians(50), 0.5).compressed()
    measured = field.described(replace(field.metadata, held_out_ssim=0.5))
    assert measured.field_id != field.field_id
    back = decode_field(encode_field(measured))
    assert back.field_id == measured.field_id
    assert back.metadata.held_out_ssim == 0.5
    assert digest_of(measured) == digest_of(field)


def with_encoding(field: SplatField, change: dict[str, Any]) -> bytes:
    """The field's archive with another encoding in its header, its digests right."""
    archive = decode_archive(encode_field(field))
    encoding = {**archive.metadata["encoding"], **change}
    metadata = {**archive.metadata, "encoding": encoding}
    return encode_archive(Archive(archive.kind, metadata, archive.arrays))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"name": "grid-3"}, "'grid-3' is not 'grid-2'"),
        ({"count": 2_000_000_000}, "count: 2000000000 is not a whole number"),
        ({"count": 50_000_000}, "raise it"),
        ({"count": 1_000_000}, "does not hold"),
        ({"count": 10_000_000}, "a bomb"),
        ({"count": 21}, "does not hold"),
        ({"count": -1}, "count: -1"),
        ({"count": True}, "count: True"),
        ({"sh_degree": 4}, "sh_degree: 4"),
        ({"sh_degree": 0}, "not a list of 3"),
        ({"steps": {"log_scales": 99}}, r"steps\.log_scales: 99"),
        ({"steps": {"colour": 1}}, "colour"),
        ({"streams": {}}, "blocks"),
        ({"streams": None}, "NoneType"),
    ],
)
def test_an_encoding_that_lies_is_refused_by_name(change, named):
    field = field_of(make_gaussians(20, 1)).compressed()
    with pytest.raises(FieldFormatError, match=named):
        decode_field(with_encoding(field, change))


def test_streams_that_do_not_belong_are_refused():
    archive = field_of(make_gaussians(20, 1)).compressed().archive()
    arrays = {**archive.arrays, "more": np.zeros(3, np.uint8)}
    data = encode_archive(Archive(archive.kind, archive.metadata, arrays))
    with pytest.raises(FieldFormatError, match="are not its streams"):
        decode_field(data)


@pytest.mark.parametrize("name", ["log_scales", "opacity_logits", "sh"])
def test_values_no_grid_holds_are_refused_by_name(name):
    g = make_gaussians(5)
    huge = getattr(g, name).copy()
    huge.flat[-1] = 1e30
    with pytest.raises(InvalidInput, match=f"gaussians.{name}: 1e\\+30 is too large"):
        SplatField(replace(g, **{name: huge})).compressed()


@given(st.data())
def test_streams_made_to_harm_give_splats_or_are_refused(data):
    """Whoever writes the file writes its digests: beneath them anything may stand."""
    harmful = harmed(field_of(make_gaussians(20, 1), 0.5).compressed().archive(), data)
    metadata = {key: value for key, value in harmful.metadata.items() if key != "bounds"}
    harmful = Archive(harmful.kind, metadata, harmful.arrays)
    try:
        field = decode_field(encode_archive(harmful))
    except FieldFormatError:
        return
    assert np.isfinite(field.render_colour(CAMERA)).all()


def test_a_count_that_lies_allocates_nothing():
    lie = with_encoding(field_of(make_gaussians(20, 1)).compressed(), {"count": 10_000_000})
    tracemalloc.start()
    try:
        with pytest.raises(FieldFormatError, match="a bomb"):
            decode_field(lie)
        assert tracemalloc.get_traced_memory()[1] < 10 * len(lie) + 1_000_000
    finally:
        tracemalloc.stop()


def test_splats_decoded_in_parts_are_those_decoded_at_once(monkeypatch):
    field = field_of(make_gaussians(700, 2), 0.5, 0.1)
    at_once = splats_of_compressed(field.compressed().archive())
    monkeypatch.setattr(splat_archive, "SPLATS_AT_ONCE", BLOCK)
    in_parts = splats_of_compressed(field.compressed().archive())
    for one, other in zip(
        (at_once[0], *at_once[1].values()), (in_parts[0], *in_parts[1].values()), strict=True
    ):
        for name in vars(one):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_a_field_beyond_the_memory_it_may_take_is_refused_before_it_is_decoded():
    data = encode_field(field_of(make_gaussians(700, 3)).compressed())
    size_bytes = 700 * 59 * 4
    assert decode_field(data, max_bytes=size_bytes).primitives == 700
    with pytest.raises(FieldFormatError, match=r"700 of SH degree 3 take 0\.00 GB of memory, over"):
        decode_field(data, max_bytes=size_bytes - 1)


def ends_of(data: bytes) -> dict[float, int]:
    """Return the bytes of an archive that each level of detail needs."""
    return dict(detail_ends(array_ends(data[: header_end(data[:PREFIX_BYTES])])))


@pytest.mark.parametrize("levels", [(), (0.5,), (0.5, 0.25, 0.1)])
@pytest.mark.parametrize("n", [1, 3, 700])
def test_a_beginning_draws_its_levels_as_the_whole_does(n, levels):
    data = encode_field(field_of(make_gaussians(n, 2), *levels).compressed())
    whole, ends = decode_field(data), ends_of(data)
    assert list(ends) == [0.1, 0.25, 0.5, 1.0]
    assert ends[1.0] == len(data)
    for detail in (0.1, 0.25, 0.5):
        begun = decode_beginning(data[: ends[detail]], whole.field_id)
        assert (begun.field_id, begun.bounds) == (whole.field_id, whole.bounds)
        assert begun.most_detail == detail
        for below in (d for d in ends if d <= detail):
            quality = Quality(detail=below)
            mine, theirs = (f.render_colour(CAMERA, quality) for f in (begun, whole))
            np.testing.assert_array_equal(mine, theirs)


def test_a_beginning_draws_no_more_than_it_has_and_is_no_archive():
    data = encode_field(field_of(make_gaussians(700, 1), 0.5).compressed())
    begun = decode_beginning(data[: ends_of(data)[0.25] + 100], "ab" * 32)
    assert begun.most_detail == 0.25
    with pytest.raises(InvalidInput, match=r"quality\.detail: 0\.5 is above 0\.25, here"):
        begun.render(CAMERA, Quality(detail=0.5))
    with pytest.raises(InvalidInput, match=r"1 is above 0\.25"):
        begun.render(CAMERA)
    with pytest.raises(InvalidInput, match="175 of 700 splats are here"):
        begun.archive()


def test_too_short_or_damaged_a_beginning_is_refused():
    data = bytearray(encode_field(field_of(make_gaussians(700, 1), 0.1).compressed()))
    end = ends_of(bytes(data))[0.1]
    for short in (10, 63, 64, end // 2, end - 1):
        with pytest.raises(FieldFormatError):
            decode_beginning(bytes(data[:short]), "ab" * 32)
    for at in (20, 200, end - 100):
        data[at] ^= 1
        with pytest.raises(FieldFormatError, match=r"differs|zero|damaged"):
            decode_beginning(bytes(data[:end]), "ab" * 32)
        data[at] ^= 1
    assert decode_beginning(bytes(data[:end]), "ab" * 32).most_detail == 0.1


def test_other_archives_have_no_beginning():
    raw = encode_field(SplatField(make_gaussians(9, 0)))
    assert ends_of(raw) == {}
    with pytest.raises(FieldFormatError):
        decode_beginning(raw[:-1], "ab" * 32)
