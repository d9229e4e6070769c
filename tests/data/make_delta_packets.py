"""Write delta_packets.npz: a frame of every kind as it goes over the wire, what decodes it.

Run ``PYTHONPATH=tests python tests/data/make_delta_packets.py`` only when the packet or the
codec's arithmetic must change.
"""

from pathlib import Path

import numpy as np

from codec.sent_streams import make_stream, sent_frames
from rfcore.wire.convert import hello_to_bytes

OUT = Path(__file__).with_name("delta_packets.npz")


def main() -> None:
    stream = make_stream()
    hello, frames = sent_frames(stream)
    arrays = {"hello": np.frombuffer(hello_to_bytes(hello), np.uint8)}
    for index, (sent, (data, _)) in enumerate(zip(stream.frames, frames, strict=True)):
        arrays[f"frame{index}"] = np.frombuffer(data, np.uint8)
        arrays[f"depth{index}"] = sent.view.depth
        for name, plane in zip("yuv", sent.view.render.planes, strict=True):
            arrays[f"{name}{index}"] = plane
    np.savez_compressed(OUT, **arrays)


if __name__ == "__main__":
    main()
