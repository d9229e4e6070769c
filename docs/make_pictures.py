"""Draw the picture at the top of README: camera, render, difference, reconstruction.

``python docs/make_pictures.py`` writes ``docs/images/frame.jpg`` from the sample street, coded as
`rfedge demo` codes it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from rfcore.dataset import read_dataset
from rfcore.field import load_field
from rfcore.native.yuv import rgb_from_i420
from rfedge.offline import CodingSettings, decode_drive, encode_drive

ROOT = Path(__file__).parents[1]
OUT = ROOT / "docs" / "images" / "frame.jpg"
DRIVE = ROOT / "samples" / "street" / "transforms_drive_vehicles.json"
FIELD = ROOT / "samples" / "fields" / "street.rff"
FRAME = 12
"""Index of the picture in the drive: one with parked and moving vehicles."""
CRF = 23.0
"""Quality that `rfedge demo` codes at."""
GAIN = 3
"""Factor by which the drawn difference is amplified around mid-grey."""


def main() -> None:
    """Code the drive up to one picture and draw that picture's way."""
    drive, field = read_dataset(DRIVE), load_field(FIELD)
    drive = replace(drive, pictures=drive.pictures[: FRAME + 1])
    coded = encode_drive(drive, field, CodingSettings(crf=CRF))
    *_, last = decode_drive(coded, field)
    payload = len(coded.frames[-1].packet.payload)
    camera = drive.pictures[FRAME].read()
    colour = field.render_colour(drive.pictures[FRAME].camera)
    render = np.round(np.clip(colour, 0, 1) * 255).astype(np.uint8)
    shown = 128 + (camera.astype(np.int16) - render) * GAIN
    difference = np.clip(shown, 0, 255).astype(np.uint8)
    panels = {
        "What the camera sees": camera,
        "What both ends render from the field": render,
        f"The difference (x {GAIN}), sent as one P slice of {payload:,} bytes": difference,
        "What the server reconstructs": rgb_from_i420(last.frame),
    }
    figure = Figure(figsize=(12.8, 7.7), dpi=100)
    for place, (title, picture) in enumerate(panels.items(), 1):
        axes = figure.add_subplot(2, 2, place)
        axes.imshow(picture, interpolation="lanczos")
        axes.set_title(title, fontsize=15)
        axes.set_axis_off()
    figure.subplots_adjust(0.005, 0.005, 0.995, 0.955, 0.01, 0.09)
    OUT.parent.mkdir(exist_ok=True)
    figure.savefig(OUT, pil_kwargs={"quality": 84})


if __name__ == "__main__":
    main()
