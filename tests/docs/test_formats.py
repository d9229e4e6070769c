"""The table of formats (docs/reference/formats.md): every row is tried, and the page has them all.

``EXPORTS`` are files that a program wrote (``tests/field/exports``), ``layout`` is written here in
the order and with the comments of a program. To renew the page, print ``table()``.
"""

import base64
import gzip
import json
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from docs.pages import Page
from rfcore.dataset import read_dataset
from rfcore.errors import DatasetError, FieldFormatError
from rfcore.field.gltf import encode_glb
from rfcore.field.ply_table import read_vertices, write_vertices
from rfcore.field.splat_ply import write_ply
from rfcore.field.spz import COORDINATE_SYSTEM, encode_spz
from rfcore.raster.gaussians import Gaussians
from rfedge.fields.confined_reader import read_confined
from tests.dataset.conftest import GoldenScene
from tests.dataset.public_sets import (
    write_argoverse,
    write_boreas,
    write_comma,
    write_nuscenes,
)
from tests.dataset.test_public_sets import LOG_123D
from tests.field.exports.make_exports import source_splats
from tests.field.some import as_text, compressed_ply

EXPORTS = Path(__file__).parents[1] / "field" / "exports"
SOURCE = source_splats()
MAX_BYTES = 1 << 28
UTM_M = (500_000.0, 5_400_000.0, 300.0)
REST = tuple(f"f_rest_{i}" for i in range(45))
DC, SCALE, ROT = (
    tuple(f"{name}_{i}" for i in range(n)) for name, n in (("f_dc", 3), ("scale", 3), ("rot", 4))
)
XYZ, NORMALS = ("x", "y", "z"), ("nx", "ny", "nz")
BRUSH = (*XYZ, *SCALE, "opacity", *ROT, *DC, *REST)
SUPERSPLAT = (*XYZ, *DC, "opacity", *ROT, *SCALE, *REST)
INRIA = (*XYZ, *NORMALS, *DC, *REST, "opacity", *SCALE, *ROT)


@dataclass(frozen=True)
class Row:
    """One line of the table; ``make`` writes the file into a folder, or names one."""

    format: str
    producer: str
    becomes: str
    make: Callable[[Path], Path]
    said: str = ""
    """Pattern of what reading says, or of the refusal."""
    loss: float = 1e-5
    """Largest error of a mean, of a log scale and of colours."""
    turned: bool = False
    """Whether the file holds the splats half round x."""
    palette: bool = False
    """Whether higher bands of the colours come from a palette, as in .sog."""
    shape: tuple[int, ...] = (48, 64, 3)
    """Shape of a dataset's pictures."""

    @property
    def is_refused(self) -> bool:
        """Whether the file is not read."""
        return self.becomes.startswith("refused")


def export(name: str) -> Callable[[Path], Path]:
    return lambda _: EXPORTS / name


def layout(names: tuple[str, ...], *comments: str) -> Callable[[Path], Path]:
    """Write the splats with these properties, in their order."""

    def make(folder: Path) -> Path:
        write_ply(folder / "plain.ply", SOURCE)
        table = read_vertices(folder / "plain.ply", ())
        other = np.zeros(len(table), [(name, "<f4") for name in names])
        for name in names:
            other[name] = table[name]
        write_vertices(folder / "a.ply", other, comments)
        return folder / "a.ply"

    return make


def content(of: Callable[[Path], bytes], name: str = "a") -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(of(folder))
        return folder / name

    return make


def half_turned(splats: Gaussians) -> Gaussians:
    """Splats turned half round x, written out for degree 0 and 1 and, by parity, 2 and 3."""
    y, z = np.float32(-1), np.float32(-1)
    signs = [1, y, z, 1, y, y * z, 1, z, 1, y, y * z, y, z, 1, z, 1]
    return Gaussians(
        splats.means * np.float32([1, -1, -1]),
        splats.quaternions * np.float32([1, 1, -1, -1]),
        splats.log_scales,
        splats.opacity_logits,
        splats.sh * np.float32(signs)[:, None],
    )


def lichtfeld(_: Path) -> bytes:
    """Version 4 in RUB, which it states, and a record of its own."""
    plain = encode_spz(half_turned(SOURCE), antialiased=False, version=4)
    block = struct.pack("<III", COORDINATE_SYSTEM, 4, 4) + struct.pack("<II", 1 << 24, 2) + b"{}"
    return plain[:16] + struct.pack("<I12x", 32 + len(block)) + block + plain[44:]


