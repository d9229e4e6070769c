"""A real reader's process on an MCAP file: one that is being written, and one that is finished."""

import numpy as np
import pytest

import bags
from cav_agent.live.reader import EndRecord
from cav_agent.live.settings import ReaderSettings, SourceKind, parse_address
from cav_agent.live.source import ReaderProcess

WAIT_S = 15.0


def records(text):
    """Yield the records of a source, the end last."""
    process = ReaderProcess(ReaderSettings(parse_address(text), 5.0, 1000.0))
    try:
        while True:
            record = process.read(WAIT_S)
            assert record is not None, f"nothing came within {WAIT_S} s"
            yield record
            if isinstance(record, EndRecord):
                return
    finally:
        process.close()


def test_the_newest_picture_comes_while_the_file_is_written(tmp_path):
    content = bags.in_small_chunks(bags.drive(4).write(tmp_path / "bag")).read_bytes()
    at = content.index(bags.rgb(2).tobytes()) + 100
    growing = tmp_path / "growing.mcap"
    growing.write_bytes(content[:at])
    found = records(str(growing))
    frame = next(found)
    while frame.pts_ns < bags.time_ns(1):
        frame = next(found)
    assert frame.pts_ns == frame.sender_ns == bags.time_ns(1)
    np.testing.assert_array_equal(frame.rgb, bags.rgb(1))
    with growing.open("ab") as file:
        file.write(content[at:])
    *_, last, end = found
    assert last.pts_ns == bags.time_ns(3)
    np.testing.assert_array_equal(last.rgb, bags.rgb(3))
    assert end.is_whole


def test_a_finished_file_is_played_and_its_camera_is_named(tmp_path):
    made = bags.drive(2)
    made.add("/rear/image_raw", bags.rgb_image(bags.time_ns(0), bags.rgb(9)), bags.time_ns(0))
    path = bags.in_small_chunks(made.write(tmp_path / "bag"))
    *_, end = records(str(path))
    assert "several cameras" in end.problem
    assert f"name one, {path}#/" in end.problem
    *frames, end = records(f"{path}#/rear/image_raw")
    assert [frame.pts_ns for frame in frames] == [bags.time_ns(0)]
    assert frames[0].sender_ns is None
    assert end.is_whole


@pytest.mark.parametrize("text", ["a/b.mcap", "a/b.MCAP#/front/image_raw"])
def test_an_mcap_file_is_told_by_its_name(text):
    address = parse_address(text)
    path, _, topic = text.partition("#")
    assert (address.kind, address.url) == (SourceKind.BAG, path)
    assert address.options.get("topic", "") == topic
