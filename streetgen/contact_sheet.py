"""Put pictures of several built scenes on one page, a row for each scene."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rfcore.errors import DatasetError, InvalidInput
from rfcore.files import write_whole

Bgr = NDArray[np.uint8]
CAPTION_PX = 22
GAP_PX = 4
PAPER = 250
QUALITIES = range(88, 20, -4)


def write_contact_sheet(
    folders: Sequence[Path], out: Path, columns: int, width_px: int, max_bytes: int
) -> int:
    """Write the sheet as JPEG at the best quality that fits, and return its size in bytes.

    ``width_px`` is that of the whole sheet. Raises ``InvalidInput`` where even the lowest quality
    does not fit, ``DatasetError`` for a folder that is no built scene.
    """
    sheet = contact_sheet(folders, columns, width_px)
    for quality in QUALITIES:
        done, coded = cv2.imencode(".jpg", sheet, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if done and len(coded) <= max_bytes:
            write_whole(out, coded.tobytes())
            return len(coded)
    raise InvalidInput("max_bytes", f"{max_bytes} is too few for {sheet.shape[1]} px; take less")


def contact_sheet(folders: Sequence[Path], columns: int, width_px: int) -> Bgr:
    """Return the sheet as BGR: a caption and ``columns`` pictures, evenly chosen, a scene."""
    cell_px = (width_px - GAP_PX * (columns + 1)) // columns
    if not folders or cell_px < 16:
        raise InvalidInput("columns", f"{columns} of {width_px} px leave {cell_px} px a picture")
    rows = [_row(folder, columns, cell_px, width_px) for folder in folders]
    return np.concatenate(rows)


def _row(folder: Path, columns: int, cell_px: int, width_px: int) -> Bgr:
    pictures = sorted(folder.glob("*/images/*.png"))
    if not pictures:
        raise DatasetError(f"{folder}: no pictures in SPLIT/images; streetgen build makes them")
    count = min(columns, len(pictures))
    chosen = [pictures[i] for i in np.linspace(0, len(pictures) - 1, count).round().astype(int)]
    cells = [_cell(path, cell_px) for path in chosen]
    height = max(len(cell) for cell in cells)
    row = np.full((CAPTION_PX + height + GAP_PX, width_px, 3), PAPER, np.uint8)
    cv2.putText(
        row,
        _name(folder),
        (GAP_PX, 16),
        cv2.FONT_HERSHEY_SIMPLEX,
        0.5,
        (20, 20, 20),
        1,
        cv2.LINE_AA,
    )
    for i, cell in enumerate(cells):
        left = GAP_PX + i * (cell_px + GAP_PX)
        row[CAPTION_PX : CAPTION_PX + len(cell), left : left + cell_px] = cell
    return row


def _cell(path: Path, cell_px: int) -> Bgr:
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise DatasetError(f"{path}: is not a picture that can be read")
    height = round(picture.shape[0] * cell_px / picture.shape[1])
    return np.asarray(
        cv2.resize(picture, (cell_px, height), interpolation=cv2.INTER_AREA), np.uint8
    )


def _name(folder: Path) -> str:
    build = folder / "build.json"
    try:
        return str(json.loads(build.read_text(encoding="utf-8"))["scene"]["name"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{build}: does not name a scene; is this a built one?") from error
