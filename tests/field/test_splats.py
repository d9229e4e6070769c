"""A field keeps its parameters and metadata through a file; damage is one clear error."""

from dataclasses import replace

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose, TileOrigin
from rfcore.errors import BackendUnavailable, FieldFormatError, InvalidInput
from rfcore.field import FieldMetadata, SplatField, load_field, save_field
from rfcore.field.archive import Archive, encode_archive
from rfcore.field.interface import Bounds
from rfcore.field.quality import FULL, Quality
from rfcore.field.store import decode_field
from rfcore.raster.gaussians import Gaussians
from rfcore.vertical import Sight
from tests.field.some import make_gaussians

METADATA = FieldMetadata(
    "street", TileOrigin(691_608.0, 5_334_760.0, 520.5), "ab" * 32, 26.25, 0.875, antialiased=True
)


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 20])
def test_a_field_survives_its_file(tmp_path, n, sh_degree):
    field = SplatField(make_gaussians(n, sh_degree), METADATA)
    field_id = save_field(field, tmp_path / "street.rff")
    back = load_field(tmp_path / "street.rff")
    assert field_id == field.field_id == back.field_id
    assert back.metadata == METADATA
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(back.gaussians, name), getattr(field.gaussians, name))
    assert not list(tmp_path.glob("*.part"))


