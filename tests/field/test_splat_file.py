"""Splat files are told by their content; what is not read is named with a command that works."""

import gzip
import io
import re
import shlex
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from rfcore.errors import FieldFormatError
from rfcore.field.gltf import encode_glb
from rfcore.field.splat_file import looks_like_splats, read_splat_file
from rfcore.field.splat_ply import write_ply
from rfcore.field.spz import encode_spz
from rfcore.harmonics import SH_DC
from rfcore.image import write_png
from rfcore.raster.gaussians import Gaussians
from tests.field.some import make_gaussians

SPLATS = make_gaussians(30, 1)


def zipped(*names: str, content: bytes = b"") -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name in names:
            archive.writestr(name, content)
    return file.getvalue()


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.splat", "scene", "a.png"])
def test_the_suffix_does_not_matter(tmp_path, name):
    write_ply(tmp_path / "plain.ply", SPLATS)
    contents = [(tmp_path / "plain.ply").read_bytes()]
    contents += [encode_glb(SPLATS, antialiased=True, up=(0.0, 0.0, 1.0))]
    contents += [encode_spz(SPLATS, antialiased=True, version=version) for version in (3, 4)]
    for content in contents:
        (tmp_path / name).write_bytes(content)
        assert len(read_splat_file(tmp_path / name).splats) == 30
        assert looks_like_splats(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a b.splat", bytes(32), r"npx @playcanvas/splat-transform '.*/a b\.splat' '.*/a b\.ply'$"),
        ("a.KSPLAT", bytes(32), r"is of format \.ksplat.* npx @playcanvas/splat-transform"),
        ("a.lcc", b'{"version": "3.0"}', r"is of format \.lcc.*npx .*/a\.lcc \S*/a\.ply$"),
        ("meta.json", b'{"version": 2}', r"npx @playcanvas/splat-transform \S*meta\.json"),
        ("a.sog", zipped("means_l.webp", "meta.json"), r"is a \.sog.* npx .*a\.sog \S*a\.ply$"),
        ("a.zip", zipped("meta.json"), r": cp \S*a\.zip \S*a\.sog && npx .*a\.sog \S*a\.ply"),
        ("a.sogs", zipped("means_l.webp"), r"cp \S*a\.sogs \S*a\.sog && npx"),
        ("a.ply", zipped("point_cloud.ply"), r"is a zip archive; unpack it"),
        ("a.glb", b"glTF" + bytes(20), r"is glTF 0, whose first chunk is 0x0; 2 is read"),
        ("a.gltf", b"{}", r"is no valid glTF: its JSON has no asset"),
        ("a.ply", b"PLY\n", r"no \.ply, \.spz or \.glb by its content: it begins with b'PLY"),
        ("a.spz", b"", r"is empty"),
        ("a.spz", gzip.compress(b"ply\n", mtime=0), r"does not begin with NGSP"),
    ],
)
def test_what_is_not_read_is_named_with_what_converts_it(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FieldFormatError, match=said) as refused:
        read_splat_file(tmp_path / name)
    assert looks_like_splats(tmp_path / name) or b"PLY" in content or not content
    assert "\n" not in str(refused.value)


def test_what_is_no_splats_does_not_look_so(tmp_path):
    write_png(tmp_path / "a.png", np.zeros((4, 4, 3), np.uint8))
    (tmp_path / "transforms.json").write_text("{}")
    assert not any(map(looks_like_splats, (tmp_path, *tmp_path.iterdir())))


def command_of(path: Path) -> str:
    """Return the command that the refusal of a file ends with."""
    with pytest.raises(FieldFormatError) as refused:
        read_splat_file(path)
    found = re.search(r": ((?:cp|npx|python) .*)$", str(refused.value))
    assert found, refused.value
    return found[1]


def test_the_command_for_an_archive_leads_to_what_it_holds(tmp_path):
    write_ply(tmp_path / "plain.ply", SPLATS)
    (tmp_path / "a b.zip").write_bytes(
        zipped("point_cloud.ply", content=(tmp_path / "plain.ply").read_bytes())
    )
    words = shlex.split(command_of(tmp_path / "a b.zip"))
    assert words[0] == "python"
    subprocess.run([sys.executable, *words[1:]], check=True)
    assert len(read_splat_file(tmp_path / "a b" / "point_cloud.ply").splats) == 30


@pytest.fixture(scope="module")
def converter(tmp_path_factory) -> Path:
    """A folder where npx finds splat-transform."""
    folder = tmp_path_factory.mktemp("node")
    install = ["npm", "install", "--no-audit", "--no-fund", "@playcanvas/splat-transform@3.7.0"]
    if shutil.which("npm") is None or subprocess.run(install, cwd=folder, check=False).returncode:
        pytest.skip("needs Node.js and its registry")
    return folder


def run_in(folder: Path, command: str) -> None:
    subprocess.run(command, shell=True, check=True, cwd=folder, stdin=subprocess.DEVNULL)


def write_splat(path: Path, splats: Gaussians) -> None:
    """Write the format of antimatter15: 32 bytes a splat."""
    opacity = 1 / (1 + np.exp(-splats.opacity_logits[:, None]))
    colour = np.concatenate([0.5 + SH_DC * splats.sh[:, 0], opacity], axis=1)
    turns = splats.quaternions / np.linalg.norm(splats.quaternions, axis=1, keepdims=True)
    bytes_ = [np.clip(np.concatenate([colour * 255, turns * 128 + 128], axis=1), 0, 255)]
    floats = np.concatenate([splats.means, np.exp(splats.log_scales)], axis=1)
    rows = [floats.astype("<f4").view(np.uint8), bytes_[0].astype(np.uint8)]
    path.write_bytes(np.concatenate(rows, axis=1).tobytes())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.sog", "a.zip", "meta.json", "a.splat"])
def test_the_command_for_another_format_leads_to_splats(tmp_path, name, converter):
    """Opaque and faint splats are among them, which the converter may write as infinite."""
    splats = make_gaussians(300, 1)
    splats.opacity_logits[:] = np.linspace(-14, 14, 300)
    write_ply(tmp_path / "plain.ply", splats)
    source = tmp_path / "in" / name
    source.parent.mkdir()
    if name == "a.splat":
        write_splat(source, splats)
    else:
        made = source.with_suffix(".sog") if name == "a.zip" else source
        words = " ".join(shlex.quote(str(path)) for path in (tmp_path / "plain.ply", made))
        run_in(converter, f"npx splat-transform -g cpu {words}")
        made.replace(source)
    run_in(converter, command_of(source))
    read = read_splat_file(source.with_suffix(".ply"))
    assert len(read.splats) == 300
