"""A field is shown while it is trained, and training hardly notices."""

import json
import socket
import struct
from typing import Any

import aiohttp
import pytest

from rfcore.errors import RfedgeError
from rfcore.field import load_field
from rfcore.wire.address import Address
from rfedge.training.view import SHARE, Snapshots, shown_in_browser
from rfedge.twin.drive_source import FollowedFile
from rfedge.twin.web import WebSettings
from wall_scene import wall_field


class Wall:
    """A trainer of a wall that grows lighter; making its field takes ``slow_s``."""

    def __init__(self, slow_s: float = 0.0) -> None:
        self.now_s, self.level, self.slow_s = 100.0, 0.0, slow_s

    def field(self) -> Any:
        self.now_s += self.slow_s
        self.level += 0.01
        return wall_field(self.level)


@pytest.mark.parametrize("slow_s", [0.01, 0.4, 5.0])
def test_snapshots_take_no_more_than_their_share(slow_s, tmp_path):
    wall = Wall(slow_s)
    snapshots = Snapshots(tmp_path / "field.rff", lambda: wall.now_s)
    for _ in range(5000):
        wall.now_s += 0.2  # an iteration
        snapshots(wall)
    assert snapshots.count >= 2
    assert snapshots.count * slow_s <= SHARE * (wall.now_s - 100.0) + slow_s


def test_a_followed_file_is_read_each_time_that_it_is_written(tmp_path):
    wall, path = Wall(), tmp_path / "field.rff"
    followed = FollowedFile(path)
    assert followed.newer() is None, "not yet written"
    snapshots = Snapshots(path, lambda: wall.now_s)
    ids = []
    for _ in range(2):
        snapshots(wall)
        newer = followed.newer()
        ids.append(newer.field_id)
        assert followed.newer() is None, "the same file"
        wall.now_s += 60.0
    assert ids[1] == load_field(path).field_id != ids[0]


@pytest.mark.slow
async def test_the_page_shows_what_was_written_and_goes_with_the_training():
    wall, told = Wall(), list[str]()
    settings = WebSettings(Address("127.0.0.1", 0))
    with shown_in_browser(settings, None, told.append) as snapshots:
        snapshots(wall)
        assert await first_field(told[0]) == wall_field(wall.level).primitives
    async with aiohttp.ClientSession() as session:
        with pytest.raises(aiohttp.ClientConnectionError):
            await session.get(told[0])


async def first_field(url: str) -> int:
    """Return how many splats the first field has that a browser is told of."""
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{url}socket", headers={"Origin": url.rstrip("/")}) as told,
    ):
        while True:
            data = await told.receive_bytes(timeout=60)
            (length,) = struct.unpack_from("<I", data)
            header = json.loads(data[4 : 4 + length])
            if header["kind"] == "fields":
                return int(header["fields"][0]["primitives"])


@pytest.mark.slow
def test_a_page_that_cannot_be_served_says_why():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        settings = WebSettings(Address("127.0.0.1", taken.getsockname()[1]))
        with (
            pytest.raises(RfedgeError, match=r"(?s)cannot be served: .*in use"),
            shown_in_browser(settings, None, lambda _: None),
        ):
            pytest.fail("the page was served on a port that is taken")