def test_what_is_known_of_its_training_cameras_survives_the_file(tmp_path):
    sights = (Sight((1.5, -2.0, 0.25), (0.6, 0.0, 0.8)), Sight((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    stated = replace(METADATA, up=(0.0, -1.0, 0.0), sights=sights, focal_px=320.25)
    save_field(SplatField(make_gaussians(), stated).compressed(), tmp_path / "a.rff")
    back = load_field(tmp_path / "a.rff")
    assert back.metadata == stated
    assert isinstance(back, SplatField)
    assert back.described(METADATA).archive().metadata.keys() == (
        SplatField(make_gaussians(), METADATA).compressed().archive().metadata.keys()
    )


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("up", [0, 0, 2]),
        ("up", [0, 1]),
        ("sights", [[0] * 6]),
        ("sights", [[0, 0, 0, 0, 0, 1]] * 65),
        ("focal_px", 0),
        ("focal_px", -1),
        ("focal_px", "320"),
    ],
)
def test_a_training_camera_that_can_be_none_is_refused(key, value):
    archive = SplatField(make_gaussians(), METADATA).archive()
    broken = Archive(archive.kind, {**archive.metadata, key: value}, archive.arrays)
    with pytest.raises(FieldFormatError):
        decode_field(encode_archive(broken))


def test_a_field_with_other_threads_shares_the_numbers():
    camera = Camera(Intrinsics(19, 11, 12.0, 12.0, 9.5, 5.5), Pose((0, 0, -5), (1.0, 0, 0, 0)))
    field = SplatField(make_gaussians(), METADATA)
    field.prepare()
    own = field.with_threads(2)
    assert own.gaussians is field.gaussians
    assert (own.field_id, own.metadata) == (field.field_id, field.metadata)
    assert (own.threads, own.rasterizer().threads, field.rasterizer().threads) == (2, 2, 1)
    half = Quality(detail=0.5)
    for quality in (FULL, half):
        assert own.render(camera, quality).depth.tobytes() == (
            field.render(camera, quality).depth.tobytes()
        )


def test_an_unmeasured_field_says_so(tmp_path):
    save_field(SplatField(make_gaussians()), tmp_path / "a.rff")
    assert load_field(tmp_path / "a.rff").metadata.held_out_psnr_db is None


def test_a_field_of_a_file_is_shown_with_count_size_and_id(tmp_path):
    field = SplatField(make_gaussians(7, 1))
    assert "7 splats of SH degree 1, of no file" in repr(field)
    save_field(field, tmp_path / "a.rff")
    shown = repr(load_field(tmp_path / "a.rff"))
    assert f"{(tmp_path / 'a.rff').stat().st_size / 1e6:.2f} MB, id {field.field_id}" in shown


def test_any_difference_gives_another_id():
    gaussians = make_gaussians()
    ids = {
        SplatField(gaussians, METADATA).field_id,
        SplatField(gaussians, FieldMetadata("avenue")).field_id,
        SplatField(make_gaussians(seed=1), METADATA).field_id,
    }
    assert len(ids) == 3


def test_the_bounds_hold_every_mean():
    gaussians = make_gaussians(9)
    bounds = SplatField(gaussians).bounds
    assert (gaussians.means >= np.array(bounds.low_m)).all()
    assert (gaussians.means <= np.array(bounds.high_m)).all()
    assert (gaussians.means == np.array(bounds.low_m)).any(axis=0).all()
    assert Bounds.around(make_gaussians(0).means).low_m == (0, 0, 0)


def test_an_instruction_set_nobody_has_is_refused_at_once():
    with pytest.raises(BackendUnavailable, match="mmx"):
        SplatField(make_gaussians(), isa="mmx")
    with pytest.raises(InvalidInput, match="threads"):
        SplatField(make_gaussians(), threads=0)


def archive_of(gaussians: Gaussians, **change: np.ndarray) -> dict[str, np.ndarray]:
    names = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
    return {**{name: getattr(gaussians, name) for name in names}, **change}


PLAIN = {
    "name": "",
    "training_digest": "",
    "held_out_psnr_db": None,
    "held_out_ssim": None,
    "antialiased": False,
    "tile_origin": {"east_m": 0, "north_m": 0, "up_m": 0},
}


@pytest.mark.parametrize(
    ("kind", "change", "metadata", "named"),
    [
        ("mesh", {}, PLAIN, "kind 'mesh', not splats"),
        ("splats", {"means": np.zeros((4, 3), np.float32)}, PLAIN, "gaussians.quaternions"),
        ("splats", {"sh": np.zeros((5, 5, 3), np.float32)}, PLAIN, "gaussians.sh"),
        ("splats", {"means": np.zeros((5, 3))}, PLAIN, "gaussians.means: must be contiguous float"),
        ("splats", {"means": np.full((5, 3), np.nan, np.float32)}, PLAIN, "5 of 5 .*not finite"),
        ("splats", {"more": np.zeros(1)}, PLAIN, "are not splats"),
        ("splats", {}, {}, "name"),
        ("splats", {}, {**PLAIN, "name": 3}, "field.name: 3 is not text"),
        ("splats", {}, {**PLAIN, "held_out_psnr_db": "good"}, "held_out_psnr_db"),
        ("splats", {}, {**PLAIN, "held_out_ssim": 2}, "held_out_ssim: 2.0 is outside -1..1"),
        ("splats", {}, {**PLAIN, "antialiased": 1}, "antialiased: 1 is neither"),
        ("splats", {}, {**PLAIN, "bounds": {"low_m": [0, 0], "high_m": [1, 1, 1]}}, "unpack"),
        ("splats", {}, {**PLAIN, "bounds": {"low_m": [0] * 3, "high_m": [1] * 3}}, "not those of"),
        (
            "splats",
            {},
            {**PLAIN, "bounds": {"low_m": [1] * 3, "high_m": [0] * 3}},
            "not the low",
        ),
        ("splats", {}, {**PLAIN, "tile_origin": {"east": 0}}, "east"),
        ("splats", {}, {**PLAIN, "tile_origin": 0}, "items"),
    ],
)
def test_an_archive_that_is_no_field_is_refused(tmp_path, kind, change, metadata, named):
    arrays = archive_of(make_gaussians(5), **change)
    file = tmp_path / "bad.rff"
    file.write_bytes(encode_archive(Archive(kind, metadata, arrays)))
    with pytest.raises(FieldFormatError, match=named) as caught:
        load_field(file)
    assert "bad.rff" in str(caught.value)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(FieldFormatError, match=r"none\.rff: cannot be read"):
        load_field(tmp_path / "none.rff")


def test_metadata_that_is_not_finite_is_refused():
    with pytest.raises(InvalidInput, match="held_out_psnr_db"):
        FieldMetadata(held_out_psnr_db=float("inf"))
