"""A real vehicle and a real server in one process, over loopback."""

import json
from pathlib import Path

from rfcore.image import read_rgb
from rfcore.raster.native import available_isas


async def test_the_server_sees_what_the_vehicle_sees(street, serve, travel, tmp_path) -> None:
    async with serve(save=tmp_path / "saved") as server:
        trip = await travel(server)
    print(trip)
    assert trip.counts == {"acked": 6}
    folder = tmp_path / "saved/cav-1/front"
    index = [json.loads(line) for line in (folder / "index.jsonl").read_text().splitlines()]
    assert [line["digest"] for line in index] == [
        line["reconstruction_digest"] for line in trip.lines
    ]
