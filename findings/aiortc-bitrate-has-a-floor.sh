#!/usr/bin/env bash
# aiortc 1.16.0: a peer that is told by REMB that its path carries 100 kbit/s goes on at 500 kbit/s
# with H.264 and at 250 kbit/s with VP8: the encoders' target_bitrate is raised to a floor of their
# own, without a word. On a link below the floor the queue grows until packets are lost; a
# comparison on thin links is not one of congestion control.
# Seen: H264Encoder asked for 100,000 bit/s has 500,000, Vp8Encoder 250,000; three seconds of a
# textured 640x360 at 30 Hz then take 0.48 and 0.27 Mbit/s.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q aiortc==1.16.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PY'
from fractions import Fraction

import numpy as np
from aiortc.codecs.h264 import H264Encoder
from aiortc.codecs.vpx import Vp8Encoder
from av import VideoFrame

ASKED_BPS, HZ, FRAMES = 100_000, 30, 90
texture = np.random.default_rng(0).integers(0, 255, (360, 1280, 3), np.uint8)
for name, encoder, floor_bps in (("H.264", H264Encoder(), 500_000), ("VP8", Vp8Encoder(), 250_000)):
    encoder.target_bitrate = ASKED_BPS
    assert encoder.target_bitrate == floor_bps, f"{name}: {encoder.target_bitrate}: changed"
    sent = 0
    for number in range(FRAMES):
        shown = np.ascontiguousarray(texture[:, 4 * number : 4 * number + 640])
        frame = VideoFrame.from_ndarray(shown, "rgb24")
        frame.pts, frame.time_base = number * 90_000 // HZ, Fraction(1, 90_000)
        payloads, _ = encoder.encode(frame)
        sent += sum(map(len, payloads))
    bps = 8 * sent * HZ / FRAMES
    print(f"{name}: asked for {ASKED_BPS}, set to {encoder.target_bitrate}, sent {bps:.0f} bit/s")
    assert bps > 2 * ASKED_BPS, f"{name}: {bps:.0f} bit/s: changed"
PY
echo "as seen: aiortc 1.16.0"