def degree_4(folder: Path) -> Path:
    layout(INRIA)(folder)
    table = read_vertices(folder / "a.ply", ())
    wide = np.zeros(
        len(table), [(n, "<f4") for n in (*INRIA, *(f"f_rest_{i}" for i in range(45, 72)))]
    )
    for name in (*XYZ, *DC, "opacity", *SCALE, *ROT):
        wide[name] = table[name]
    for channel in range(3):
        for i in range(15):
            wide[f"f_rest_{24 * channel + i}"] = table[f"f_rest_{15 * channel + i}"]
    write_vertices(folder / "b.ply", wide)
    return folder / "b.ply"


def far(folder: Path) -> Path:
    layout(INRIA)(folder)
    table = read_vertices(folder / "a.ply", ())
    wide = table.astype([(n, "<f8" if n in XYZ else "<f4") for n in table.dtype.names or ()])
    for axis, value in zip(XYZ, UTM_M, strict=True):
        wide[axis] += value
    write_vertices(folder / "b.ply", wide)
    return folder / "b.ply"


def spz(version: int) -> Callable[[Path], bytes]:
    def of(_: Path) -> bytes:
        if version > 2:
            return encode_spz(SOURCE, antialiased=True, version=4 if version == 4 else 3)
        n, plain = len(SOURCE), gzip.decompress(encode_spz(SOURCE, antialiased=True))
        turns = SOURCE.quaternions / np.linalg.norm(SOURCE.quaternions, axis=1, keepdims=True)
        turns *= np.where(turns[:, :1] < 0, -1, 1)
        xyz = np.round((turns[:, 1:] + 1) * 127.5).astype(np.uint8).tobytes()
        means = plain[16 : 16 + 9 * n] if version == 2 else SOURCE.means.astype("<f2").tobytes()
        head = plain[:4] + struct.pack("<I", version) + plain[8:16]
        return gzip.compress(
            head + means + plain[16 + 9 * n : 16 + 16 * n] + xyz + plain[16 + 20 * n :]
        )

    return of


def text(folder: Path) -> bytes:
    return as_text(layout(INRIA)(folder))


def gltf(_: Path) -> bytes:
    """Text, with the binary part as a data URI."""
    glb = encode_glb(SOURCE, antialiased=True, up=(0.0, 0.0, 1.0))
    size = struct.unpack_from("<I", glb, 12)[0]
    root = json.loads(glb[20 : 20 + size])
    data = base64.b64encode(glb[28 + size :]).decode()
    root["buffers"][0]["uri"] = f"data:application/gltf-buffer;base64,{data}"
    return json.dumps(root).encode()


