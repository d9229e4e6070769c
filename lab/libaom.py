"""libaom at low delay, as a codec of ``rfedge eval compare --method lab.libaom:Good3``.

libaom comes with the FFmpeg of imageio-ffmpeg, a whole program and no library: a clip is one run of
it. Every picture goes out before the next is looked at (``lag-in-frames 0``), one thread, one key
frame. Processor times are those of the program, its start (some 30 ms) included.
"""

from __future__ import annotations

import resource
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from time import process_time_ns
from typing import ClassVar

import av
import imageio_ffmpeg

from rfcore.errors import CodecError
from rfcore.image import I420
from rfedge.evaluate.clips import CodedClip
from rfedge.evaluate.rivals import CodedPictures, decoded_pictures

CRFS = (18.0, 24.0, 30.0, 36.0, 42.0, 48.0, 54.0, 60.0)


@dataclass(frozen=True)
class Libaom:
    """libaom of one usage and speed; codes a clip by one run of FFmpeg."""

    usage: ClassVar[str]
    """``good`` or ``realtime``."""
    speed: ClassVar[int]
    """``cpu-used``: the lower, the slower and the better."""
    points: ClassVar[tuple[float, ...]] = CRFS
    limits: ClassVar[tuple[float, float]] = (1.0, 63.0)

    @property
    def name(self) -> str:
        """The usage and the speed."""
        return f"libaom-{self.usage}-{self.speed}"

    @cached_property
    def version(self) -> str:
        """FFmpeg's own words, and the options."""
        said = subprocess.run(
            [imageio_ffmpeg.get_ffmpeg_exe(), "-version"], capture_output=True, check=True
        )
        return f"{said.stdout.decode().splitlines()[0]}; {' '.join(self._options)}"

    @property
    def _options(self) -> list[str]:
        usage = ["-usage", self.usage, "-cpu-used", str(self.speed)]
        one_thread = ["-threads", "1", "-row-mt", "0"]
        return [*usage, "-b:v", "0", "-lag-in-frames", "0", "-g", "99999", *one_thread]

    def code(self, frames: Sequence[I420], rate_hz: float, point: float) -> CodedClip:
        """Code and decode ``frames`` at CRF ``point``; raise ``CodecError`` if FFmpeg fails."""
        return self.pictures(frames, rate_hz, point).measured(point, frames)

    def pictures(self, frames: Sequence[I420], rate_hz: float, point: float) -> CodedPictures:
        """Return what ``code`` measures."""
        planes = b"".join(frame.packed() for frame in frames)
        before_s = _children_s()
        ivf = self._encoded(planes, frames[0].size_px, rate_hz, point)
        coded_s = _children_s() - before_s
        packets = _packets(ivf)
        if len(packets) != len(frames):
            raise CodecError(f"{self.name}: {len(frames)} frames came out as {len(packets)}")
        began_ns = process_time_ns()
        decoded = decoded_pictures("libdav1d", packets)
        decoder_ms = (process_time_ns() - began_ns) / 1e6
        sizes = [len(packet) for packet in packets]
        return CodedPictures(sizes, decoded, 1e3 * coded_s, decoder_ms)

    def _encoded(
        self, planes: bytes, size_px: tuple[int, int], rate_hz: float, point: float
    ) -> bytes:
        """Return the clip as an IVF file."""
        width, height = size_px
        raw = ["-f", "rawvideo", "-pix_fmt", "yuv420p", "-s", f"{width}x{height}"]
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-loglevel", "error"]
        command += [*raw, "-r", f"{rate_hz:g}", "-i", "pipe:0", "-c:v", "libaom-av1"]
        command += [*self._options, "-crf", f"{point:g}", "-f", "ivf", "pipe:1"]
        done = subprocess.run(command, input=planes, capture_output=True, check=False)
        if done.returncode or done.stderr:
            raise CodecError(f"{self.name}: {done.stderr.decode(errors='replace').strip()}")
        return done.stdout


class Good3(Libaom):
    """The strongest codec of a processor that was found: 18 to 38 times x264's time."""

    usage, speed = "good", 3


class Good6(Libaom):
    """3 to 7 times x264's time."""

    usage, speed = "good", 6


class Realtime6(Libaom):
    """2 to 4 times x264's time, about ours."""

    usage, speed = "realtime", 6


def _children_s() -> float:
    """Return the processor time of the programs that this one ran to their end."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _packets(ivf: bytes) -> list[bytes]:
    """Return the temporal units of an IVF file, one a picture."""
    with av.open(BytesIO(ivf), "r", format="ivf") as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]
