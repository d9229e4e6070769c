"""``rfedge encode`` and ``rfedge decode``: a drive into a file and back, without a network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from rfedge.arguments import DATASET, FIELD, FOLDER, check_folder, open_field

__all__ = ["Decode", "Encode"]

RFV = arg(metavar="FILE.rfv")


@dataclass(frozen=True)
class Encode:
    """Code a drive against a field's renders; write the vehicle's messages as a .rfv file."""

    drive: Annotated[Path, Positional, DATASET]
    """Posed pictures in time order, a dataset of any format (docs/data.md)."""
    field: Annotated[Path, FIELD]
    """The field: an archive (.rff), or a name."""
    out: Annotated[Path, RFV]
    """The coded drive to write."""
    preset: Annotated[str, arg(metavar="PRESET")] = "medium"
    """x264 preset of the P pictures."""
    crf: float = 23.0
    """x264 constant rate factor, 1 (best) to 51."""
    mask: Annotated[Path | None, arg(metavar="PICTURE")] = None
    """Picture of the camera's size, white where frames are to be coded finer."""
    mask_qp: int = -6
    """Added to H.264's quantiser in the mask, -24..24; -6 halves its step."""
    refine_pose_ms: float | None = None
    """Time a frame to look for a pose of fewer bits near the measured one; from about 100 on."""
    threads: int = 2
    """Threads of the rasterizer."""

    def run(self) -> None:
        """Code the drive and print its size."""
        from rfcore.codec.sender.steering import SteeringSettings
        from rfcore.dataset import read_dataset
        from rfcore.wire.drive_file import write_drive
        from rfedge.offline import CodingSettings, encode_drive

        field = open_field(self.field, threads=self.threads)
        dataset = read_dataset(self.drive, tile_origin=field.metadata.tile_origin)
        asked = SteeringSettings(self.mask, self.mask_qp, self.refine_pose_ms)
        k = dataset.pictures[0].camera.intrinsics
        steering = asked.steering((k.width_px, k.height_px))
        coded = encode_drive(dataset, field, CodingSettings(self.preset, self.crf, steering))
        write_drive(self.out, coded)
        payload_bytes = sum(len(frame.packet.payload) for frame in coded.frames)
        print(
            f"{self.out}: {len(coded.frames)} frames, {self.out.stat().st_size:,} bytes, "
            f"of which payload {payload_bytes:,}"
        )


@dataclass(frozen=True)
class Decode:
    """Reconstruct a coded drive as PNG files, with the field it was coded against."""

    coded: Annotated[Path, Positional, RFV]
    """The coded drive."""
    field: Annotated[Path, FIELD]
    """The field: an archive (.rff), or a name."""
    out: Annotated[Path, FOLDER]
    """Folder for the PNG files."""
    threads: int = 2
    """Threads of the rasterizer."""

    def run(self) -> None:
        """Decode every frame; stop at the first packet that fails a check."""
        from rfcore.image import write_png
        from rfcore.native.yuv import rgb_from_i420
        from rfcore.wire.drive_file import read_drive
        from rfedge.offline import decode_drive

        check_folder(self.out, "a folder for PNG files")
        drive = read_drive(self.coded)
        field = open_field(self.field, threads=self.threads)
        self.out.mkdir(parents=True, exist_ok=True)
        for decoded in decode_drive(drive, field):
            write_png(self.out / f"{decoded.sequence:06d}.png", rgb_from_i420(decoded.frame))
        print(f"{self.out}: {len(drive.frames)} frames")
