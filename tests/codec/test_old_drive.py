"""Coded drives from before the slice coder decode as ever.

``tests/data/drive_x264.rfv`` was written at revision 74e0c6c, whose only coder was x264:
``rfedge encode samples/street/transforms_drive_vehicles.json --field samples/fields/street.rff
--crf 38``.
"""

from pathlib import Path

import pytest

from rfcore.codec.h264.config import Coder
from rfcore.field import load_field
from rfcore.wire.drive_file import read_drive
from rfedge.offline import decode_drive
from rfedge.samples import sample_path

DRIVE = Path(__file__).parents[1] / "data/drive_x264.rfv"


@pytest.mark.sample
def test_a_drive_coded_before_there_was_a_slice_coder_decodes_to_its_digests() -> None:
    drive = read_drive(DRIVE)
    config = drive.hello.cameras[0].codec.config
    assert (config.coder, config.effort) == (Coder.X264, "x264-medium")
    shown = list(decode_drive(drive, load_field(sample_path("fields/street.rff"))))
    assert [decoded.frame.digest() for decoded in shown] == [
        frame.packet.reconstruction_digest for frame in drive.frames
    ]
    assert len(shown) == 24
