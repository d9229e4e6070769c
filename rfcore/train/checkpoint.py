"""Checkpoints: the complete state of a training run on disk, from which it ends with the same
bytes.

The container is that of fields (``rfcore.field.archive``), of kind ``checkpoint``: digests cover
every byte, and a file is replaced whole or not at all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.field.archive import Archive, decode_archive, encode_archive, read_file
from rfcore.files import write_whole

KIND = "checkpoint"


@dataclass(frozen=True)
class Checkpoint:
    """A run after ``iteration`` iterations.

    ``kind`` and ``training_digest`` identify the run; ``values`` (JSON) and ``arrays`` are the
    trainer's own.
    """

    kind: str
    training_digest: str
    iteration: int
    values: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]

    def check(self, kind: str, training_digest: str) -> None:
        """Raise ``InvalidInput`` unless this belongs to the run ``training_digest``."""
        if (self.kind, self.training_digest) != (kind, training_digest):
            raise InvalidInput(
                "checkpoint",
                f"is of {self.kind} run {self.training_digest[:12]}, not of {kind} run "
                f"{training_digest[:12]}: give the same pictures, settings and seed, or start anew",
            )


def write_checkpoint(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint, whole or not at all."""
    metadata = {
        "trainer": checkpoint.kind,
        "training_digest": checkpoint.training_digest,
        "iteration": checkpoint.iteration,
        "values": dict(checkpoint.values),
    }
    arrays = {name: np.ascontiguousarray(array) for name, array in checkpoint.arrays.items()}
    write_whole(path, encode_archive(Archive(KIND, metadata, arrays)))


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint; raise ``FieldFormatError`` naming the file and what is wrong."""
    archive = decode_archive(read_file(path), str(path))
    if archive.kind != KIND:
        raise FieldFormatError(f"{path}: holds '{archive.kind}', not a {KIND}")
    m = archive.metadata
    try:
        return Checkpoint(
            str(m["trainer"]),
            str(m["training_digest"]),
            int(m["iteration"]),
            dict(m["values"]),
            archive.arrays,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FieldFormatError(f"{path}: not a readable checkpoint ({error!r})") from error
