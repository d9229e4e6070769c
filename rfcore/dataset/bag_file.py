"""Tell bags by their content, without the packages that read them: MCAP files and ROS 2 bags."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

from rfcore.errors import DatasetError

MAGICS = {b"\x89MCAP": ".mcap", b"SQLite format 3": ".db3"}
ROS1 = b"#ROSBAG"
WHOLE = (".mcap.zstd", ".db3.zstd")


def is_bag(path: Path) -> bool:
    """Tell whether a file, by its content, or a folder, by its files, is a bag."""
    if path.is_dir():
        return bool(bag_files(path))
    if not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(16)
    return start.startswith((*MAGICS, ROS1)) or path.name.endswith(WHOLE)


def bag_files(path: Path) -> list[Path]:
    """Return the files of one recording, in the order of their numbers."""
    if not path.is_dir():
        return [path]
    found = [file for file in path.iterdir() if file.name.endswith((*MAGICS.values(), *WHOLE))]
    return sorted(found, key=lambda file: [int(n) for n in re.findall(r"\d+", file.name)])


def refuse_other_bags(file: Path) -> None:
    """Raise ``DatasetError`` for a bag that is to be converted first, saying how."""
    name = shlex.quote(str(file))
    with file.open("rb") as content:
        start = content.read(16)
    if start.startswith(ROS1):
        to = shlex.quote(str(file.with_suffix("")))
        raise DatasetError(
            f"{file}: is a bag of ROS 1, which is not read: rosbags-convert --src {name} --dst {to}"
        )
    if file.name.endswith(WHOLE):
        raise DatasetError(f"{file}: is packed as a whole; unpack it first: zstd -d {name}")
    log = Path(f"{file}-wal")
    if log.exists() and log.stat().st_size:
        raise DatasetError(
            f"{file}: some of its messages are in {log.name} still; put them into it: "
            f'sqlite3 {name} "PRAGMA wal_checkpoint(TRUNCATE)"'
        )
