"""Write delta_packets.npz: a frame of every kind as it goes over the wire, what decodes it.

Run ``PYTHONPATH=tests python tests/data/make_delta_packets.py`` only when the packet or the
codec's arithmetic must change.
"""

from pathlib import Path

import numpy as np

from codec.sent_streams import make_stream
from rfcore.wire.convert import client_message_to_bytes
from rfcore.wire.messages import CameraDescription, Frame, Hello, RendererContract

OUT = Path(__file__).with_name("delta_packets.npz")


def main() -> None:
    stream = make_stream()
    intrinsics = stream.frames[0].view.camera.intrinsics
    camera = CameraDescription("front", intrinsics, stream.header)
    hello = Hello("golden", (camera,), ("ab" * 32,), RendererContract("golden", exact=True))
    arrays = {"hello": np.frombuffer(client_message_to_bytes(hello), np.uint8)}
    for index, sent in enumerate(stream.frames):
        pose = sent.view.camera.world_from_cam
        message = Frame("front", index, pose, b"", sent.packet)
        arrays[f"frame{index}"] = np.frombuffer(client_message_to_bytes(message), np.uint8)
        arrays[f"depth{index}"] = sent.view.depth
        for name, plane in zip("yuv", sent.view.render.planes, strict=True):
            arrays[f"{name}{index}"] = plane
    np.savez_compressed(OUT, **arrays)


if __name__ == "__main__":
    main()
