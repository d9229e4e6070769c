"""``dataparser_transforms.json``: how nerfstudio normalised the scene a ``.ply`` was trained in.

``{"transform": 3x4, "scale": s}`` with p_field = s * (transform @ (p_world, 1)). In the world,
not in that frame, are the dataset's poses and everything else of ours.
"""

from __future__ import annotations

import json
from pathlib import Path

from rfcore.camera import Pose
from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.field.similarity import Similarity

__all__ = ["read_field_from_world"]


def read_field_from_world(path: Path) -> Similarity:
    """Return ``field_from_world``; raise ``FieldFormatError`` naming the file and the fault."""
    try:
        content = json.loads(path.read_bytes())
        scale = float(content["scale"])
        pose = Pose.from_matrix(content["transform"])
        x, y, z = (scale * value for value in pose.translation_m)
        return Similarity(Pose((x, y, z), pose.rotation), scale)
    except OSError as error:
        raise FieldFormatError(f"{path}: cannot be read ({error.strerror})") from error
    except (KeyError, TypeError, ValueError, InvalidInput) as error:
        raise FieldFormatError(
            f'{path}: not {{"transform": 3x4, "scale": s}} of nerfstudio ({error})'
        ) from error
