"""Writes the first inputs of every target to ``corpus``: ``python tests/fuzz/seeds.py``."""

import gzip
import struct
import tempfile
from pathlib import Path

import numpy as np

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.h264.bitstream import join_nals
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.references import RENDER_ONLY
from rfcore.codec.sender.encoder import DeltaEncoder, FrameChoice
from rfcore.field import FieldMetadata, SplatField, render_field_view, write_ply
from rfcore.field.archive import PREFIX, encode_archive
from rfcore.field.gltf import encode_glb
from rfcore.field.spz import encode_spz
from rfcore.native.yuv import i420_from_rgb
from rfcore.raster.gaussians import Gaussians
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.convert import hello_to_bytes
from rfcore.wire.convert_answers import AnswerWriter
from rfcore.wire.drive_file import CodedDrive, write_drive
from rfcore.wire.head import FrameWriter
from rfcore.wire.messages import (
    Ack,
    CameraDescription,
    Credit,
    Frame,
    FrameAddress,
    Hello,
    RendererContract,
    StageTimes,
)
from rfcore.wire.tile_manifest import (
    MANIFEST,
    Publication,
    TileVersion,
    TileVersions,
    VersionLabel,
    write_publication,
)
from rfcore.wire.tiles import Area
from rfcore.wire.v1.edge_pb2 import StreamRequest

CORPUS = Path(__file__).parent / "corpus"
FIELD_ID = "ab" * 32


def put(target: str, name: str, data: bytes) -> None:
    (CORPUS / target).mkdir(parents=True, exist_ok=True)
    (CORPUS / target / name).write_bytes(data)


def field(sh_degree: int) -> SplatField:
    rng = np.random.default_rng(1)
    n, k = 4, (sh_degree + 1) ** 2
    shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, k, 3))
    splats = Gaussians(*(rng.uniform(-1, 1, shape).astype(np.float32) for shape in shapes))
    return SplatField(splats, FieldMetadata("fuzz"))


def coded() -> tuple[Hello, list[Frame]]:
    camera = Intrinsics(16, 16, 16.0, 16.0, 8.0, 8.0)
    pose = Pose((0.0, 0.0, -4.0), (1.0, 0.0, 0.0, 0.0))
    encoder = DeltaEncoder(CodecConfig(16, 16))
    state, frames = encoder.start(1), []
    choices = (FrameChoice(RENDER_ONLY), FrameChoice(RENDER_ONLY), FrameChoice(relight=True))
    for number, choice in enumerate(choices):
        view = render_field_view(field(0), Camera(camera, pose).rounded())
        picture = i420_from_rgb(np.full((16, 16, 3), 90 + 40 * number, np.uint8))
        encoded = encoder.encode(state, picture, view, choice=choice)
        state = encoded.state
        frames.append(Frame("front", 10**9 + 1000 * number, pose, "", encoded.packet))
    described = CameraDescription("front", camera, encoder.header)
    return Hello(
        "cav-1", (described,), (FIELD_ID,), RendererContract(RENDERER_CONTRACT, True)
    ), frames


def put_wire() -> None:
    hello, frames = coded()
    messages = [hello_to_bytes(hello), *FrameWriter(hello).in_order(frames)]
    names = ("hello", "frame-0", "frame-1", "frame-relit")
    for name, data in zip(names, messages, strict=True):
        put("message", name, data)
    ack = Ack(FrameAddress("front", 1, 0), StageTimes(1, 2, 3), bytes(6))
    put("message", "answers", AnswerWriter(["front"]).messages([ack, Credit("front", 3)])[0])
    for name, frame, data in zip(names[1:], frames, messages[1:], strict=True):
        put("packet", name, StreamRequest.FromString(data).frame)
        put("slices", name, frame.packet.payload)
    put("session", "drive", b"".join(struct.pack("<H", len(data)) + data for data in messages))
    header = hello.cameras[0].codec
    payloads = [frame.packet.payload for frame in frames]
    put("bitstream", "stream", join_nals([header.sps, header.pps, *payloads]))
    with tempfile.TemporaryDirectory() as folder:
        write_drive(Path(folder) / "a.rfv", CodedDrive(hello, tuple(frames)))
        put("drive", "drive", (Path(folder) / "a.rfv").read_bytes())


def put_files() -> None:
    for name, one in {"raw": field(0), "compressed": field(1).compressed()}.items():
        data = encode_archive(one.archive())
        put("archive", name, data)
        length = PREFIX.unpack(data[: PREFIX.size])[2]
        text = data[PREFIX.size : PREFIX.size + length]
        put(
            "archive",
            f"{name}-unsealed",
            text + b"\0" + data[-(-(PREFIX.size + length) // 64) * 64 :],
        )
    with tempfile.TemporaryDirectory() as folder:
        write_ply(Path(folder) / "a.ply", field(1).gaussians, antialiased=True)
        data = (Path(folder) / "a.ply").read_bytes()
        put("ply", "binary", data)
    for name, zipped in {"degree-0": 0, "degree-1": 1}.items():
        data = encode_spz(field(zipped).gaussians, antialiased=True)
        put("spz", name, data)
        put("spz", f"{name}-plain", gzip.decompress(data))
    put("gltf", "glb", encode_glb(field(1).gaussians, antialiased=True, up=(0.0, 0.0, 1.0)))
    label = VersionLabel("dusk", FIELD_ID, 2, 19.5)
    published, area = "2026-11-01T12:00:00+00:00", Area((-1.0, -2.0), (3.0, 4.0))
    each = (TileVersion(FIELD_ID, published), TileVersion("cd" * 32, published, label))
    versions = TileVersions(each, 1, area, 2.0, {"dusk": 2})
    with tempfile.TemporaryDirectory() as folder:
        write_publication(Path(folder), Publication({"west": versions}))
        put("tiles", "west", (Path(folder) / MANIFEST).read_bytes())
    names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    properties = "".join(f"property double {name}\n" for name in names.split())
    row = " ".join(["0.5"] * 14)
    put(
        "ply",
        "text",
        f"ply\nformat ascii 1.0\nelement vertex 1\n{properties}end_header\n{row}\n".encode(),
    )
    put(
        "transforms",
        "nerfstudio",
        b'{"w": 8, "h": 8, "fl_x": 8, "fl_y": 8, "cx": 4, "cy": 4, "k1": 0.1, "applied_transform": '
        b'[[1,0,0,0],[0,1,0,0],[0,0,1,0]], "frames": [{"file_path": "a.png", "transform_matrix": '
        b"[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}",
    )
    put(
        "transforms",
        "instant-ngp",
        b'{"camera_angle_x": 0.7, "frames": [{"file_path": "b", "time": 1, "transform_matrix": '
        b"[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}",
    )


if __name__ == "__main__":
    put_wire()
    put_files()
