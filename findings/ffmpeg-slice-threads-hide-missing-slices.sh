#!/usr/bin/env bash
# FFmpeg 8, libavcodec 62.28 (PyAV 18.1.0): a picture that lacks slices is flagged as corrupt with one
# thread, and passes as whole with threads by slice, the usual advice for a decoder of low delay
# (threads by frame delay each picture). With slice threads libavcodec's error resilience is off by
# default, and the flag goes with it. Pictures predicted from the damaged one are flagged in neither.
# Seen: one thread: 1 of 20 flagged, 13 differ from the sent ones; slice threads: 0 flagged, 13 differ.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q av==18.1.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PY'
from fractions import Fraction

import av
import numpy as np

WIDTH, HEIGHT, LOST = 640, 352, 7
coder = av.CodecContext.create("libx264", "w")
coder.width, coder.height, coder.pix_fmt = WIDTH, HEIGHT, "yuv420p"
coder.time_base, coder.framerate, coder.gop_size = Fraction(1, 10), Fraction(10), 20
coder.options = {"crf": "30", "tune": "zerolatency", "x264-params": "slices=4:sliced-threads=0"}
tiles = np.random.default_rng(3).integers(0, 255, (HEIGHT // 8, 100, 3), np.uint8)
wall = tiles.repeat(8, 0).repeat(8, 1)
packets = []
for i in range(20):
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(wall[:, 3 * i : 3 * i + WIDTH]))
    frame.pts, frame.time_base = i, Fraction(1, 10)
    packets += coder.encode(frame)
packets += coder.encode(None)


def without_last_slices(packet):
    """Leave out the last two of a picture's four slices, as lost datagrams do."""
    data = bytes(packet)
    starts = [at for at in range(len(data) - 3) if data[at : at + 3] == b"\0\0\1"]
    cut = av.Packet(data[: starts[-2]])
    cut.pts, cut.dts = packet.pts, packet.dts
    return cut


def decoded(packets, by_slice):
    context = av.CodecContext.create("h264", "r")
    if by_slice:
        context.thread_type = "SLICE"
    else:
        context.thread_count = 1
    pictures, flagged = {}, []
    for packet in [*packets, None]:
        for frame in context.decode(packet):
            pictures[frame.pts] = frame.to_ndarray().tobytes()
            flagged += [frame.pts] if frame.is_corrupt else []
    return pictures, flagged


damaged = [without_last_slices(p) if p.pts == LOST else p for p in packets]
truth, _ = decoded(packets, by_slice=False)
seen = {}
for by_slice in (False, True):
    pictures, flagged = decoded(damaged, by_slice)
    wrong = [at for at in truth if pictures.get(at) != truth[at]]
    seen[by_slice] = (flagged, wrong)
    how = "slice threads" if by_slice else "one thread"
    print(f"{how}: flagged {flagged}, not as sent {wrong}")
expected = list(range(LOST, 20))
assert seen[False] == ([LOST], expected), "one thread: changed"
assert seen[True] == ([], expected), "slice threads: changed"
PY
echo "as seen: PyAV 18.1.0"
