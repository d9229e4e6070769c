"""Packets of every kind, coded once and for all, decode to the digests they carry.

``tests/data/delta_packets.npz`` holds them as they go over the wire, with renders and depth; see
make_delta_packets.py there.
"""

from pathlib import Path

import numpy as np

from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.references import Reference
from rfcore.image import I420
from rfcore.views import FieldView
from rfcore.wire.convert import client_message_from_bytes
from rfcore.wire.head import FrameReader
from rfcore.wire.messages import Hello

GOLDEN = Path(__file__).parents[1] / "data" / "delta_packets.npz"


def test_golden_packets_decode_to_their_digests():
    with np.load(GOLDEN, allow_pickle=False) as stored:
        arrays = dict(stored)
    hello = client_message_from_bytes(arrays["hello"].tobytes())
    assert isinstance(hello, Hello)
    camera = hello.cameras[0]
    decoder, reader = DeltaDecoder(camera.codec), FrameReader(hello)
    state = decoder.start(1)
    used: set[Reference] = set()
    found = 0
    for index in range(9):
        frame = reader.frame(arrays[f"frame{index}"].tobytes())
        render = I420(*(arrays[f"{name}{index}"] for name in "yuv"))
        view = FieldView(frame.camera(camera.intrinsics), render, arrays[f"depth{index}"])
        decoded = decoder.decode(state, frame.packet, view)
        assert decoded.frame.digest().startswith(frame.packet.reconstruction_digest)
        state = decoded.state
        used |= set(frame.packet.references)
        found += frame.packet.relit
    assert used == set(Reference)
    assert found == 2
