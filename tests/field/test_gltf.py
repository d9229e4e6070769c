"""Splats as glTF with KHR_gaussian_splatting: there and back, transforms of nodes, refusals."""

import base64
import io
import json
import struct
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rfcore.camera import Pose
from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.field.gltf import EXTENSION, encode_glb, read_open_gltf
from rfcore.field.similarity import Similarity, moved
from rfcore.field.splat_file import read_splat_file
from rfcore.field.stored_splats import ImportedSplats
from rfcore.raster.gaussians import Gaussians
from tests.field.some import make_gaussians

MAX_BYTES = 1 << 24
Y_UP = (0.0, 1.0, 0.0)
PLY_FROM_GLTF = Similarity(Pose((0, 0, 0), (0.0, 0.0, 0.0, 1.0)))
BYTES = {"i1": 5120, "u1": 5121, "<i2": 5122, "<u2": 5123}


def parts(glb: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary part of a .glb."""
    size = struct.unpack_from("<I", glb, 12)[0]
    return json.loads(glb[20 : 20 + size]), glb[28 + size :]


def joined(root: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(root).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    return (
        head
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(binary), b"BIN\0")
        + binary
    )


def plain(splats: Gaussians) -> tuple[dict[str, Any], bytes]:
    """The parts of a file of another program: splats in glTF's axes, nothing said of ours."""
    root, binary = parts(encode_glb(splats, antialiased=False, up=Y_UP))
    del root["nodes"][0]["extras"]
    return root, binary


def read(tmp_path: Path, content: bytes, name: str = "a.glb") -> ImportedSplats:
    (tmp_path / name).write_bytes(content)
    return read_splat_file(tmp_path / name)


def assert_same(found: Gaussians, wanted: Gaussians, loss: float = 1e-5) -> None:
    for name in ("means", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(wanted, name), atol=loss, err_msg=name
        )
    ours, theirs = (
        each.quaternions / np.linalg.norm(each.quaternions, axis=1, keepdims=True)
        for each in (found, wanted)
    )
    np.testing.assert_allclose(np.abs((ours * theirs).sum(axis=1)), 1, atol=loss)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), Y_UP, (0.6, 0.0, 0.8)])
@pytest.mark.parametrize("degree", range(4))
def test_what_is_written_comes_back_upright(tmp_path, up, degree):
    splats = make_gaussians(40, degree)
    content = encode_glb(splats, antialiased=True, up=up)
    back = read(tmp_path, content)
    assert_same(back.splats, splats)
    assert (back.antialiased, back.up) == (True, pytest.approx(up))
    heights = np.frombuffer(parts(content)[1], "<f4", 120).reshape(40, 3)[:, 1]
    np.testing.assert_allclose(heights, splats.means @ np.float32(up), atol=1e-5)


def test_a_file_that_says_nothing_of_our_axes_is_turned_to_those_of_a_ply(tmp_path):
    splats = make_gaussians(20, 3)
    back = read(tmp_path, joined(*plain(splats)))
    assert_same(back.splats, moved(splats, PLY_FROM_GLTF))
    assert (back.up, back.antialiased) == ((0, -1, 0), None)
    assert "half round z" in back.notes[0]


def test_transforms_of_nodes_are_obeyed(tmp_path):
    """The node under a parent: as a matrix, and as translation, rotation and scale."""
    splats, (root, binary) = make_gaussians(20, 3), plain(make_gaussians(20, 3))
    child = Similarity(Pose((1.0, 2.0, 3.0), (0.5, 0.5, -0.5, 0.5)), 2.0)
    parent = Similarity(Pose((0.0, -1.0, 0.5), (0.8, 0.0, 0.6, 0.0)), 0.25)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = child.scale * child.rotation, child.pose.translation_m
    w, *xyz = parent.pose.rotation
    root["nodes"] = [
        {"mesh": 0, "matrix": matrix.T.ravel().tolist()},
        {
            "children": [0],
            "translation": parent.pose.translation_m,
            "rotation": [*xyz, w],
            "scale": [0.25] * 3,
        },
    ]
    root["scenes"] = [{"nodes": [1]}]
    wanted = moved(splats, PLY_FROM_GLTF.compose(parent.compose(child)))
    assert_same(read(tmp_path, joined(root, binary)).splats, wanted)


