"""Rows of Arrow IPC files, which Feather 2 files are; pyarrow comes with the extra ``datasets``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rfcore.camera import Pose
from rfcore.dataset.keys import pose_of_quaternion, table_at
from rfcore.errors import DatasetError
from rfcore.extras import needs
from rfcore.tables import Table

PLACE, TURN = ("tx_m", "ty_m", "tz_m"), ("qw", "qx", "qy", "qz")


@contextmanager
def opened_arrow(file: Path, columns: Sequence[str]) -> Iterator[Any]:
    """Open a file that has these columns; what pyarrow raises becomes ``DatasetError``."""
    with needs("datasets"):
        import pyarrow as pa
        from pyarrow import ipc
    if not file.is_file():
        raise DatasetError(f"{file}: cannot be read (it does not exist)")
    try:
        with pa.memory_map(str(file)) as source:
            names = ipc.open_file(source).schema.names
            missing = [name for name in columns if name not in names]
            if missing:
                raise DatasetError(
                    f"{file}: has no column {', '.join(missing)}; it has {', '.join(names)}"
                )
            options = ipc.IpcReadOptions(included_fields=[names.index(name) for name in columns])
            yield ipc.open_file(source, options=options)
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"{file}: is no whole Arrow file ({error})") from error


def arrow_rows(file: Path, columns: Sequence[str]) -> list[tuple[str, Table]]:
    """Return the place and the values of each row.

    Raises ``DatasetError`` naming the file, and ``BackendUnavailable`` without pyarrow.
    """
    with opened_arrow(file, columns) as content:
        rows = content.read_all().to_pylist()
    places = (f"{file}: row {i}" for i in range(len(rows)))
    return [(where, table_at(where, row)) for where, row in zip(places, rows, strict=True)]


def arrow_metadata(file: Path) -> Any:
    """Return what 123D states of a file: the MessagePack at ``metadata`` of its schema."""
    with needs("datasets"):
        import msgpack
    with opened_arrow(file, ()) as content:
        packed = (content.schema.metadata or {}).get(b"metadata")
    if packed is None:
        raise DatasetError(f"{file}: its schema has no 'metadata', so it was not written by 123D")
    try:
        return msgpack.unpackb(packed)
    except (ValueError, msgpack.UnpackException) as error:
        raise DatasetError(f"{file}: its schema's metadata is not MessagePack ({error})") from error


def pose_of_row(where: str, row: Table) -> Pose:
    """Return the pose in the columns ``tx_m ty_m tz_m qw qx qy qz``."""
    place, turn = [row.number(key) for key in PLACE], [row.number(key) for key in TURN]
    return pose_of_quaternion(where, place, turn)
