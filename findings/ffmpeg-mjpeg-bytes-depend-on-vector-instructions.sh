#!/usr/bin/env bash
# PyAV 18.1.0 (FFmpeg in its wheel): the MJPEG encoder gives other bytes for the same picture at the
# same quantiser where vector instructions are off. With dct=int they are equal.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q av==18.1.0 numpy==2.4.6
cat > "$folder/code.py" <<'PY'
import ctypes
import hashlib
import re
import sys
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

without_vectors, options = sys.argv[1] == "scalar", dict(qmin="3", qmax="3")
if sys.argv[2] == "int":
    options["dct"] = "int"
maps = Path("/proc/self/maps").read_text()
library = ctypes.CDLL(re.search(r"\S*libavutil\S*\.so\S*", maps)[0])
if without_vectors:
    library.av_force_cpu_flags(0)
y, x = np.mgrid[:128, :192]
rgb = np.stack([(x * 7 + y * 3) % 256, (x * y) % 256, (x * 2 + y * 11) % 256], -1).astype(np.uint8)
frame = av.VideoFrame(192, 128, "yuvj420p")
for plane, values in zip(frame.planes, (rgb[..., 0], rgb[::2, ::2, 1], rgb[::2, ::2, 2])):
    padded = np.zeros((plane.height, plane.line_size), np.uint8)
    padded[:, : plane.width] = values
    plane.update(padded.tobytes())
encoder = av.CodecContext.create("mjpeg", "w")
encoder.width, encoder.height, encoder.pix_fmt = 192, 128, "yuvj420p"
encoder.time_base, encoder.options = Fraction(1, 1), options
data = b"".join(bytes(packet) for packet in [*encoder.encode(frame), *encoder.encode(None)])
print(hashlib.sha256(data).hexdigest()[:16], len(data))
PY
coded() { "$folder/venv/bin/python" "$folder/code.py" "$@" 2> /dev/null; }
vector=$(coded vector usual); scalar=$(coded scalar usual)
vector_int=$(coded vector int); scalar_int=$(coded scalar int)
printf 'usual: vector %s, scalar %s\ndct=int: vector %s, scalar %s\n' "$vector" "$scalar" "$vector_int" "$scalar_int"
[ "$vector" != "$scalar" ] && [ "$vector_int" = "$scalar_int" ] || { echo changed; exit 1; }
echo "as seen: PyAV 18.1.0"
