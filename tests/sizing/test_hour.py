"""Laws of an hour's bytes: rates times time, fields times new road, and where they are equal."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.errors import InvalidInput
from rfedge.cli import parse
from rfedge.sizing.estimate import Demand, Estimate
from rfedge.sizing.hour import NAMED_VEHICLES, Hour, Road, sample_field_mb_per_km

DEMAND = Demand(1, 640, 360, 10.0, 34.0)
OURS = Estimate("rfedge", 1.0, None, None, 0.5, 0.5, 50, 100.0)
X264 = replace(OURS, codec="x264", mbps=3.0, vehicles_per_cell=16)


def test_an_hour_is_rate_times_time_and_fields_of_new_road() -> None:
    hour = Hour("v", DEMAND, Road(50.0, 0.2, 40.0, 2.0), (OURS, X264))
    ours, x264 = hour.rows
    assert (ours.up_gb, x264.up_gb) == pytest.approx((0.45, 1.35))  # 3600 s x 1 or 3 Mbit/s
    assert (ours.field_gb, x264.field_gb) == pytest.approx((0.4, 0.0))  # 10 km x 40 MB
    assert (ours.mb_per_km, x264.mb_per_km) == pytest.approx((17.0, 27.0))
    assert (ours.price, x264.price) == pytest.approx((1.7, 2.7))
    assert ours.vehicles_per_cell == 50


@given(
    speed_kmh=st.floats(5.0, 130.0),
    mb_per_km=st.floats(1.0, 500.0),
    rival_mbps=st.floats(0.1, 20.0),
)
def test_at_the_most_new_road_ours_takes_no_more_bytes_and_beyond_it_more(
    speed_kmh: float, mb_per_km: float, rival_mbps: float
) -> None:
    rival = replace(X264, mbps=rival_mbps)

    def gb_more(share: float) -> float:
        hour = Hour("v", DEMAND, Road(speed_kmh, share, mb_per_km), (OURS, rival))
        ours, other = hour.rows
        return ours.up_gb + ours.field_gb - other.up_gb

    limit = Hour("v", DEMAND, Road(speed_kmh, 0.0, mb_per_km), (OURS, rival)).most_new_share["x264"]
    assert 0 <= limit <= 1
    if limit > 0:
        assert gb_more(limit) <= 1e-9
    if limit < 1:
        assert gb_more(min(1.0, limit + 0.01)) > 0


def test_a_road_that_is_known_costs_no_field_whatever_its_size() -> None:
    known = [Hour("v", DEMAND, Road(50.0, 0.0, mb), (OURS, X264)).rows for mb in (0.0, 1e3)]
    assert known[0] == known[1]


@pytest.mark.parametrize(
    ("road", "named"),
    [
        ((0.0, 1.0, 40.0), "speed-kmh"),
        ((50.0, 1.1, 40.0), "new-road"),
        ((50.0, 1.0, -1.0), "field-mb-per-km"),
        ((50.0, 1.0, 40.0, float("nan")), "price-per-gb"),
    ],
)
def test_a_road_that_cannot_be_is_refused(road, named) -> None:
    with pytest.raises(InvalidInput, match=named):
        Road(*road)


@pytest.mark.sample
def test_the_command_tells_an_hour_of_each_named_vehicle_and_of_ones_own(capsys) -> None:
    asked = "--size 640x360 --hour --speed-kmh 30 --new-road 0.25 --price-per-gb 3"
    parse(["size", *asked.split()]).run()
    said = capsys.readouterr().out
    assert all(vehicle.name in said for vehicle in NAMED_VEHICLES)
    for told in (
        "yours",
        "GB of fields",
        "cost",
        "25 %",
        f"{sample_field_mb_per_km():.1f} MB a km",
    ):
        assert told in said
