"""A coded drive comes back as it was written; anything less is one clear error."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rfcore.errors import InvalidData
from rfcore.wire.convert import hello_to_bytes
from rfcore.wire.drive_file import MAGIC, CodedDrive, read_drive, write_drive
from rfcore.wire.head import FrameWriter
from rfcore.wire.messages import Frame, Hello


@pytest.fixture
def drive(hello: Hello, frame: Frame) -> CodedDrive:
    packets = [replace(frame.packet, sequence=i, payload=b"p" * (i * 50 + 1)) for i in range(4)]
    return CodedDrive(hello, tuple(replace(frame, packet=packet) for packet in packets))


def test_a_drive_survives_the_file(drive: CodedDrive, tmp_path: Path) -> None:
    write_drive(tmp_path / "a.rfv", drive)
    assert read_drive(tmp_path / "a.rfv") == drive
    assert [p.name for p in tmp_path.iterdir()] == ["a.rfv"], "no partial file is left"


def test_every_truncation_is_noticed_except_between_messages(
    drive: CodedDrive, tmp_path: Path
) -> None:
    write_drive(tmp_path / "a.rfv", drive)
    whole = (tmp_path / "a.rfv").read_bytes()
    read_back = []
    for end in range(len(whole)):
        (tmp_path / "b.rfv").write_bytes(whole[:end])
        with suppress(InvalidData):
            read_back.append(len(read_drive(tmp_path / "b.rfv").frames))
    assert read_back == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (b"", "first bytes are wrong"),
        (b"RFV1\n\n\x1a\n", "first bytes are wrong"),
        (MAGIC, "message 0 is not a Hello"),
        (
            MAGIC + b"\xff\xff\xff\x7f" + b"x",
            "message 0: claims 268435455 bytes, the limit is 1048576",
        ),
        (MAGIC + b"\xff" * 10, "message 0: Too many bytes when decoding varint"),
        (MAGIC + b"\x80", "message 0: Fail to read varint"),
        (MAGIC + b"\x00", "message 0: message: is neither hello nor frame"),
        (MAGIC + b"\x01", "message 0: Truncated message"),
        (MAGIC + b"\xff" * 9 + b"\x01x", "message 0: claims 18446744073709551615 bytes"),
        (MAGIC + b"\x05abc", "message 0: truncated: it has 3 of its 5 bytes"),
        (MAGIC + b"\x03abc", "message 0: Error parsing message"),
    ],
)
def test_what_is_no_drive_is_refused(tmp_path: Path, content: bytes, named: str) -> None:
    (tmp_path / "a.rfv").write_bytes(content)
    with pytest.raises(InvalidData, match=named):
        read_drive(tmp_path / "a.rfv")


def test_a_frame_of_an_unnamed_camera_is_refused(drive: CodedDrive, tmp_path: Path) -> None:
    hello, (front,) = drive.hello, drive.hello.cameras
    more = replace(hello, cameras=(front, replace(front, camera_id="rear")))
    stranger = replace(drive.frames[0], camera_id="rear")
    write_drive(tmp_path / "a.rfv", CodedDrive(hello, ()))
    message = FrameWriter(more).message(stranger, None)
    with (tmp_path / "a.rfv").open("ab") as file:
        file.write(bytes([len(message) & 0x7F | 0x80, len(message) >> 7]) + message)
    with pytest.raises(InvalidData, match=r"message 1: .*frame.camera: 1 where Hello has 0..0"):
        read_drive(tmp_path / "a.rfv")


def test_a_drive_without_one_of_its_messages_is_refused_after_it(drive, tmp_path):
    write_drive(tmp_path / "whole.rfv", drive)
    _, _, third, _ = FrameWriter(drive.hello).in_order(drive.frames)
    data = (tmp_path / "whole.rfv").read_bytes()
    at = data.index(third)
    assert len(third) > 127, "its length takes two bytes"
    (tmp_path / "a.rfv").write_bytes(data[: at - 2] + data[at + len(third) :])
    with pytest.raises(InvalidData, match="message 3: unknown_state"):
        read_drive(tmp_path / "a.rfv")


def test_a_second_hello_is_refused(drive: CodedDrive, tmp_path: Path) -> None:
    write_drive(tmp_path / "a.rfv", CodedDrive(drive.hello, ()))
    data = hello_to_bytes(drive.hello)
    with (tmp_path / "a.rfv").open("ab") as file:
        file.write(bytes([len(data) & 0x7F | 0x80, len(data) >> 7]) + data)
    with pytest.raises(InvalidData, match="message 1 is a second Hello"):
        read_drive(tmp_path / "a.rfv")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(tail=st.binary(max_size=300))
def test_garbage_after_the_magic_raises_our_error_only(tmp_path: Path, tail: bytes) -> None:
    (tmp_path / "a.rfv").write_bytes(MAGIC + tail)
    with pytest.raises(InvalidData):
        read_drive(tmp_path / "a.rfv")
