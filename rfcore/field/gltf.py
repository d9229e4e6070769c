"""3D Gaussians as glTF 2.0 with the extension KHR_gaussian_splatting (Khronos, 2026).

A mesh primitive of points has an accessor an attribute: ``POSITION``, and with the extension's
prefix ``ROTATION`` (x, y, z, w), ``SCALE`` (linear), ``OPACITY`` (0..1) and ``SH_DEGREE_l_COEF_n``,
a colour each, in the order and signs of ``rfcore.harmonics``. A ``.glb`` is read, and a ``.gltf``
whose buffers are data URIs, with several primitives and the transforms of their nodes. What would
be drawn differently from what a field draws is refused by name. Splats that sort by distance, as
the extension says, are sorted by depth here, as those of the reference implementation are.

**Axes.** glTF says +Y up, +Z front, -X right. Splats come in with the axes of a .ply, RDF (right,
down, front): half a turn round z, as PlayCanvas's splat-transform does it. Here they are written
with the field's vertical along +Y, and the node's ``extras`` say how to turn them back, and
whether they are drawn antialiased, for which the extension has no word.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Pose, Vec3
from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.field.similarity import Similarity, moved, turned_rotations, turned_sh
from rfcore.field.splat_archive import check_decoded_size
from rfcore.field.stored_splats import F64, MOST_DEGREE, StoredSplats, linear_parts
from rfcore.files import write_whole
from rfcore.raster.gaussians import F32, Gaussians
from rfcore.vertical import upright_from

EXTENSION = "KHR_gaussian_splatting"
READABLE = {EXTENSION, "KHR_mesh_quantization"}
"""Extensions that a file may require."""
MAGIC, JSON_CHUNK, BIN_CHUNK = b"glTF", 0x4E4F534A, 0x004E4942
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<II")
MAX_JSON_BYTES = 1 << 28
MOST_NAMED = 8
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
POINTS, FLOAT, ARRAY_BUFFER = 0, 5126, 34962
MOST_UNEVEN = 1e-4
"""Share by which the scales of a node's axes may differ."""
EXTRAS = "rfedge"

STILL: Vec3 = (0.0, 0.0, 0.0)
PLY_FROM_GLTF = Pose(STILL, (0.0, 0.0, 0.0, 1.0))
"""Half a turn round z."""
GLTF_FROM_ENU = Pose(STILL, (0.5**0.5, -(0.5**0.5), 0.0, 0.0))
"""z becomes y."""


def write_glb(path: Path, gaussians: Gaussians, *, antialiased: bool, up: Vec3) -> None:
    """Write ``path``, whole or not at all."""
    write_whole(path, encode_glb(gaussians, antialiased=antialiased, up=up))