def test_primitives_are_joined_and_other_meshes_left_out(tmp_path):
    low, high = make_gaussians(5, 0), make_gaussians(7, 2, seed=1)
    (root, binary), (other, more) = plain(low), plain(high)
    first, views = len(root["accessors"]), len(root["bufferViews"])
    for view in other["bufferViews"]:
        root["bufferViews"].append({**view, "byteOffset": view["byteOffset"] + len(binary)})
    for accessor in other["accessors"]:
        root["accessors"].append({**accessor, "bufferView": accessor["bufferView"] + views})
    primitive = other["meshes"][0]["primitives"][0]
    for name in primitive["attributes"]:
        primitive["attributes"][name] += first
    triangles = {"attributes": {"POSITION": 0}, "mode": 4}
    root["meshes"][0]["primitives"] += [primitive, triangles]
    root["buffers"][0]["byteLength"] = len(binary + more)
    back = read(tmp_path, joined(root, binary + more))
    assert len(back.splats) == 12
    assert back.splats.sh_degree == 2
    assert not back.splats.sh[:5, 1:].any()
    wanted = moved(high, PLY_FROM_GLTF)
    np.testing.assert_allclose(back.splats.sh[5:], wanted.sh, atol=1e-5)
    assert "1 other primitives" in back.notes[2]


