"""``rfedge encode`` and ``rfedge decode``: a drive into a file and back, without a network."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from rfcore.codec.h264.config import (
    REFERENCE_FRAMES,
    X264_REFERENCE_FRAMES,
    Coder,
    CoderSettings,
    LightChange,
)
from rfcore.program import working
from rfedge.arguments import (
    DATASET,
    FIELD,
    RATE,
    RENDERER,
    check_folder,
    drive_rate_hz,
    open_drive,
    open_field,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rfcore.dataset import Dataset
    from rfcore.field import RadianceField
    from rfcore.image import I420
    from rfcore.views import PosedPicture
    from rfcore.wire.drive_file import CodedDrive
    from rfedge.offline import DecodedFrame, Locate

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
    rate: Annotated[float | None, RATE] = None
    """Pictures a second; default: by their times, 10 without any."""
    against_x264: bool = False
    """Also code the drive with x264 (low delay, our tools), and print the saving at equal PSNR."""
    localise: bool = False
    """Find the poses in the field, near the dataset's own; a frame without a pose is coded without
    the field."""
    threads: int = 2
    """Threads of the rasterizer."""
    renderer: Annotated[str, RENDERER] = "cpu"
    """Render splats on the CPU or on an OpenCL device; the bytes are the same."""

    def run(self) -> None:
        """Encode the drive; print its size, rate and quality, and how the field fits."""
        from rfcore.codec.h264.qp_map import MaskSettings
        from rfcore.raster.renderers import renderer_isa
        from rfcore.wire.drive_file import write_drive
        from rfedge.offline import CodedFrame, CodingSettings, encode_drive

        isa = renderer_isa(self.renderer)
        field = open_field(self.field, threads=self.threads, isa=isa)
        dataset = open_drive(self.drive, field, str(self.field))
        rate_hz = drive_rate_hz(self.rate, dataset.rate_hz, self.drive)
        if self.rate is not None:
            dataset = _at_rate(dataset, self.rate)
        k = dataset.pictures[0].camera.intrinsics
        qp_map = MaskSettings(self.mask, self.mask_qp).qp_map((k.width_px, k.height_px))
        coding = self.coding
        settings = CodingSettings(coding.name, self.crf, qp_map, coding.check_decode, coding.light)
        if coding.coder is Coder.X264:
            taken = f"{X264_REFERENCE_FRAMES} of {REFERENCE_FRAMES}"
            print(f"references: {taken} are used, x264 takes no more")
        if coding.light is LightChange.OFF:
            print("light: renders are used as they are (--light off)")
        quality = _Quality(self.against_x264)

        def watch(coded: CodedFrame) -> None:
            quality.add(coded.given.frame, coded.encoded.reconstruction)

        with working(f"encoding {len(dataset.pictures)} pictures"):
            coded = encode_drive(dataset, field, settings, self._located(field, dataset), watch)
        write_drive(self.out, coded)
        payload_bytes = sum(len(frame.packet.payload) for frame in coded.frames)
        size = self.out.stat().st_size
        print(
            f"{self.out}: {len(coded.frames)} frames, {size:,} bytes, "
            f"of which payload {payload_bytes:,}"
        )
        kbps = 8 * size / len(coded.frames) * rate_hz / 1000
        rate = f"{kbps:,.0f} kbit/s at {rate_hz:.4g} Hz"
        print(f"  {rate}, luma PSNR {quality.psnr_db:.2f} dB")
        if self.against_x264:
            print(f"  {quality.against_x264(coded, self.crf, rate_hz)}")

    def _located(self, field: RadianceField, dataset: Dataset) -> Locate | None:
        """Return the function that finds the poses, or None without --localise."""
        if not self.localise:
            return None
        from rfedge.located import LocatedDrive, own_poses

        return LocatedDrive(field, dataset.pictures, own_poses(dataset.pictures)).locate


def _at_rate(dataset: Dataset, rate_hz: float) -> Dataset:
    """Return the drive with times of the stated rate, the first at 0."""
    pictures = (
        replace(picture, time_ns=round(1e9 * number / rate_hz))
        for number, picture in enumerate(dataset.pictures)
    )
    return replace(dataset, pictures=tuple(pictures), rate_hz=rate_hz)


class _Quality:
    """The luma errors of decoded pictures, and the originals where ``keep`` says so."""

    def __init__(self, keep: bool) -> None:
        self._keep = keep
        self._mse: list[float] = []
        self._frames: list[I420] = []

    def add(self, original: I420, decoded: I420) -> None:
        """Take one picture; raise ``InvalidInput`` for two of different sizes."""
        from rfcore.errors import InvalidInput
        from rfedge.evaluate.clips import luma_mse

        if original.size_px != decoded.size_px:
            raise InvalidInput(
                "originals",
                "have {}x{} px, the coded pictures {}x{} px".format(
                    *original.size_px, *decoded.size_px
                ),
            )
        self._mse.append(luma_mse(decoded, original))
        if self._keep:
            self._frames.append(original)

    @property
    def psnr_db(self) -> float:
        """PSNR of the mean squared error of all pictures."""
        from rfcore.metrics import psnr_of_mse

        return psnr_of_mse(sum(self._mse) / len(self._mse))

    @property
    def worst(self) -> tuple[float, int]:
        """PSNR and index of the worst picture."""
        from rfcore.metrics import psnr_of_mse

        worst = max(range(len(self._mse)), key=self._mse.__getitem__)
        return psnr_of_mse(self._mse[worst]), worst

    def against_x264(self, coded: CodedDrive, crf: float, rate_hz: float) -> str:
        """Return a line that compares with x264 at equal PSNR, without the first frame."""
        import numpy as np

        from rfcore.wire.head import FrameWriter
        from rfedge.evaluate.clips import CodedClip
        from rfedge.evaluate.rivals import percent_against_x264

        messages = FrameWriter(coded.hello).in_order(coded.frames)
        sizes = np.array([len(message) for message in messages])
        mse = np.array(self._mse)
        ours = CodedClip(crf, sizes, mse, np.zeros_like(mse), cpu_ms=0.0)
        percent = percent_against_x264(ours, self._frames, rate_hz)
        fewer = f"{abs(percent):.0f} % {'fewer' if percent < 0 else 'more'} bits"
        return f"{fewer} than x264-our-tools-medium at equal PSNR, without the first frame"


@dataclass(frozen=True)
class Decode:
    """Decode a .rfv file to PNG files, MP4 or MCAP, with the field it was encoded against."""

    coded: Annotated[Path, Positional, RFV]
    """The coded drive."""
    field: Annotated[Path, FIELD]
    """The field: an archive (.rff), a name, or MODULE:CLASS (docs/how-to/python.md)."""
    out: Annotated[Path, arg(metavar="FOLDER|FILE.mp4|FILE.mcap")]
    """Folder for the PNG files; or a file ending in .mp4; or in .mcap, with poses, camera and the
    field's points (docs/how-to/bags.md)."""
    originals: Annotated[Path | None, DATASET] = None
    """The drive that was encoded, to print the PSNR of what is decoded."""
    rate: Annotated[float | None, RATE] = None
    """Pictures a second of an MP4; default: by the frames' times, 10 without any."""
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
        from rfcore.errors import InvalidInput
        from rfcore.extras import require
        from rfcore.raster.renderers import renderer_isa
        from rfcore.wire.drive_file import read_drive
        from rfedge.offline import decode_drive

        if not self.coded.exists():
            made = f"rfedge encode DRIVE --field {self.field} --out {self.coded}"
            raise InvalidInput("coded", f"there is no {self.coded}; {made} makes it")
        film, mcap = (self.out.suffix.lower() == suffix for suffix in (".mp4", ".mcap"))
        if mcap:
            require("bags", "mcap", "foxglove_schemas_protobuf")
        elif not film:
            check_folder(self.out, "a folder for PNG files, or a file ending in .mp4 or .mcap")
        drive = read_drive(self.coded)
        isa = renderer_isa(self.renderer)
        field = open_field(self.field, threads=self.threads, isa=isa)
        originals = self._originals(field, len(drive.frames))
        # A decoder of root becomes another user, and nothing but it runs on what the file says.
        kind, what = DecoderKind(self.decoder), f"decoding {len(drive.frames)} frames"
        with working(what), Decoders(kind, as_root=True, quiet=True) as decoders:
            if decoders.problem:
                print(f"note: decoded in a {decoders.kind} sandbox ({decoders.problem})")
            decoded = decode_drive(drive, field, decoders.open)
            if film:
                self._write_film(drive, self._compared(decoded, originals))
            elif mcap:
                self._write_mcap(drive, field, self._compared(decoded, originals))
            else:
                self._write_pictures(drive, self._compared(decoded, originals))

    def _originals(self, field: RadianceField, count: int) -> Sequence[PosedPicture]:
        from rfcore.errors import InvalidInput

        if self.originals is None:
            return ()
        pictures = open_drive(self.originals, field).pictures
        if len(pictures) != count:
            raise InvalidInput("originals", f"are {len(pictures)} pictures, {count} were encoded")
        return pictures

    def _compared(
        self, decoded: Iterable[DecodedFrame], originals: Sequence[PosedPicture]
    ) -> Iterator[DecodedFrame]:
        """Pass frames through; print their PSNR after the last one."""
        from rfcore.native.yuv import i420_from_rgb

        quality = _Quality(keep=False)
        for index, frame in enumerate(decoded):
            if originals:
                quality.add(i420_from_rgb(originals[index].read()), frame.frame)
            yield frame
        if originals:
            worst_db, worst = quality.worst
            print(
                f"luma PSNR {quality.psnr_db:.2f} dB; the worst frame, "
                f"{originals[worst].name}, {worst_db:.2f} dB"
            )

    def _write_pictures(self, drive: CodedDrive, decoded: Iterable[DecodedFrame]) -> None:
        from rfcore.image import write_png
        from rfcore.native.yuv import rgb_from_i420

        self.out.mkdir(parents=True, exist_ok=True)
        for frame in decoded:
            write_png(self.out / f"{frame.sequence:06d}.png", rgb_from_i420(frame.frame))
        print(f"{self.out}: {len(drive.frames)} frames")

    def _write_mcap(
        self, drive: CodedDrive, field: RadianceField, decoded: Iterable[DecodedFrame]
    ) -> None:
        from rfedge.mcap_file import McapFile, ShownPicture

        camera, vehicle = drive.hello.cameras[0], drive.hello.vehicle_id
        unfinished = self.out.with_name(f"{self.out.name}.part")
        with McapFile(unfinished, field) as file:
            for sent, frame in zip(drive.frames, decoded, strict=True):
                metrics = {"sequence": frame.sequence, "payload_bytes": len(sent.packet.payload)}
                shown = ShownPicture(
                    *(vehicle, camera.camera_id, sent.capture_time_ns, frame.frame),
                    *(camera.intrinsics, sent.pose, field.field_id, metrics),
                )
                file.show(shown, sent.capture_time_ns)
        unfinished.replace(self.out)
        late = f"; {file.late} left out, not taken later than the ones before" if file.late else ""
        print(f"{self.out}: {len(drive.frames) - file.late} frames{late}")

    def _write_film(self, drive: CodedDrive, decoded: Iterable[DecodedFrame]) -> None:
        """Write the MP4 at the stated rate, or at the mean rate of the frames' times."""
        from rfedge.video import write_mp4

        times_ns = [frame.capture_time_ns for frame in drive.frames]
        taken_s = (times_ns[-1] - times_ns[0]) / 1e9
        times_hz = (len(times_ns) - 1) / taken_s if taken_s > 0 else None
        rate_hz = drive_rate_hz(self.rate, times_hz, self.coded)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        count = write_mp4(self.out, (frame.frame for frame in decoded), rate_hz)
        print(f"{self.out}: {count} frames at {rate_hz:.4g} Hz")
