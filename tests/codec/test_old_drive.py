"""Coded drives and fields from before the slice coder and the banded archive decode as ever.

``tests/data/drive_x264.rfv`` was written at revision 74e0c6c, whose only coder was x264: ``rfedge
encode samples/street/transforms_drive_vehicles.json --field street_grid1.rff --crf 40``. That field
is the 10 % level, without higher bands of colours, of the one that shipped then, compressed there.
"""

from pathlib import Path

from rfcore.codec.h264.config import Coder
from rfcore.field import load_field
from rfcore.wire.drive_file import read_drive
from rfedge.offline import decode_drive

DATA = Path(__file__).parents[1] / "data"


def test_a_drive_coded_before_there_was_a_slice_coder_decodes_to_its_digests() -> None:
    drive = read_drive(DATA / "drive_x264.rfv")
    config = drive.hello.cameras[0].codec.config
    assert (config.coder, config.effort) == (Coder.X264, "x264-medium")
    shown = list(decode_drive(drive, load_field(DATA / "street_grid1.rff")))
    assert [decoded.frame.digest() for decoded in shown] == [
        frame.packet.reconstruction_digest for frame in drive.frames
    ]
    assert len(shown) == 24
