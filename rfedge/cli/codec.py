"""``rfedge encode`` and ``rfedge decode``: a drive into a file and back, without a network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from rfcore.codec.h264.config import CoderSettings
from rfedge.arguments import DATASET, FIELD, FOLDER, RENDERER, check_folder, open_field

if TYPE_CHECKING:
    from rfcore.dataset import Dataset
    from rfcore.field import RadianceField
    from rfedge.offline import Locate

RFV = arg(metavar="FILE.rfv")


@dataclass(frozen=True)
class Encode:
    """Encode a drive against a field's renders; write the vehicle's messages to a .rfv file."""

    drive: Annotated[Path, Positional, DATASET]
    """Posed pictures in time order, a dataset of any format (docs/how-to/data.md)."""
    field: Annotated[Path, FIELD]
    """The field: an archive (.rff), a name, or MODULE:CLASS (docs/how-to/python.md)."""
    out: Annotated[Path, RFV]
    """The coded drive to write."""
    coding: OmitArgPrefixes[CoderSettings] = CoderSettings()
    crf: float = 23.0
    """Quality as x264's constant rate factor, 1 (best) to 51."""
    mask: Annotated[Path | None, arg(metavar="PICTURE")] = None
    """Picture of the camera's size that is white where --mask-qp applies."""
    mask_qp: int = -6
    """Change of H.264's QP inside the mask, -24..24; -6 halves the quantiser's step."""
    localise: bool = False
    """Find the poses in the field, near the dataset's own; a frame without a pose is coded without
    the field."""
    threads: int = 2
    """Threads of the rasterizer."""
    renderer: Annotated[str, RENDERER] = "cpu"
    """Render splats on the CPU or on an OpenCL device; the bytes are the same."""

    def run(self) -> None:
        """Encode the drive and print its size."""
        from rfcore.codec.h264.qp_map import MaskSettings
        from rfcore.dataset import read_dataset
        from rfcore.raster.renderers import renderer_isa
        from rfcore.wire.drive_file import write_drive
        from rfedge.offline import CodingSettings, encode_drive

        isa = renderer_isa(self.renderer)
        field = open_field(self.field, threads=self.threads, isa=isa)
        dataset = read_dataset(self.drive, tile_origin=field.metadata.tile_origin)
        k = dataset.pictures[0].camera.intrinsics
        qp_map = MaskSettings(self.mask, self.mask_qp).qp_map((k.width_px, k.height_px))
        coding = self.coding
        settings = CodingSettings(coding.name, self.crf, qp_map, coding.check_decode, coding.light)
        coded = encode_drive(dataset, field, settings, self._located(field, dataset))
        write_drive(self.out, coded)
        payload_bytes = sum(len(frame.packet.payload) for frame in coded.frames)
        print(
            f"{self.out}: {len(coded.frames)} frames, {self.out.stat().st_size:,} bytes, "
            f"of which payload {payload_bytes:,}"
        )

    def _located(self, field: RadianceField, dataset: Dataset) -> Locate | None:
        """Return the function that finds the poses, or None without --localise."""
        if not self.localise:
            return None
        from rfedge.located import LocatedDrive, own_poses

        return LocatedDrive(field, dataset.pictures, own_poses(dataset.pictures)).locate


@dataclass(frozen=True)
class Decode:
    """Decode a .rfv file to PNG files, with the field that it was encoded against."""

    coded: Annotated[Path, Positional, RFV]
    """The coded drive."""
    field: Annotated[Path, FIELD]
    """The field: an archive (.rff), a name, or MODULE:CLASS (docs/how-to/python.md)."""
    out: Annotated[Path, FOLDER]
    """Folder for the PNG files."""
    decoder: Literal["auto", "bubblewrap", "landlock", "child", "in-process"] = "auto"
    """Sandbox of the H.264 decoder, as for mec-server; auto: the best one that works here."""
    threads: int = 2
    """Threads of the rasterizer."""
    renderer: Annotated[str, RENDERER] = "cpu"
    """Render splats on the CPU or on an OpenCL device; the bytes are the same."""

    def run(self) -> None:
        """Decode every frame; stop at the first packet that fails a check."""
        from mec_server.config import DecoderKind
        from mec_server.decoding.decoders import Decoders
        from rfcore.image import write_png
        from rfcore.native.yuv import rgb_from_i420
        from rfcore.raster.renderers import renderer_isa
        from rfcore.wire.drive_file import read_drive
        from rfedge.offline import decode_drive

        check_folder(self.out, "a folder for PNG files")
        drive = read_drive(self.coded)
        isa = renderer_isa(self.renderer)
        field = open_field(self.field, threads=self.threads, isa=isa)
        self.out.mkdir(parents=True, exist_ok=True)
        # A decoder of root becomes another user, and nothing but it runs on what the file says.
        with Decoders(DecoderKind(self.decoder), as_root=True) as decoders:
            for decoded in decode_drive(drive, field, decoders.open):
                write_png(self.out / f"{decoded.sequence:06d}.png", rgb_from_i420(decoded.frame))
        print(f"{self.out}: {len(drive.frames)} frames")