def encode_glb(gaussians: Gaussians, *, antialiased: bool, up: Vec3) -> bytes:
    """Return ``gaussians``, whose vertical is ``up``, as a file.

    Raises ``InvalidInput`` if there are none.
    """
    if not len(gaussians):
        raise InvalidInput("splats", "are none; glTF has no empty arrays")
    is_ply = np.allclose(up, (0, -1, 0), atol=1e-6)
    gltf_from_field = PLY_FROM_GLTF if is_ply else GLTF_FROM_ENU.compose(upright_from(up))
    turned = moved(gaussians, Similarity(gltf_from_field))
    xyzw, scales, opacities = linear_parts(turned)
    arrays: dict[str, NDArray[np.floating]] = {
        "POSITION": turned.means,
        f"{EXTENSION}:ROTATION": xyzw,
        f"{EXTENSION}:SCALE": scales,
        f"{EXTENSION}:OPACITY": opacities,
    }
    for degree in range(turned.sh_degree + 1):
        for order in range(2 * degree + 1):
            arrays[_harmonic(degree, order)] = turned.sh[:, degree**2 + order]
    views, accessors, parts, at = [], [], [], 0
    for number, array in enumerate(arrays.values()):
        parts.append(array.astype("<f4").tobytes())
        views.append({"buffer": 0, "byteOffset": at, "byteLength": len(parts[-1])})
        views[-1]["target"] = ARRAY_BUFFER
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[array.size // len(array)]
        accessors.append(
            {"bufferView": number, "componentType": FLOAT, "count": len(array), "type": kind}
        )
        at += len(parts[-1])
    accessors[0] |= {
        "min": turned.means.min(axis=0).tolist(),
        "max": turned.means.max(axis=0).tolist(),
    }
    stated = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"mode": POINTS, "attributes": dict(zip(arrays, range(len(arrays)), strict=True))}
    back = [*gltf_from_field.inverse().rotation]
    extras = {EXTRAS: {"field_from_gltf_wxyz": back, "antialiased": antialiased}}
    asset = {
        "asset": {"version": "2.0", "generator": "rfedge"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "extras": extras}],
        "meshes": [{"primitives": [{**primitive, "extensions": {EXTENSION: stated}}]}],
        "buffers": [{"byteLength": at}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(asset, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = [CHUNK.pack(len(text), JSON_CHUNK), text, CHUNK.pack(at, BIN_CHUNK), *parts]
    size = HEADER.size + sum(map(len, chunks))
    return b"".join([HEADER.pack(MAGIC, 2, size), *chunks])


def _harmonic(degree: int, order: int) -> str:
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"


def read_open_gltf(path: Path, file: BinaryIO, max_bytes: int) -> StoredSplats:
    """Return the splats of an open file named ``path``, binary or text.

    Raises ``FieldFormatError`` for what is malformed, what a field would draw differently, and for
    splats that take more than ``max_bytes`` of memory.
    """
    try:
        return _splats(_asset(file), max_bytes)
    except (InvalidInput, FieldFormatError) as error:
        raise FieldFormatError(f"{path}: {error}") from error
    except (LookupError, TypeError, ValueError, OverflowError, RecursionError) as error:
        problem = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise FieldFormatError(f"{path}: is no valid glTF ({problem[:200]})") from error
    except (AttributeError, EOFError, struct.error) as error:
        raise FieldFormatError(f"{path}: is no valid glTF ({str(error)[:200]})") from error


@dataclass(frozen=True)
class _Asset:
    """The JSON of a file, and where its binary part begins and ends."""

    root: dict[str, Any]
    file: BinaryIO
    binary_at: int = 0
    binary_bytes: int = 0
    decoded: dict[int, bytes] = field(default_factory=dict)
    """Buffers of data URIs that were read."""

    def item(self, kind: str, number: Any) -> dict[str, Any]:
        """Return one of the objects that others name by number."""
        items = self.root.get(kind, [])
        if type(number) is not int or not 0 <= number < len(items):
            raise FieldFormatError(f"is no valid glTF: {kind} {number!r} of {len(items)}")
        item = items[number]
        if not isinstance(item, dict):
            raise FieldFormatError(f"is no valid glTF: {kind} {number} is no object")
        return item

    def read(self, view_number: int, start: int, size: int) -> bytes:
        """Return bytes of a view."""
        view = self.item("bufferViews", view_number)
        _refuse_extensions(view, f"bufferView {view_number}")
        buffer = self.item("buffers", view["buffer"])
        offset, length = view.get("byteOffset", 0), view["byteLength"]
        if not 0 <= start <= start + size <= length or not offset >= 0:
            raise FieldFormatError(f"is cut short: bufferView {view_number} has {length} bytes")
        uri = buffer.get("uri")
        if uri is None:
            if view["buffer"] != 0 or offset + length > self.binary_bytes:
                raise FieldFormatError(f"is cut short: bufferView {view_number} ends behind it")
            self.file.seek(self.binary_at + offset + start)
            data = self.file.read(size)
        else:
            number = view["buffer"]
            if number not in self.decoded:
                self.decoded[number] = _data_of(uri)
            data = self.decoded[number][offset + start : offset + start + size]
        if len(data) < size:
            raise FieldFormatError(f"is cut short within bufferView {view_number}")
        return data


def _asset(file: BinaryIO) -> _Asset:
    """Return a file's JSON; raises ``ValueError`` and ``FieldFormatError``."""
    start = file.read(HEADER.size)
    if not start.startswith(MAGIC):
        text = start + file.read(MAX_JSON_BYTES)
        return _checked(_Asset(_parsed(text), file))
    _, version, total = HEADER.unpack(start)
    size, kind = CHUNK.unpack(file.read(CHUNK.size))
    if version != 2 or kind != JSON_CHUNK:
        raise FieldFormatError(f"is glTF {version}, whose first chunk is {kind:#x}; 2 is read")
    if size > MAX_JSON_BYTES:
        raise FieldFormatError(f"has {size} bytes of JSON; at most {MAX_JSON_BYTES} are read")
    root = _parsed(file.read(size))
    at = HEADER.size + CHUNK.size + size
    header = file.read(CHUNK.size)
    if len(header) < CHUNK.size:
        return _checked(_Asset(root, file))
    length, kind = CHUNK.unpack(header)
    if kind != BIN_CHUNK or at + CHUNK.size + length > total:
        raise FieldFormatError("is no valid glTF: its second chunk is not its binary part")
    return _checked(_Asset(root, file, at + CHUNK.size, length))


def _parsed(text: bytes) -> dict[str, Any]:
    root = json.loads(text)
    if not isinstance(root, dict) or not isinstance(root.get("asset"), dict):
        raise FieldFormatError("is no valid glTF: its JSON has no asset")
    return root


def _checked(asset: _Asset) -> _Asset:
    required = [name for name in asset.root.get("extensionsRequired", []) if name not in READABLE]
    if required:
        raise FieldFormatError(f"needs {_named(required)}, which is not read; {EXPORT}")
    return asset


EXPORT = "export it without, or the splats as .ply or .spz"


def _named(names: list[Any]) -> str:
    return ", ".join(map(str, names[:MOST_NAMED]))


def _refuse_extensions(item: Mapping[str, Any], what: str) -> None:
    if item.get("extensions"):
        names = _named(list(item["extensions"]))
        raise FieldFormatError(f"{what} has {names}, which is not read; {EXPORT}")


def _data_of(uri: str) -> bytes:
    head, _, data = uri.partition(",")
    if not head.startswith("data:") or not head.endswith(";base64"):
        raise FieldFormatError(f"its buffer is in another file, {uri[:80]}; export it as .glb")
    try:
        return base64.b64decode(data, validate=True)
    except binascii.Error as error:
        raise FieldFormatError(f"its buffer is no base64 ({error})") from error


def _array(asset: _Asset, number: int, what: str, width: int) -> NDArray[np.float32]:
    """Return an accessor's values [N, ``width``]; normalised integers become shares."""
    accessor = asset.item("accessors", number)
    kind, count = COMPONENTS[accessor["componentType"]], accessor["count"]
    if WIDTHS.get(accessor["type"]) != width:
        raise FieldFormatError(f"{what} is {accessor['type']}, of {width} components each")
    if "sparse" in accessor:
        raise FieldFormatError(f"{what} is sparse, which is not read; {EXPORT}")
    dtype = np.dtype(kind)
    if "bufferView" not in accessor:
        raise FieldFormatError(f"{what} has no data")
    tight = width * dtype.itemsize
    stride = asset.item("bufferViews", accessor["bufferView"]).get("byteStride", tight)
    if type(stride) is not int or not tight <= stride <= 252:
        raise FieldFormatError(f"{what} has a byteStride of {stride}; {tight}..252 are read")
    size = (count - 1) * stride + tight if count else 0
    data = asset.read(accessor["bufferView"], accessor.get("byteOffset", 0), size)
    rows = np.ndarray((count, width), dtype, data, strides=(stride, dtype.itemsize))
    values = rows.astype(np.float32)
    if accessor.get("normalized", False) and dtype.kind != "f":
        values = np.maximum(values / np.float32(np.iinfo(dtype).max), np.float32(-1))
    return values


@dataclass(frozen=True)
class _Placed:
    """A primitive with splats under a node."""

    primitive: Mapping[str, Any]
    world_from_node: F64
    extras: Mapping[str, Any]
    count: int
    sh_degree: int


def _splats(asset: _Asset, max_bytes: int) -> StoredSplats:
    placed, dropped = _placed(asset)
    if not placed:
        raise FieldFormatError(f"holds no splats ({EXTENSION}), but {dropped} other primitives")
    degree = max(each.sh_degree for each in placed)
    check_decoded_size(sum(each.count for each in placed), degree, max_bytes)
    parts = [_read(asset, each, degree) for each in placed]
    notes = [_axes_note(placed)]
    if len(placed) > 1:
        notes.append(f"splats of {len(placed)} primitives are joined")
    if dropped:
        notes.append(f"{dropped} other primitives (meshes, lines, points) are left out")
    stated = {each.extras.get("antialiased") for each in placed}
    antialiased = stated.pop() if len(stated) == 1 else None
    antialiased = antialiased if isinstance(antialiased, bool) else None
    x, y, z = (round(value, 9) + 0.0 for value in _back(placed[0].extras).apply((0.0, 1.0, 0.0)))
    return StoredSplats(
        np.concatenate([part.means_m for part in parts]),
        np.concatenate([part.quaternions for part in parts]),
        np.concatenate([part.log_scales for part in parts]),
        np.concatenate([part.opacity_logits for part in parts]),
        np.concatenate([part.sh for part in parts]),
        antialiased=antialiased,
        notes=tuple(notes),
        up=(x, y, z),
    )


def _axes_note(placed: list[_Placed]) -> str:
    if all("field_from_gltf_wxyz" in each.extras for each in placed):
        return "axes: +Y up, as glTF says, turned back to those of the field that was exported"
    return "axes: +Y up, as glTF says, turned half round z to RDF of a .ply"


def _back(extras: Mapping[str, Any]) -> Pose:
    stated = extras.get("field_from_gltf_wxyz")
    return PLY_FROM_GLTF if stated is None else Pose(STILL, _unit(*map(float, stated)))


def _placed(asset: _Asset) -> tuple[list[_Placed], int]:
    """Return the primitives with splats of the scene, and how many others it has."""
    placed, dropped = [], 0
    for number, world_from_node in _nodes(asset):
        node = asset.item("nodes", number)
        if "mesh" not in node:
            continue
        for primitive in asset.item("meshes", node["mesh"])["primitives"]:
            if EXTENSION not in primitive.get("extensions", {}):
                dropped += 1
                continue
            _refuse_extensions(node, f"node {number}")
            count, degree = _checked_primitive(asset, primitive)
            extras = node.get("extras")
            extras = extras.get(EXTRAS, {}) if isinstance(extras, dict) else {}
            placed.append(_Placed(primitive, world_from_node, extras, count, degree))
    return placed, dropped


def _nodes(asset: _Asset) -> Iterator[tuple[int, F64]]:
    """Yield the nodes of the scene that is shown, with their transforms."""
    nodes = asset.root.get("nodes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    roots = [number for number in range(len(nodes)) if number not in children]
    if asset.root.get("scenes"):
        roots = asset.item("scenes", asset.root.get("scene", 0)).get("nodes", [])
    waiting: list[tuple[int, F64]] = [(number, np.eye(4)) for number in reversed(roots)]
    for _ in range(len(nodes) + 1):
        if not waiting:
            return
        number, world_from_parent = waiting.pop()
        node = asset.item("nodes", number)
        world_from_node = world_from_parent @ _parent_from_node(node)
        yield number, world_from_node
        waiting += [(child, world_from_node) for child in reversed(node.get("children", []))]
    raise FieldFormatError("is no valid glTF: a node is its own ancestor, or has two parents")


def _parent_from_node(node: Mapping[str, Any]) -> F64:
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    x, y, z, w = map(float, node.get("rotation", (0, 0, 0, 1)))
    turned = np.array(Pose(STILL, _unit(w, x, y, z)).rotation_matrix())
    matrix = np.eye(4)
    matrix[:3, :3] = turned * np.array(node.get("scale", (1, 1, 1)), float)
    matrix[:3, 3] = node.get("translation", STILL)
    return matrix


def _unit(*values: float) -> tuple[float, float, float, float]:
    """Return a quaternion of float32 with the norm that ``Pose`` asks for."""
    norm = float(np.linalg.norm(values))
    if not norm > 0:
        raise FieldFormatError(f"a node's rotation is of length {norm:g}, not 1")
    w, x, y, z = np.array(values) / norm
    return float(w), float(x), float(y), float(z)


def _similarity(world_from_node: F64) -> Similarity:
    scales = np.linalg.norm(world_from_node[:3, :3], axis=0)
    scale = float(scales.mean())
    if not (scale > 0 and np.abs(scales - scale).max() <= MOST_UNEVEN * scale):
        raise FieldFormatError(
            f"a node scales its splats by {scales.round(6).tolist()}; all axes alike are read: "
            "apply the node's transform where it was made"
        )
    rigid = world_from_node.copy()
    rigid[:3, :3] /= scale
    return Similarity(Pose.from_matrix(rigid.tolist()), scale)


def _checked_primitive(asset: _Asset, primitive: Mapping[str, Any]) -> tuple[int, int]:
    """Return the number of splats and their SH degree; raise for what is drawn differently."""
    stated = primitive["extensions"][EXTENSION]
    _refuse_extensions(stated, EXTENSION)
    for name, read in (("kernel", "ellipse"), ("colorSpace", "srgb_rec709_display")):
        if stated.get(name) != read:
            raise FieldFormatError(f"its {name} is {stated.get(name)!r}; {read} is read")
    if stated.get("projection", "perspective") != "perspective":
        raise FieldFormatError(f"its projection is {stated['projection']!r}; perspective is read")
    attributes = primitive["attributes"]
    names = ("POSITION", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")))
    missing = [name for name in (*names, _harmonic(0, 0)) if name not in attributes]
    if missing:
        raise FieldFormatError(f"has splats without {', '.join(missing)}")
    has = [
        sum(_harmonic(degree, order) in attributes for order in range(2 * degree + 1))
        for degree in range(MOST_DEGREE + 1)
    ]
    whole = [count == 2 * degree + 1 for degree, count in enumerate(has)]
    degree = whole.index(False) - 1 if False in whole else MOST_DEGREE
    if any(has[degree + 1 :]):
        raise FieldFormatError(f"has {has[degree + 1]} coefficients of SH degree {degree + 1}")
    counts = {
        name: asset.item("accessors", number)["count"]
        for name, number in attributes.items()
        if name.startswith(EXTENSION) or name == "POSITION"
    }
    count = counts["POSITION"]
    if type(count) is not int or count < 0 or set(counts.values()) != {count}:
        raise FieldFormatError(f"has attributes of different length: {counts}")
    return count, degree


def _read(asset: _Asset, placed: _Placed, sh_degree: int) -> StoredSplats:
    """Return splats in the axes of a .ply, padded to ``sh_degree``."""
    attributes = placed.primitive["attributes"]

    def values(name: str, width: int) -> F32:
        return _array(asset, attributes[name], name, width)

    sh = np.zeros((placed.count, (sh_degree + 1) ** 2, 3), np.float32)
    for degree in range(placed.sh_degree + 1):
        for order in range(2 * degree + 1):
            sh[:, degree**2 + order] = values(_harmonic(degree, order), 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(values(f"{EXTENSION}:SCALE", 3))
        opacity = values(f"{EXTENSION}:OPACITY", 1)[:, 0].astype(np.float64)
        logits = (np.log(opacity) - np.log1p(-opacity)).astype(np.float32)
    turn = Similarity(_back(placed.extras)).compose(_similarity(placed.world_from_node))
    quaternions = np.roll(values(f"{EXTENSION}:ROTATION", 4), 1, axis=1)
    return StoredSplats(
        turn.apply(values("POSITION", 3).astype(np.float64)),
        turned_rotations(quaternions, turn.pose.rotation),
        log_scales + np.float32(np.log(turn.scale)),
        logits,
        turned_sh(sh, turn.rotation),
    )
