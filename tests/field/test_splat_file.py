"""Splat files are told by their content; what is not read is named with a command that works."""

import gzip
import io
import json
import re
import shlex
import shutil
import struct
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
        (
            "a.lcc",
            b'{"version": "3.0"}',
            r"is of format \.lcc.*npx .*@3 --select-lod 0 \S*/a\.lcc \S*/a\.ply$",
        ),
        ("meta.json", b'{"version": 2}', r"npx @playcanvas/splat-transform \S*meta\.json"),
        ("a.sog", zipped("means_l.webp", "meta.json"), r"is a \.sog.* npx .*a\.sog \S*a\.ply$"),
        ("a.zip", zipped("meta.json"), r": cp \S*a\.zip \S*a\.sog && npx .*a\.sog \S*a\.ply"),
        ("a.sogs", zipped("means_l.webp"), r"cp \S*a\.sogs \S*a\.sog && npx"),
        ("a.ply", zipped("point_cloud.ply"), r"is a zip archive; unpack it"),
        ("a.glb", b"glTF" + bytes(20), r"is glTF 0, whose first chunk is 0x0; 2 is read"),
        ("a.gltf", b"{}", r"is no valid glTF: its JSON has no asset"),
        ("a.ply", b"PLY\n", r"no \.ply, \.spz or \.glb by its content: it begins with b'PLY"),
        ("a.spz", b"", r"is empty"),
        ("a.spz", gzip.compress(b"PLY\n", mtime=0), r"does not begin with NGSP"),
        (
            "a.spz",
            gzip.compress(b"ply\n", mtime=0),
            r"gzip packed.* gunzip -c \S*a\.spz > \S*a\.spz\.ply$",
        ),
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
    found = re.search(r": ((?:cp|npx|python|gunzip) .*)$", str(refused.value))
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


@pytest.mark.parametrize("name", ["a b.ply.gz", "a.PLY.GZ", "a.ply"])
def test_the_command_for_a_packed_ply_leads_to_it(tmp_path, name):
    write_ply(tmp_path / "plain", SPLATS)
    content = (tmp_path / "plain").read_bytes()
    with gzip.open(tmp_path / name, "wb") as packed:
        packed.write(content)
    command = command_of(tmp_path / name)
    subprocess.run(command, shell=True, check=True)
    (target,) = shlex.split(command)[-1:]
    assert Path(target) != tmp_path / name
    assert Path(target).read_bytes() == content


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


def write_ksplat(path: Path, splats: Gaussians) -> None:
    """Write the format of mkkellogg: one section of one bucket, uncompressed, of degree 0."""
    n, row = len(splats), 44
    opacity = 1 / (1 + np.exp(-splats.opacity_logits[:, None]))
    colour = np.concatenate([0.5 + SH_DC * splats.sh[:, 0], opacity], axis=1)
    turns = splats.quaternions / np.linalg.norm(splats.quaternions, axis=1, keepdims=True)
    floats = np.concatenate([splats.means, np.exp(splats.log_scales), turns], axis=1)
    bytes_ = np.clip(colour * 255, 0, 255).astype(np.uint8)
    rows = np.concatenate([floats.astype("<f4").view(np.uint8), bytes_], axis=1)
    head = struct.pack("<4B4I", 0, 1, 0, 0, 1, 1, n, n).ljust(4096, b"\0")
    section = struct.pack("<4IfH2xI2I", n, n, 0, 0, 5.0, 0, 0, n * row, 0).ljust(1024, b"\0")
    path.write_bytes(head + section + rows.tobytes())


def write_lcc(path: Path, splats: Gaussians) -> None:
    """Write the format of XGRIDS, without higher bands: a level of all, a coarser one of a tenth.

    z is up there, and the axes of a .ply are x, -z, y.
    """
    n, few, low, high = len(splats), len(splats) // 10, 1e-4, 10.0
    opacity = 1 / (1 + np.exp(-splats.opacity_logits[:, None]))
    colour = np.concatenate([0.5 + SH_DC * splats.sh[:, 0], opacity], axis=1)
    scales = (np.exp(splats.log_scales) - low) / (high - low)
    rows = np.zeros(n, [("xyz", "<f4", 3), ("rgba", "u1", 4), ("scale", "<u2", 3), ("rest", "V10")])
    rows["xyz"] = splats.means[:, (0, 2, 1)] * (1, 1, -1)
    rows["rgba"] = np.clip(colour * 255, 0, 255)
    rows["scale"] = np.clip(scales * 65535, 0, 65535)
    upright = 512 | 512 << 10 | 512 << 20 | 3 << 30
    rows["rest"] = upright.to_bytes(4, "little") + bytes(6)
    levels = struct.pack("<2h", 0, 0)
    levels += struct.pack("<iqiiqi", n, 0, 32 * n, few, 32 * n, 32 * few)
    (path.parent / "index.bin").write_bytes(levels)
    (path.parent / "data.bin").write_bytes(rows.tobytes() + rows[:few].tobytes())
    bounds = {"scale": (low, high), "shcoef": (-1, 1)}
    attributes = [{"name": k, "min": [a] * 3, "max": [b] * 3} for k, (a, b) in bounds.items()]
    meta = {"fileType": "Portable", "totalLevel": 2, "splats": [n, few], "attributes": attributes}
    path.write_text(json.dumps(meta))


WRITERS = {"a.splat": write_splat, "a.ksplat": write_ksplat, "meta.lcc": write_lcc}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.sog", "a.zip", "meta.json", *WRITERS])
def test_the_command_for_another_format_leads_to_splats(tmp_path, name, converter):
    """Opaque and faint splats are among them, which the converter may write as infinite."""
    splats = make_gaussians(300, 1)
    splats.opacity_logits[:] = np.linspace(-14, 14, 300)
    write_ply(tmp_path / "plain.ply", splats)
    source = tmp_path / "in" / name
    source.parent.mkdir()
    if name in WRITERS:
        WRITERS[name](source, splats)
    else:
        made = source.with_suffix(".sog") if name == "a.zip" else source
        words = " ".join(shlex.quote(str(path)) for path in (tmp_path / "plain.ply", made))
        run_in(converter, f"npx splat-transform -g cpu {words}")
        made.replace(source)
    run_in(converter, command_of(source))
    read = read_splat_file(source.with_suffix(".ply"))
    assert len(read.splats) == 300
    apart = np.linalg.norm(read.splats.means[:, None] - splats.means[None], axis=2)
    assert apart.min(axis=1).max() < 0.02
