"""Read class pictures, which say what each pixel of a rendered picture shows.

``SPLIT/classes/N.png`` belongs to ``SPLIT/images/N.png`` and has its size. It is a PNG of one 8-bit
channel; each level is the number of the ``Label`` of the surface behind the pixel's centre.
"""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import DatasetError
from rfcore.image import read_rgb

PICTURES, CLASSES = "images", "classes"


class Label(IntEnum):
    """The classes of surfaces; the numbers are the levels of a class picture."""

    SKY = 0
    ROAD = 1
    MARKING = 2
    PAVEMENT = 3
    BUILDING = 4
    WINDOW = 5
    VEGETATION = 6
    VEHICLE = 7
    SIGN = 8
    POLE = 9
    WIRE = 10
    OBJECT = 11
    PERSON = 12
    BICYCLE = 13


def class_picture_of(picture: Path) -> Path:
    """Return where the class picture of ``SPLIT/images/N.png`` lies, whether it is there or not.

    Raises ``DatasetError`` for a picture in a folder of another name.
    """
    if picture.parent.name != PICTURES:
        raise DatasetError(
            f"{picture}: is not in a folder `{PICTURES}`, beside which `{CLASSES}` would be; class "
            "pictures come with `streetgen build`"
        )
    return picture.parent.with_name(CLASSES) / f"{picture.stem}.png"


def read_classes(path: Path) -> NDArray[np.uint8]:
    """Return the labels uint8 [H, W] of a class picture.

    Raises ``DatasetError`` naming the file if it cannot be read, has colours, or has a level that
    is no label.
    """
    rgb = read_rgb(path)
    labels = np.ascontiguousarray(rgb[..., 0])
    if (rgb != labels[..., None]).any():
        raise DatasetError(f"{path}: has colours; a class picture has one channel")
    if labels.max() >= len(Label):
        raise DatasetError(f"{path}: level {labels.max()} is no label, at most {len(Label) - 1}")
    return labels