CONVERTED = "refused, with the command of splat-transform"
UNSTATED = "axes: the file states none"
SPLATS = [
    Row(".ply", "INRIA 3DGS, nerfstudio, OpenSplat", "read", layout(INRIA)),
    Row(
        ".ply",
        "Brush 3252892",
        "read",
        layout(BRUSH, "Exported from Brush", "SplatRenderMode: mip"),
    ),
    Row(".ply", "SuperSplat", "read", layout(SUPERSPLAT)),
    Row(".ply", "gsplat 1.5.3 (its file)", "read", export("gsplat-1.5.3.ply")),
    Row(".ply as text", "any", "read", content(text)),
    Row(
        ".ply, SH degree 4",
        "any",
        "read; the fourth band is left out",
        degree_4,
        "reduced to degree 3",
    ),
    Row(
        ".ply, float64 in UTM",
        "any",
        "read; the median becomes the origin",
        far,
        "tile origin 500000",
    ),
    Row(
        "compressed .ply",
        "gsplat 1.5.3 (its file)",
        "read",
        export("gsplat-1.5.3.compressed.ply"),
        loss=0.05,
    ),
    Row(
        "compressed .ply",
        "splat-transform 3.7.0 (its file)",
        "read",
        export("splat-transform-3.7.0.compressed.ply"),
        loss=0.05,
    ),
    Row(
        "compressed .ply",
        "SuperSplat",
        "read",
        content(lambda _: compressed_ply(SOURCE)),
        loss=0.05,
    ),
    Row(
        ".sog through splat-transform",
        "splat-transform 3.7.0 (its file)",
        "read",
        export("splat-transform-3.7.0.sog.ply"),
        loss=0.05,
        palette=True,
    ),
    Row(
        ".spz 4",
        "splat-transform 3.7.0 (its file)",
        "read and written; states no axes: those of a .ply",
        export("splat-transform-3.7.0.spz"),
        UNSTATED,
        0.08,
    ),
    Row(
        ".spz 3",
        "splat-transform 3.7.0 (its file)",
        "read and written; as above",
        export("splat-transform-3.7.0.v3.spz"),
        UNSTATED,
        0.08,
    ),
    Row(
        ".spz 4",
        "splat-transform 2.7.1 (its file)",
        "read, half round x: `rfedge field check --fix` turns it",
        export("splat-transform-2.7.1.spz"),
        UNSTATED,
        0.08,
        turned=True,
    ),
    Row(
        ".spz 4",
        "LichtFeld Studio 1390566",
        "read; its axes are obeyed, its own record is left out",
        content(lichtfeld),
        "axes: RUB, as the file states",
        0.08,
    ),
    Row(".spz 4", "rfedge", "read and written; axes stated", content(spz(4)), "axes: RDF", 0.08),
    Row(".spz 3", "rfedge, Niantic spz", "read and written", content(spz(3)), UNSTATED, 0.08),
    Row(".spz 2", "Niantic spz, spz-js 1.2.5", "read", content(spz(2)), UNSTATED, 0.08),
    Row(".spz 1", "Niantic spz", "read", content(spz(1)), UNSTATED, 0.08),
    Row(
        ".splat, .ksplat, .lcc",
        "antimatter15, mkkellogg, XGRIDS",
        CONVERTED,
        content(lambda _: bytes(32), "a.splat"),
        "npx @playcanvas/splat-transform",
    ),
    Row(
        ".sog, meta.json",
        "PlayCanvas",
        CONVERTED,
        content(lambda _: b"{}", "meta.json"),
        "npx @playcanvas/splat-transform",
    ),
    Row(
        ".ply.gz",
        "any",
        "refused, with the command that unpacks it",
        content(lambda folder: gzip.compress(layout(INRIA)(folder).read_bytes()), "a.ply.gz"),
        "gunzip -c",
    ),
    Row(
        ".zip",
        "any",
        "refused, with the command that unpacks it",
        content(lambda _: b"PK\x03\x04" + bytes(26) + b"scene.ply"),
        "python -m zipfile",
    ),
    Row(
        ".glb (KHR_gaussian_splatting)",
        "splat-transform 2.7.1 (its file)",
        "read; +Y up is turned to the axes of a .ply",
        export("splat-transform-2.7.1.glb"),
        "half round z",
    ),
    Row(
        ".glb (KHR_gaussian_splatting)",
        "rfedge",
        "read and written; +Y up, turned back",
        content(lambda _: encode_glb(SOURCE, antialiased=True, up=(0.0, 0.0, 1.0))),
        "turned back",
    ),
    Row(
        ".gltf (KHR_gaussian_splatting)",
        "any",
        "read, if its buffers are data URIs",
        content(gltf, "a.gltf"),
        "turned back",
    ),
    Row(
        ".glb, other kernels, linear colours, SPZ or meshopt inside",
        "any",
        "refused",
        content(
            lambda _: encode_glb(SOURCE, antialiased=True, up=(0.0, 0.0, 1.0)).replace(
                b'"srgb_', b'"lin__'
            )
        ),
        "colorSpace is 'lin__rec709_display'",
    ),
    Row(
        ".ply, 2D Gaussians",
        "2DGS",
        "refused",
        layout(tuple(n for n in INRIA if n != "scale_2")),
        "discs of 2D",
    ),
    Row(
        ".ply, filter_3D",
        "Mip-Splatting",
        "refused: fuse it with its create_fused_ply.py",
        content(lambda f: layout(INRIA)(f).read_bytes().replace(b" nx", b" filter_3D", 1)),
        "create_fused_ply",
    ),
]


@pytest.mark.parametrize("row", SPLATS, ids=lambda row: f"{row.format} of {row.producer}")
def test_splats_come_in_as_the_table_says(row, tmp_path):
    path = row.make(tmp_path)
    if row.is_refused:
        with pytest.raises(FieldFormatError, match=row.said):
            read_confined(path, None, MAX_BYTES)
        return
    read, _ = read_confined(path, None, MAX_BYTES)
    assert re.search(row.said, "\n".join(read.notes))
    origin = read.tile_origin
    want = half_turned(SOURCE) if row.turned else SOURCE
    means = read.splats.means.astype(float)
    if origin.east_m:
        means += np.subtract((origin.east_m, origin.north_m, origin.up_m), UTM_M)
    apart = np.linalg.norm(want.means[None] - means[:, None], axis=2)
    which = apart.argmin(axis=1)
    assert len(set(which)) == len(which) >= len(SOURCE) - 5, "gsplat leaves out the faintest"
    assert apart.min(axis=1).max() < max(row.loss, 1e-3)
    assert np.abs(read.splats.log_scales - want.log_scales[which]).max() < max(row.loss, 1e-5)
    compared = 1 if row.palette else read.splats.sh.shape[1]
    error = read.splats.sh[:, :compared] - want.sh[which, :compared]
    assert np.abs(error).max() < row.loss


