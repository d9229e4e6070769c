#!/usr/bin/env bash
# pycolmap 4.2.1 (its wheel): a WebP picture is not read, and nobody is told. Bitmap.read returns None
# and extract_features ends without an error; the picture is missing in the database, so mapping ends
# with no pair to start from, as for pictures that do not overlap. The same pixels as PNG are read.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q pycolmap==4.2.1 numpy==2.4.6 pillow==12.0.0
"$folder/venv/bin/python" - "$folder" <<'PY'
import sys
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

folder = Path(sys.argv[1])
images = folder / "images"
images.mkdir()
noise = np.random.default_rng(1).integers(0, 255, (60, 80, 3), np.uint8).repeat(4, 0).repeat(4, 1)
Image.fromarray(noise).save(images / "a.png")
Image.fromarray(noise).save(images / "b.webp", lossless=True)
pycolmap.extract_features(folder / "all.db", images, device=pycolmap.Device.cpu)
with pycolmap.Database.open(folder / "all.db") as database:
    seen = sorted(image.name for image in database.read_all_images())
png, webp = (pycolmap.Bitmap.read(str(images / name), True) for name in ("a.png", "b.webp"))
print(f"in the database: {seen}; Bitmap.read: PNG {png is not None}, WebP {webp is not None}")
assert seen == ["a.png"], "changed"
assert png is not None, "changed"
assert webp is None, "changed"
PY
echo "as seen: pycolmap 4.2.1"
