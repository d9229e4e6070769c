"""x264 handed in to the benchmark: a packet and a picture for each frame.

rfedge-lab benchmark run out/x264 --name x264-veryfast --points 17 20 23 26 29 32 35 38 41 \
    --method "python examples/bench_x264.py {frames} {hz} {point} {out}"
"""

import json
import sys
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

OPTIONS = {
    "preset": "veryfast",
    "tune": "zerolatency",
    "x264-params": "keyint=infinite:scenecut=0:threads=1",
}


def code(frames: Path, hz: str, crf: str, out: Path) -> None:
    """Code the raw pictures of a folder, each before the next one is looked at."""
    about = json.loads((frames / "transforms.json").read_text())
    width, height = about["w"], about["h"]
    encoder, decoder = av.CodecContext.create("libx264", "w"), av.CodecContext.create("h264", "r")
    encoder.width, encoder.height, encoder.pix_fmt = width, height, "yuv420p"
    encoder.time_base, encoder.framerate = 1 / Fraction(hz), Fraction(hz)
    encoder.thread_count = decoder.thread_count = 1
    encoder.options = {**OPTIONS, "crf": crf}
    shown = []
    for index, file in enumerate(sorted(frames.glob("*.yuv"))):
        samples = np.fromfile(file, np.uint8).reshape(height * 3 // 2, width)
        frame = av.VideoFrame.from_ndarray(samples, format="yuv420p")
        frame.pts = index
        (packet,) = encoder.encode(frame)
        (out / f"{index:04d}.packet").write_bytes(bytes(packet))
        shown += decoder.decode(packet)
    for index, picture in enumerate([*shown, *decoder.decode(None)]):
        picture.to_ndarray(format="yuv420p").tofile(out / f"{index:04d}.yuv")


if __name__ == "__main__":
    code(Path(sys.argv[1]), sys.argv[2], sys.argv[3], Path(sys.argv[4]))