READ = "read, undistorted", "3 of 3 pictures are undistorted"
UNREAD = "refused, with the command of COLMAP's image_undistorter", "colmap image_undistorter"
LENSES = [
    ("PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV", "OPENCV", [0.01, 0, 0, 0], READ),
    ("OPENCV_FISHEYE, RADIAL_FISHEYE, FISHEYE, SIMPLE ones", "RADIAL_FISHEYE", [0.01, 0], READ),
    ("FULL_OPENCV", "FULL_OPENCV", [0.01, 0, 0, 0, 0.001, 0.1, 0, 0], READ),
    ("THIN_PRISM_FISHEYE, FOV, EUCM, DIVISION, others", "FOV", [0.4], UNREAD),
]


def scene(form: str) -> Callable[[Path], Path]:
    return lambda folder: GoldenScene().write(form, folder)


def colmap(model: str, lens: list[float]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        root = scene("colmap_binary")(folder)
        plain = pycolmap.Camera.create_from_model_name(1, model, 50.0, 64, 48)
        plain.params = [*plain.params[: len(plain.params) - len(lens)], *lens]
        body = struct.pack("<QIiQQ", 1, 7, int(plain.model), 64, 48)
        model_file = root / "sparse" / "0" / "cameras.bin"
        model_file.write_bytes(body + np.array(plain.params, "<f8").tobytes())
        return root

    return make


DATASETS = [
    Row(
        "transforms.json",
        "nerfstudio, instant-ngp, Blender add-ons",
        "read and written",
        scene("transforms"),
    ),
    Row("COLMAP, text", "COLMAP 4.2, RealityScan, Metashape", "read", scene("colmap_text")),
    Row("COLMAP, binary", "COLMAP 4.2, GLOMAP", "read", scene("colmap_binary")),
    *(
        Row(f"lens {name}", "COLMAP 4.2", becomes, colmap(model, lens), said)
        for name, model, lens, (becomes, said) in LENSES
    ),
    Row("KITTI odometry", "KITTI", "read", scene("kitti")),
    Row("cameras.json", "INRIA 3DGS", "read", scene("inria")),
    Row("camera.toml", "your own", "read", scene("folder")),
    Row(
        "Argoverse 2, a log",
        "its layout; av2 0.3.6 projects the same",
        "read, a camera by `LOG#CAMERA`",
        lambda folder: Path(f"{write_argoverse(GoldenScene(), folder)}#ring_front_center"),
        "k1 to k3 are left out",
    ),
    Row(
        "nuScenes",
        "its layout; nuscenes-devkit 1.2.0 projects the same",
        "read, a camera by `FOLDER#SCENE/CAMERA`",
        lambda folder: Path(f"{write_nuscenes(GoldenScene(), folder)}#scene-0061/CAM_FRONT"),
        "world: nuScenes' global map",
    ),
    Row(
        "123D, a log",
        "py123d 0.7.0 (its file)",
        "read, pinholes, a camera by `LOG#CAMERA`",
        lambda _: Path(f"{LOG_123D}#pcam_b0"),
        "3 of 3 pictures are undistorted",
    ),
    Row(
        "comma2k19, a segment",
        "its layout; its own code projects the same",
        "read, with the fixes of its GNSS",
        lambda folder: write_comma(GoldenScene(), folder),
        "world: ECEF",
        shape=(874, 1164, 3),
    ),
    Row(
        "Boreas, Boreas-RT, a drive",
        "its layout; pyboreas projects the same",
        "read",
        lambda folder: write_boreas(GoldenScene(), folder),
        "one for all drives of a route",
    ),
]


@pytest.mark.parametrize("row", DATASETS, ids=lambda row: row.format)
def test_datasets_come_in_as_the_table_says(row, tmp_path):
    path = row.make(tmp_path)
    if row.is_refused:
        with pytest.raises(DatasetError, match=row.said):
            read_dataset(path, distortion="undistort")
        return
    dataset = read_dataset(path, distortion="undistort")
    assert len(dataset.pictures) == 3
    assert re.search(row.said, "\n".join(dataset.changes))
    assert dataset.pictures[0].read().shape == row.shape


def table() -> str:
    """Return the rows as Markdown."""
    head = "| format | written by | here |\n|---|---|---|\n"
    return head + "".join(
        f"| {r.format} | {r.producer} | {r.becomes} |\n" for r in SPLATS + DATASETS
    )


def test_the_page_has_every_row():
    assert table() in Page("reference/formats.md").text
