"""A vehicle with a deadline and a server: a small one means a lower rung, and the
server's pictures are still the vehicle's to the byte."""

import json
from pathlib import Path
from typing import Any

import pytest

from cav_agent.field_cache import SHIPPED_LADDER
from rfcore.codec.sender.ladder import read_ladder
from rfcore.errors import InvalidData

FULL, LOW = "100% 3ref fast", "10% sh0 render-only fast"


def write_ladder(path: Path, full_ms: float, low_ms: float) -> Path:
    """Write a ladder of two rungs that take so long by what it says."""

    def row(ms: float, rate: float, **knobs: Any) -> dict[str, Any]:
        settings = {
            "kind": "splats", "detail": 1.0, "sh_degree": None, "samples_per_ray": None,
            "scale": 1.0, "references": 3, "photometric": True, "effort": "fast",
            "crf": 23.0, **knobs,
        }  # fmt: skip
        return {"settings": settings, "sender_ms": ms, "receiver_ms": 1.0, "rate_percent": rate}

    rows = [row(full_ms, 0.0), row(low_ms, 90.0, detail=0.1, sh_degree=0, references=0)]
    path.write_text(json.dumps({"kind": "ladder", "rows": rows, "tracking": []}))
    return path


@pytest.mark.parametrize(("deadline_ms", "first"), [(1.0, LOW), (60_000.0, FULL)])
async def test_a_small_deadline_chooses_a_lower_rung_and_the_pictures_stay_equal(
    serve: Any, travel: Any, tmp_path: Path, deadline_ms: float, first: str
) -> None:
    ladder = write_ladder(tmp_path / "ladder.json", 1e3, 1e-3)
    async with serve() as server:
        lines = (await travel(server.address, deadline_ms=deadline_ms, ladder=ladder)).lines
    assert lines[0]["rung"] == first
    if first == LOW:
        assert {line["rung"] for line in lines} == {LOW}
        assert {tuple(line["references"]) for line in lines} == {("render",)}
    for line in lines:
        assert line["result"] == "acked", line["reason"]
        assert line["server_digest"] == line["reconstruction_digest"]


async def test_frames_on_different_rungs_follow_each_other_in_one_stream(
    serve: Any, travel: Any, tmp_path: Path
) -> None:
    """A ladder of a machine a million times slower: its low rung is all that seems to fit, until
    the first frame shows how quick this one is."""
    ladder = write_ladder(tmp_path / "ladder.json", 1e9, 9e8)
    async with serve() as server:
        record = await travel(server.address, deadline_ms=60_000.0, ladder=ladder)
    assert record.counts == {"acked": len(record.lines)}
    assert [line["rung"] for line in record.lines[:2]] == [LOW, FULL]
    for line in record.lines:
        assert line["server_digest"] == line["reconstruction_digest"]


async def test_a_vehicle_that_localises_wants_a_ladder_with_times_of_tracking(
    serve: Any, travel: Any, tmp_path: Path
) -> None:
    ladder = write_ladder(tmp_path / "ladder.json", 1e3, 1e-3)
    async with serve() as server:
        with pytest.raises(InvalidData, match=r"no times of tracking.*rfedge eval ladder"):
            await travel(server.address, deadline_ms=33.0, ladder=ladder, localise=True)


async def test_a_deadline_without_a_ladder_says_how_to_make_one(
    serve: Any, travel: Any, tmp_path: Path
) -> None:
    async with serve() as server:
        with pytest.raises(InvalidData, match=r"nowhere\.json.*rfedge eval ladder"):
            await travel(server.address, deadline_ms=33.0, ladder=tmp_path / "nowhere.json")


async def test_a_deadline_alone_takes_the_ladder_that_ships(serve: Any, travel: Any) -> None:
    async with serve() as server:
        record = await travel(server.address, deadline_ms=60_000.0)
    best = read_ladder(SHIPPED_LADDER, "splats", 23.0)[0]
    assert record.lines[0]["rung"] == best.rung.name
