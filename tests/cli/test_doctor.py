"""``rfedge doctor`` says what a thing is, what is understood and left out, and what is next."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from rfcore.errors import DatasetError, FieldFormatError, InvalidData
from rfcore.field import SplatField, save_field, write_ply
from rfcore.field.spz import write_spz
from rfcore.image import write_png
from rfedge.cli import parse
from rfedge.video import write_mp4
from tests.dataset.conftest import GoldenScene
from tests.field.some import make_gaussians


def told(path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    parse(["doctor", str(path)]).run()
    return capsys.readouterr().out


def test_splats_are_told_with_what_would_be_left_out_and_the_next_command_works(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    splats = make_gaussians(20, 1)
    splats.opacity_logits[:] = 1
    write_ply(tmp_path / "my scene.ply", splats, antialiased=True)
    content = (tmp_path / "my scene.ply").read_bytes()
    bad = np.float32(splats.means[4, 0]).tobytes()
    (tmp_path / "my scene.ply").write_bytes(content.replace(bad, np.float32(np.nan).tobytes(), 1))
    said = told(tmp_path / "my scene.ply", capsys)
    assert "19 splats of SH degree 1; antialiased: yes" in said
    assert "1 of 20 splats are not finite" in said
    words = shlex.split(re.search(r"^next: rfedge (.*)$", said, re.MULTILINE)[1])
    parse(words).run()
    assert (tmp_path / "out" / "fields" / "my scene.rff").exists()
    said = told(tmp_path / "out" / "fields" / "my scene.rff", capsys)
    assert "a field" in said
    assert "next: rfedge field info" in said


def test_axes_of_an_spz_are_told(tmp_path, capsys):
    for version, said in ((3, "the file states none"), (4, "RDF, as the file states")):
        write_spz(tmp_path / "a.spz", make_gaussians(5, 0), antialiased=False, version=version)
        assert f"axes: {said}" in told(tmp_path / "a.spz", capsys)


def test_an_up_that_is_not_stated_is_told_and_its_remedy_states_it(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_ply(tmp_path / "a.ply", make_gaussians(5, 0))
    said = told(tmp_path / "a.ply", capsys)
    words = re.search(r"^up is taken to be z: .*\(--up y or (--up -y) at import\)$", said, re.M)[1]
    parse(["field", "import", "a.ply", "--name", "a", *words.split()]).run()
    assert "up: -y, as --up states" in capsys.readouterr().out
    assert "-y, as stated at its import" in told(tmp_path / "out/fields/a.rff", capsys)
    for name in ("b.ply", "b.spz"):
        parse(["field", "export", "a", "--out", name]).run()
        assert "up, -y," in capsys.readouterr().out
        assert "up: -y, as the file states" in told(tmp_path / name, capsys)


@pytest.mark.parametrize("form", ["transforms", "colmap_binary", "kitti"])
def test_a_dataset_is_told_with_its_cameras(tmp_path, capsys, form):
    path = GoldenScene().write(form, tmp_path)
    said = told(path, capsys)
    assert "a dataset of 3 pictures" in said
    assert "3 of 64x48 px: PINHOLE 50 52 32 24" in said
    assert f"next: rfedge train {path}" in said


def test_what_is_next_for_a_lens_is_to_take_it_out(tmp_path, capsys):
    path = GoldenScene().write("transforms", tmp_path)
    file = next(tmp_path.rglob("transforms.json"))
    file.write_text(file.read_text().replace('"frames"', '"k1": 0.01, "frames"', 1))
    said = told(path, capsys)
    assert "3 of 3 pictures are undistorted" in said
    words = shlex.split(re.search(r"^next: rfedge (.*) \(", said, re.MULTILINE)[1])
    parse([*words[:-1], str(tmp_path / "plain")]).run()
    assert "PINHOLE" in told(tmp_path / "plain", capsys)


def test_large_pictures_are_made_smaller_by_the_next_command(tmp_path, capsys):
    """A portrait picture's longest side is its height."""
    write_png(tmp_path / "a.png", np.zeros((1700, 200, 3), np.uint8))
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    content = {"w": 200, "h": 1700, "fl_x": 900, "fl_y": 900, "cx": 100, "cy": 850, "k1": 0.001}
    (tmp_path / "transforms.json").write_text(json.dumps(content | {"frames": [frame]}))
    said = told(tmp_path, capsys)
    words = shlex.split(re.search(r"^next: rfedge (.*) \(without", said, re.MULTILINE)[1])
    parse([str(tmp_path / "out") if word == "DATASET" else word for word in words]).run()
    height_px = int(re.search(r"^1 of \d+x(\d+) px", told(tmp_path / "out", capsys), re.M)[1])
    assert 1200 < height_px <= 1280


def test_what_cannot_be_read_is_an_error_with_what_to_do(tmp_path):
    (tmp_path / "pictures").mkdir()
    write_png(tmp_path / "pictures" / "a.png", np.zeros((4, 4, 3), np.uint8))
    (tmp_path / "scene.sog").write_bytes(b"PK\x03\x04" + bytes(26) + b"means_l.webp")
    (tmp_path / "points.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    write_mp4(tmp_path / "video.mp4", [np.zeros((16, 16, 3), np.uint8)] * 2, 10.0)
    for name, error, said in (
        ("pictures", DatasetError, "rfedge dataset poses"),
        ("scene.sog", FieldFormatError, "npx @playcanvas/splat-transform"),
        ("video.mp4", DatasetError, "rfedge dataset poses"),
        (".", DatasetError, r"it holds 1 splat files: rfedge doctor \S*scene\.sog"),
        ("none", InvalidData, "^there is no"),
    ):
        with pytest.raises(error, match=said):
            parse(["doctor", str(tmp_path / name)]).run()


def test_nothing_is_written(tmp_path, capsys):
    save_field(SplatField(make_gaussians(5, 0)), tmp_path / "a.rff")
    told(tmp_path / "a.rff", capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["a.rff"]