@pytest.mark.parametrize(
    ("name", "kind"),
    [("ROTATION", "i1"), ("ROTATION", "<i2"), ("SCALE", "u1"), ("SCALE", "<u2"), ("OPACITY", "u1")],
)
def test_integers_are_shares_of_their_largest(tmp_path, name, kind):
    splats = make_gaussians(30, 0)
    splats.log_scales[:] = np.log(np.linspace(0.3, 1, 90).reshape(30, 3))
    splats.opacity_logits[:] = np.linspace(-1, 1, 30)
    root, binary = plain(splats)
    number = root["meshes"][0]["primitives"][0]["attributes"][f"{EXTENSION}:{name}"]
    accessor, view = root["accessors"][number], root["bufferViews"][number]
    values = np.frombuffer(binary, "<f4", view["byteLength"] // 4, view["byteOffset"])
    most = np.iinfo(kind).max
    coded = np.round(values * most).astype(kind)
    accessor |= {"componentType": BYTES[kind], "normalized": True}
    view |= {"byteOffset": len(binary), "byteLength": coded.nbytes}
    binary += coded.tobytes() + bytes(-coded.nbytes % 4)
    root["buffers"][0]["byteLength"] = len(binary)
    back = read(tmp_path, joined(root, binary)).splats
    assert_same(back, moved(splats, PLY_FROM_GLTF), 8 / most)


def test_attributes_may_be_interleaved_and_buffers_data_uris(tmp_path):
    splats = make_gaussians(9, 1)
    root, binary = plain(splats)
    widths = [{"SCALAR": 1, "VEC3": 3, "VEC4": 4}[a["type"]] for a in root["accessors"]]
    columns = np.split(np.frombuffer(binary, "<f4"), np.cumsum(np.multiply(widths, 9))[:-1])
    rows = np.concatenate([c.reshape(9, -1) for c in columns], axis=1)
    for number, at in enumerate(np.cumsum([0, *widths[:-1]])):
        root["accessors"][number] |= {"bufferView": 0, "byteOffset": 4 * int(at)}
    root["bufferViews"] = [{"buffer": 0, "byteLength": rows.nbytes, "byteStride": 4 * sum(widths)}]
    text = base64.b64encode(rows.tobytes()).decode()
    root["buffers"] = [
        {"byteLength": rows.nbytes, "uri": f"data:application/gltf-buffer;base64,{text}"}
    ]
    back = read(tmp_path, json.dumps(root).encode(), "a.gltf")
    assert_same(back.splats, moved(splats, PLY_FROM_GLTF))


def primitive_of(root: dict[str, Any]) -> dict[str, Any]:
    return root["meshes"][0]["primitives"][0]


def spz_inside(root: dict[str, Any]) -> None:
    name = "KHR_gaussian_splatting_compression_spz_2"
    primitive_of(root)["extensions"][EXTENSION]["extensions"] = {name: {"bufferView": 0}}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda r: r["nodes"][0].update(scale=[1, 2, 1]), r"scales its splats by \[1\.0, 2\.0"),
        (lambda r: r["nodes"][0].update(scale=[-1, 1, 1]), "left-handed"),
        (lambda r: r["nodes"][0].update(scale=[0, 0, 0]), r"scales its splats by \[0\.0"),
        (lambda r: r["nodes"][0].update(rotation=[0, 0, 0, 0]), "rotation is of length 0"),
        (lambda r: r["nodes"][0].update(translation=[0, 0, float("nan")]), "translation_m"),
        (lambda r: r["nodes"][0].update(children=[0]), "its own ancestor|no splats"),
        (
            lambda r: r["nodes"][0].update(extensions={"EXT_mesh_gpu_instancing": {}}),
            "node 0 has EXT_mesh_gpu_instancing, which is not read",
        ),
        (lambda r: primitive_of(r)["extensions"].clear(), r"no splats .* 1 other primitives"),
        (spz_inside, r"compression_spz_2, which is not read; export it without"),
        (lambda r: r.update(extensionsRequired=["KHR_draco"]), "needs KHR_draco"),
        (lambda r: r["bufferViews"][0].update(extensions={"EXT_meshopt": {}}), "EXT_meshopt"),
        (lambda r: r["accessors"][0].update(sparse={}), "POSITION is sparse"),
        (lambda r: r["accessors"][0].update(count=6), "attributes of different length"),
        (lambda r: r["accessors"][0].update(type="VEC4"), "POSITION is VEC4"),
        (lambda r: r["bufferViews"][0].update(byteLength=8), "cut short"),
        (lambda r: r["bufferViews"][0].update(byteOffset=-4), "cut short"),
        (lambda r: r["bufferViews"][0].update(byteStride=0), "byteStride of 0"),
        (lambda r: r["buffers"][0].update(uri="street.bin"), r"in another file, street\.bin"),
        (lambda r: primitive_of(r)["attributes"].pop(f"{EXTENSION}:SCALE"), "without .*SCALE"),
        (
            lambda r: primitive_of(r)["attributes"].pop(f"{EXTENSION}:SH_DEGREE_1_COEF_2"),
            "2 coefficients of SH degree 1",
        ),
        *(
            (
                lambda r, key=key, value=value: primitive_of(r)["extensions"][EXTENSION].update(
                    {key: value}
                ),
                f"its {key} is '{value}'",
            )
            for key, value in (
                ("kernel", "box"),
                ("colorSpace", "lin_rec709_display"),
                ("projection", "fisheye"),
            )
        ),
    ],
)
def test_what_would_be_drawn_differently_is_refused_by_name(tmp_path, change, said):
    root, binary = plain(make_gaussians(5, 1))
    change(root)
    with pytest.raises(FieldFormatError, match=said):
        read(tmp_path, joined(root, binary))


def test_a_file_cut_short_or_changed_anywhere_is_an_error_or_other_splats(tmp_path):
    whole = encode_glb(make_gaussians(3, 0), antialiased=False, up=Y_UP)
    for size in range(0, len(whole), 5):
        with pytest.raises(FieldFormatError):
            read(tmp_path, whole[:size])
    root, binary = parts(whole)
    for key in root:
        for bad in (None, -1, "x", [], [None], {}, [{}], 1e400):
            broken = deepcopy(root) | {key: bad}
            try:
                read_open_gltf(Path("a.glb"), io.BytesIO(joined(broken, binary)), MAX_BYTES)
            except FieldFormatError:
                continue
            assert key in ("asset", "buffers", "extensionsUsed", "scene", "scenes"), (key, bad)


def test_splats_beyond_the_limit_of_memory_and_none_at_all_are_refused():
    content = encode_glb(make_gaussians(50, 0), antialiased=False, up=Y_UP)
    with pytest.raises(FieldFormatError, match="50 of SH degree 0 take"):
        read_open_gltf(Path("a.glb"), io.BytesIO(content), 50 * 14 * 4 - 1)
    with pytest.raises(InvalidInput, match="are none"):
        encode_glb(make_gaussians(0, 0), antialiased=False, up=Y_UP)
