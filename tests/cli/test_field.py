"""``rfedge field`` and ``rfedge render``: files in, files and figures out, mistakes by name."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import FieldFormatError, InvalidData, InvalidInput
from rfcore.field import (
    FieldMetadata,
    SplatField,
    load_field,
    read_splat_file,
    save_field,
    write_ply,
)
from rfcore.field.ply_table import read_vertices, write_vertices
from rfcore.field.similarity import Similarity, moved
from rfcore.geodesy import Anchor
from rfcore.image import read_rgb, write_png
from rfcore.raster.gaussians import Gaussians
from rfedge.arguments import field_path
from rfedge.cli.codec import Decode, Encode
from rfedge.cli.field import (
    FieldAnchor,
    FieldCheck,
    FieldExport,
    FieldImport,
    FieldInfo,
    FieldSlim,
)
from rfedge.cli.render import Render

HALF = float(np.sqrt(0.5))
NERFSTUDIO = Similarity(Pose((0.3, -0.2, 0.1), (HALF, 0.0, HALF, 0.0)), 0.05)
SIZE = (48, 36)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def splats() -> Gaussians:
    rng = np.random.default_rng(2)
    n = 200
    sh = np.zeros((n, 4, 3), np.float32)
    sh[:, 0] = rng.uniform(-1.5, 1.5, (n, 3))
    return Gaussians(
        means=rng.uniform([-3, -2, 3], [4, 2, 6], (n, 3)).astype(np.float32),
        quaternions=rng.normal(size=(n, 4)).astype(np.float32),
        log_scales=rng.uniform(-1.8, -1.0, (n, 3)).astype(np.float32),
        opacity_logits=np.full(n, 2.5, np.float32),
        sh=sh,
    )


@pytest.fixture
def drive(here: Path, splats: Gaussians) -> Path:
    """A transforms file with five pictures of the splats."""
    return drive_of(here, SplatField(splats))


def drive_of(here: Path, field: SplatField) -> Path:
    frames = []
    for number in range(5):
        pose = Pose((number / 5 - 0.4, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        camera = Camera(Intrinsics(*SIZE, 30.0, 30.0, 24.0, 18.0), pose)
        rgb = np.floor(np.clip(field.render_colour(camera), 0, 1) * 255 + 0.5).astype(np.uint8)
        write_png(here / f"{number}.png", rgb)
        matrix = np.diag([1.0, -1.0, -1.0, 1.0])
        matrix[:3, 3] = pose.translation_m
        frames.append({"file_path": f"{number}.png", "transform_matrix": matrix.tolist()})
    file = here / "transforms.json"
    content = {"w": SIZE[0], "h": SIZE[1], "fl_x": 30.0, "frames": frames}
    file.write_text(json.dumps(content))
    return file


def test_an_imported_ply_is_found_by_its_name_and_exported_exactly(here, splats, capsys):
    write_ply(here / "my.ply", splats)
    FieldImport(here / "my.ply", "street", raw=True, antialiased=True).run()
    said = capsys.readouterr().out
    assert re.search(r"out/fields/street\.rff: field [0-9a-f]{64}, 200 splats, 0\.0\d MB", said)
    assert "1280x720" in said
    field = load_field(here / "out/fields/street.rff")
    assert (field.metadata.name, field.metadata.antialiased) == ("street", True)
    FieldExport(Path("street"), here / "back.ply").run()
    back = read_splat_file(here / "back.ply").splats
    a, b = (g.means[np.lexsort(g.means.T)] for g in (splats, back))
    np.testing.assert_array_equal(a, b, "every value survives; the order is of importance")
    FieldExport(Path("street"), here / "tenth.ply", detail=0.1).run()
    np.testing.assert_array_equal(read_splat_file(here / "tenth.ply").splats.sh, back.sh[:20])


def test_a_field_of_nerfstudio_comes_back_to_its_world(here, splats, drive, capsys):
    write_ply(here / "ns.ply", moved(splats, NERFSTUDIO))
    rotation, shift = NERFSTUDIO.rotation, np.array(NERFSTUDIO.pose.translation_m)
    transform = np.column_stack([rotation, shift / NERFSTUDIO.scale]).tolist()
    file = here / "dataparser_transforms.json"
    file.write_text(json.dumps({"transform": transform, "scale": NERFSTUDIO.scale}))
    FieldImport(here / "ns.ply", "plain").run()
    with pytest.raises(InvalidData, match=r"none of \d+ conventions fits.*--transform"):
        FieldCheck(Path("plain"), drive).run()
    FieldCheck(Path("plain"), drive, transform=file, fix=here / "fixed.rff").run()
    assert "fits the field is in nerfstudio's frame" in capsys.readouterr().out
    FieldImport(here / "ns.ply", "street", transform=file).run()
    for name in ("street", "fixed.rff"):
        FieldCheck(Path(name), drive, out=here / "pairs.png").run()
        assert "fits as it is: " in capsys.readouterr().out
    assert read_rgb(here / "pairs.png").shape == (4 * SIZE[1], 2 * SIZE[0], 3)


def test_a_tile_origin_is_taken_off_and_kept(here, splats):
    write_ply(here / "a.ply", splats)
    FieldImport(here / "a.ply", "a", tile_origin=(1.0, 2.0, 3.0), raw=True).run()
    field = load_field(here / "out/fields/a.rff")
    assert field.metadata.tile_origin.up_m == 3.0
    low_m = splats.means.min(axis=0).astype(np.float64) - [1, 2, 3]
    np.testing.assert_allclose(field.bounds.low_m, low_m, atol=1e-6)


def far_ply(path: Path, splats: Gaussians) -> None:
    """Write splats in float64, 5,000 km from zero."""
    write_ply(path, splats)
    table = read_vertices(path, ())
    names = table.dtype.names or ()
    wide = table.astype([(name, "<f8" if name in ("x", "y", "z") else "<f4") for name in names])
    wide["x"] += 500_000.0
    wide["y"] += 5_400_000.0
    write_vertices(path, wide)


def test_a_far_place_is_imported_around_an_origin_which_is_said(here, splats, capsys):
    far_ply(here / "far.ply", splats)
    FieldImport(here / "far.ply", "far", raw=True).run()
    field = load_field(here / "out/fields/far.rff")
    origin = field.metadata.tile_origin
    assert f"tile origin {origin.east_m:.0f} {origin.north_m:.0f} " in capsys.readouterr().out
    assert origin.north_m == pytest.approx(5_400_000, abs=5)
    back = field.gaussians.means[:, 0].astype(float) + origin.east_m - 500_000
    np.testing.assert_allclose(np.sort(back), np.sort(splats.means[:, 0]), atol=1e-6)
    FieldExport(Path("far"), here / "back.ply").run()
    assert f"relative to {origin.east_m:.10g} {origin.north_m:.10g}" in capsys.readouterr().out


@pytest.mark.parametrize(("version", "axes"), [(3, "cannot state"), (4, "as it states")])
def test_an_exported_spz_says_its_axes_and_comes_back(here, splats, capsys, version, axes):
    save_field(SplatField(splats, FieldMetadata(antialiased=True)), here / "a.rff")
    FieldExport(Path("a.rff"), here / "a.spz", spz_version=version).run()
    assert axes in capsys.readouterr().out
    FieldImport(here / "a.spz", "back", raw=True).run()
    back = load_field(field_path("back"))
    assert back.metadata.antialiased
    assert back.metadata.up == (None if version == 3 else (0, 0, 1))
    order, order_back = (np.lexsort(np.round(g.means, 2).T) for g in (splats, back.gaussians))
    np.testing.assert_allclose(back.gaussians.means[order_back], splats.means[order], atol=2.0**-12)


def test_an_exported_glb_is_upright_and_comes_back_as_the_same_field(here, splats, capsys):
    field = SplatField(splats, FieldMetadata(antialiased=True, up=(0.0, -1.0, 0.0)))
    save_field(field, here / "a.rff")
    FieldExport(Path("a.rff"), here / "a.glb").run()
    assert "vertical, -y, is +Y" in capsys.readouterr().out
    FieldImport(here / "a.glb", "back", raw=True).run()
    back = load_field(field_path("back"))
    assert (back.metadata.antialiased, back.metadata.up) == (True, (0.0, -1.0, 0.0))
    assert "drawn antialiased, as the file says" in capsys.readouterr().out
    order, order_back = (np.lexsort(g.means.T) for g in (splats, back.gaussians))
    np.testing.assert_array_equal(back.gaussians.means[order_back], splats.means[order])


def test_an_exported_usd_says_its_axes_and_what_it_cannot_state(here, splats, capsys):
    save_field(SplatField(splats, FieldMetadata(antialiased=True)), here / "a.rff")
    FieldExport(Path("a.rff"), here / "a.usdc").run()
    said = capsys.readouterr().out
    assert "vertical, z, is z" in said
    assert "antialiased, which OpenUSD cannot state" in said


def test_what_is_left_out_of_an_import_is_said(here, splats, capsys):
    write_ply(here / "a.ply", splats)
    data = (here / "a.ply").read_bytes()
    one = splats.opacity_logits[:1].tobytes()
    (here / "a.ply").write_bytes(data.replace(one, np.float32(np.inf).tobytes(), 3))
    FieldImport(here / "a.ply", "a").run()
    assert "3 of 200 splats are fully opaque" in capsys.readouterr().out


def test_an_import_never_overwrites_its_input(here, splats):
    write_ply(here / "a.rff", splats)
    before = (here / "a.rff").read_bytes()
    with pytest.raises(InvalidInput, match="is the file that is read"):
        FieldImport(here / "a.rff", "a", out=here / "a.rff", replace=True).run()
    assert (here / "a.rff").read_bytes() == before


def test_info_says_what_is_known_and_what_a_frame_takes(here, splats, drive, capsys):
    save_field(SplatField(splats), here / "a.rff")
    FieldInfo(here / "a.rff", size="64x48").run()
    said = capsys.readouterr().out
    for expected in ("splats", "not measured", "imported", "64x48", "100 %", "10 %", "raw"):
        assert expected in said
    assert re.search(r"raw; 0\.\d MB when decoded, in \d+ ms here", said)
    assert "dB" not in said
    FieldInfo(here / "a.rff", drive=drive).run()
    assert "dB" in capsys.readouterr().out


def test_a_field_is_slimmed_with_and_without_cameras(here, splats, drive, capsys):
    save_field(SplatField(splats), here / "a.rff")
    FieldSlim(here / "a.rff", here / "b.rff", 50).run()
    FieldSlim(here / "a.rff", here / "c.rff", 50, drive=drive, iterations=5, raw=True).run()
    assert capsys.readouterr().out.count("50 of 200 splats") == 2
    assert load_field(here / "b.rff").primitives == load_field(here / "c.rff").primitives == 50


def test_a_field_is_slimmed_to_a_size_and_to_a_number_of_passes(here, splats, drive, capsys):
    save_field(SplatField(splats), here / "a.rff")
    FieldSlim(here / "a.rff", here / "b.rff", max_mb=0.012, drive=drive, iterations=3).run()
    assert (here / "b.rff").stat().st_size <= 12_000
    FieldSlim(here / "a.rff", here / "c.rff", passes=3, drive=drive, iterations=3).run()
    assert "MB over 3 passes" in capsys.readouterr().out
    assert load_field(here / "c.rff").primitives <= 200


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({}, "give --keep, --max-mb or --passes; or --drive"),
        ({"keep": 50, "passes": 2}, "give either --keep, or"),
        ({"passes": 2}, "go with --drive"),
    ],
)
def test_a_size_has_one_goal_and_cameras(here, splats, given, problem):
    save_field(SplatField(splats), here / "a.rff")
    with pytest.raises(InvalidInput, match=problem):
        FieldSlim(here / "a.rff", here / "b.rff", **given).run()


def test_levels_are_fitted_to_a_drives_cameras(here, splats, drive):
    save_field(SplatField(splats), here / "a.rff")
    FieldSlim(here / "a.rff", here / "b.rff", drive=drive, iterations=5).run()
    field = load_field(here / "b.rff")
    assert isinstance(field, SplatField)
    assert set(field.levels) == {0.5, 0.25, 0.1}


def test_a_field_is_looked_at_around_and_along_a_drive(here, splats, drive, capsys):
    save_field(SplatField(splats), here / "a.rff")
    Render(here / "a.rff", here / "orbit", frames=3, size="32x24", up="-y").run()
    assert sorted(p.name for p in (here / "orbit").iterdir()) == [
        "00000.png",
        "00001.png",
        "00002.png",
    ]
    Render(here / "a.rff", here / "drive", drive=drive, psnr=True, detail=0.5, sh_degree=0).run()
    assert len(re.findall(r"\d\.png  \d+\.\d\d dB", capsys.readouterr().out)) == 5
    Render(here / "a.rff", here / "film" / "a.mp4", path="drive", drive=drive).run()
    assert "5 pictures" in capsys.readouterr().out
    assert (here / "film" / "a.mp4").stat().st_size > 500


@pytest.mark.parametrize(
    ("verb", "error", "named"),
    [
        (FieldImport(Path("none.ply"), "a"), FieldFormatError, r"none\.ply: cannot be read"),
        (FieldImport(Path("a.splat"), "a"), FieldFormatError, r"a\.splat: cannot be read"),
        (FieldImport(Path("empty.ply"), "a"), InvalidInput, "holds no splats"),
        (FieldImport(Path("empty.ply"), "a", out=Path("a.ply")), InvalidInput, r"end in \.rff"),
        (FieldExport(Path("a.rff"), Path("a.txt")), InvalidInput, r"end in \.ply"),
        (FieldExport(Path("a.rff"), Path("b.ply"), detail=0.3), InvalidInput, "none of 1, 0.5"),
        (FieldInfo(Path("nowhere")), InvalidInput, "'nowhere' is no field.*out/fields/nowhere.rff"),
        (Encode(Path("drive"), Path("no"), Path("o.rfv")), InvalidInput, "'no' is no field"),
        (Render(Path("a.rff"), Path("o.gif")), InvalidInput, r"no \.gif file .*\.mp4"),
        (Decode(Path("a.rff"), Path("a.rff"), Path("o.avi")), InvalidInput, "a folder for PNG"),
        (FieldSlim(Path("a.rff"), Path("b.rff"), 9999), InvalidInput, r"outside 1\.\.200"),
        (Render(Path("a.rff"), Path("o"), path="drive"), InvalidInput, "needs --drive"),
        (Render(Path("a.rff"), Path("o"), frames=0), InvalidInput, "frames"),
    ],
)
def test_a_mistake_is_named_and_leaves_nothing_behind(here, splats, verb, error, named):
    save_field(SplatField(splats), here / "a.rff")
    write_ply(here / "empty.ply", Gaussians(*(a[:0] for a in vars(splats).values())))
    with pytest.raises(error, match=named):
        verb.run()
    assert sorted(p.name for p in here.iterdir()) == ["a.rff", "empty.ply"]


def said_by_check(field: str, drive: Path, capsys: pytest.CaptureFixture[str], **more: Path) -> str:
    capsys.readouterr()
    FieldCheck(Path(field), drive, **more).run()
    return capsys.readouterr().out


def faint_drive(here: Path, splats: Gaussians) -> tuple[Path, Gaussians]:
    """Pictures of splats smaller than a pixel, as they look antialiased."""
    tiny = replace(splats, log_scales=splats.log_scales - 2.5)
    field = SplatField(tiny, FieldMetadata(antialiased=True))
    return drive_of(here, field), tiny


def test_how_splats_are_drawn_survives_export_and_import(here, splats, capsys):
    drive, tiny = faint_drive(here, splats)
    save_field(SplatField(tiny, FieldMetadata(antialiased=True)), here / "a.rff")
    FieldExport(Path("a.rff"), here / "a.ply").run()
    assert b"\ncomment SplatRenderMode: mip\n" in (here / "a.ply").read_bytes()
    FieldImport(here / "a.ply", "back", raw=True).run()
    said = said_by_check("back", drive, capsys)
    assert "the field's mode fits" in said
    assert load_field(field_path("back")).metadata.antialiased


def test_a_field_in_the_wrong_mode_is_found_out_and_put_right(here, splats, capsys):
    drive, tiny = faint_drive(here, splats)
    write_ply(here / "a.ply", tiny)
    FieldImport(here / "a.ply", "a", raw=True).run()
    said = said_by_check("a", drive, capsys, fix=here / "fixed.rff")
    assert "it was trained to be drawn antialiased" in said
    assert "fits as it is" in said
    gained = re.search(r"fits as it is: (\S+) dB instead of (\S+) dB", said)
    assert float(gained[1]) > float(gained[2]) + 3
    assert "the field's mode fits" in said_by_check("fixed.rff", drive, capsys)


def test_an_import_does_not_overwrite_a_field_without_being_told(here, splats):
    write_ply(here / "a.ply", splats)
    FieldImport(here / "a.ply", "mine").run()
    before = (here / "out/fields/mine.rff").read_bytes()
    write_ply(here / "b.ply", splats_without_half(splats))
    with pytest.raises(InvalidInput, match=r"out/fields/mine\.rff is there already.*--replace"):
        FieldImport(here / "b.ply", "mine").run()
    assert (here / "out/fields/mine.rff").read_bytes() == before
    FieldImport(here / "b.ply", "mine", replace=True).run()
    assert load_field(here / "out/fields/mine.rff").primitives == 100


def splats_without_half(splats: Gaussians) -> Gaussians:
    return Gaussians(*(np.ascontiguousarray(array[:100]) for array in vars(splats).values()))


def test_a_name_means_the_same_field_to_encode_and_decode(here, splats, drive):
    write_ply(here / "a.ply", splats)
    FieldImport(here / "a.ply", "mine").run()
    Encode(drive, Path("mine"), here / "by-name.rfv").run()
    Encode(drive, here / "out/fields/mine.rff", here / "by-path.rfv").run()
    assert (here / "by-name.rfv").read_bytes() == (here / "by-path.rfv").read_bytes()
    Decode(here / "by-name.rfv", Path("mine"), here / "pictures").run()
    assert len(list((here / "pictures").iterdir())) == 5


def test_a_field_gets_an_anchor_and_keeps_it(tmp_path, capsys, splats):
    street = tmp_path / "street.rff"
    save_field(SplatField(splats).compressed(), street)
    anchored = tmp_path / "anchored.rff"
    FieldAnchor(street, at=(48.137, 11.575, 519.0), out=anchored).run()
    capsys.readouterr()
    FieldInfo(anchored).run()
    assert "48.13700000, 11.57500000 deg, 519.000 m" in capsys.readouterr().out
    again = tmp_path / "again.rff"
    FieldAnchor(anchored, at=(48.0, 11.0, 0.0), out=again).run()
    field, before = load_field(again), load_field(street)
    assert field.metadata.anchor == Anchor(48.0, 11.0)
    assert replace(field.metadata, anchor=None) == before.metadata
    assert field.field_id != before.field_id
