"""The ladder that ships with cav-agent has the recorded rungs, times and rates."""

import pytest

from cav_agent.field_cache import SHIPPED_LADDER
from lab.pages.ladder import RECORDED, shipped_ladder
from rfcore.codec.sender.ladder import read_ladder
from rfedge.results import read_result


def test_the_file_is_made_of_the_recorded_one():
    made = shipped_ladder(read_result(RECORDED, "ladder"))
    assert SHIPPED_LADDER.read_text() == made, "python -m lab.pages.ladder > cav_agent/ladder.json"


@pytest.mark.parametrize(
    ("kind", "tracking"), [("splats", False), ("splats", True), ("ngp", False)]
)
def test_a_vehicle_reads_of_it_what_the_recorded_one_says(kind, tracking):
    ships, recorded = (
        read_ladder(path, kind, 23.0, tracking=tracking) for path in (SHIPPED_LADDER, RECORDED)
    )
    assert ships == recorded != ()
