"""Points of a PLY file that are damaged name the file."""

import pytest

from rfcore.dataset.source import read_points
from rfcore.errors import DatasetError

HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {n}\n"
    "property float x\nproperty float y\nproperty float z\n"
    "property {colour} red\nproperty uchar green\nproperty uchar blue\nend_header\n"
)


@pytest.mark.parametrize(
    ("header", "rows", "named"),
    [
        (HEADER.format(n=2, colour="uchar"), bytes(15), "30 bytes"),
        (HEADER.format(n=2_000_000_000, colour="uchar"), bytes(15), "30000000000 bytes"),
        (HEADER.format(n=1, colour="char"), bytes(15), "must be uchar"),
        (HEADER.format(n=1, colour="uchar").replace("red", "rot"), bytes(15), "no vertex.* red"),
        (HEADER.format(n=1, colour="uchar"), b"\0\0\xc0\x7f" + bytes(11), "not finite"),
    ],
)
def test_damaged_points_are_refused(tmp_path, header, rows, named):
    file = tmp_path / "points.ply"
    file.write_bytes(header.encode() + rows)
    with pytest.raises(DatasetError, match=rf"points\.ply.*{named}"):
        read_points(file)
