"""A codec of one's own in the comparison: Motion JPEG, every frame on its own.

rfedge eval compare samples/fields/street.rff empty@10=samples/street/transforms_drive_empty.json \
    --method examples.own_codec:MotionJpeg --quick
"""

from fractions import Fraction
from time import process_time

import av
import numpy as np

from rfcore.codec.h264.config import even_size_px
from rfcore.codec.h264.ffmpeg import picture_of, video_frame
from rfcore.metrics import ssim
from rfedge.evaluate.clips import CodedClip, luma_mse


class MotionJpeg:
    name = "motion-jpeg"
    version = f"PyAV {av.__version__}"
    points = (2.0, 4.0, 8.0, 12.0, 18.0, 26.0)  # quantiser scales, best first

    def code(self, frames, rate_hz, point):
        """Code and decode ``frames`` (I420) one at a time at one operating point, timing each."""
        encoder = av.CodecContext.create("mjpeg", "w")
        size_px = frames[0].size_px
        even_px = even_size_px(size_px)
        encoder.width, encoder.height = even_px
        encoder.pix_fmt, encoder.time_base = "yuvj420p", 1 / Fraction(rate_hz)
        encoder.options = {"qmin": f"{point:g}", "qmax": f"{point:g}"}
        began_s = process_time()
        pictures = enumerate(frames)
        packets = [encoder.encode(video_frame(f, even_px, i, "yuvj420p"))[0] for i, f in pictures]
        coded_s = process_time()
        decoder = av.CodecContext.create("mjpeg", "r")
        shown = [frame for packet in (*packets, None) for frame in decoder.decode(packet)]
        decoded = [picture_of(frame).cropped(size_px) for frame in shown]
        decoded_s = process_time()
        pairs = list(zip(decoded, frames, strict=True))
        return CodedClip(
            point,
            np.array([packet.size for packet in packets]),
            np.array([luma_mse(*pair) for pair in pairs]),
            np.array([ssim(ours.y, theirs.y) for ours, theirs in pairs]),
            cpu_ms=1e3 * (coded_s - began_s),
            receiver_cpu_ms=1e3 * (decoded_s - coded_s),
        )
