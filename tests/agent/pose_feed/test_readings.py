"""Sentences and lines of feeds: right ones against tables, any other refused and never fatal."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cav_agent.pose_feed.feed import MAX_LINE_BYTES, FeedReader
from cav_agent.pose_feed.fix import BadReading, FeedProblem
from cav_agent.pose_feed.json_lines import JsonParser
from cav_agent.pose_feed.nmea import NmeaParser
from lab.localisation.pose_feed import sentence

NOON_NS = 1_700_000_000 * 10**9
"""2023-11-14 22:13:20 UTC."""


def nmea(body: str) -> str:
    return sentence(body).strip()


def gga(clock: str = "221321.500", quality: int = 1, place: str = "4807.038,N,01131.000,E") -> str:
    return nmea(f"GPGGA,{clock},{place},{quality},08,0.9,545.4,M,46.9,M,,")


def test_a_gga_is_position_height_above_the_ellipsoid_and_time_of_the_day():
    fix = NmeaParser().receive(gga(), NOON_NS)
    assert fix is not None
    latitude, longitude, height = fix.geodetic
    assert latitude == pytest.approx(48 + 7.038 / 60)
    assert longitude == pytest.approx(11 + 31 / 60)
    assert height == pytest.approx(545.4 + 46.9)
    assert fix.time_ns == NOON_NS + 1_500_000_000
    assert fix.heading_deg is None


def test_south_and_west_are_negative():
    fix = NmeaParser().receive(gga(place="3351.000,S,15112.000,W"), NOON_NS)
    assert fix.geodetic[:2] == pytest.approx((-33.85, -151.2))


@pytest.mark.parametrize("now_ns", [NOON_NS, NOON_NS + 40 * 60 * 10**9])
def test_a_fix_just_after_midnight_is_of_the_day_nearest_to_now(now_ns):
    later = 1_700_006_400 * 10**9  # 2023-11-15 00:00:00
    fix = NmeaParser().receive(gga("000000.250"), later - 100 if now_ns == NOON_NS else later + 1)
    assert fix.time_ns == later + 250_000_000


def test_the_date_of_rmc_goes_before_that_of_now():
    parser = NmeaParser()
    parser.receive(nmea("GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W"), 0)
    fix = parser.receive(gga("123520.000"), NOON_NS)
    assert fix.time_ns == 764426120 * 10**9  # 1994-03-23 12:35:20
    assert fix.heading_deg == pytest.approx(84.4)


def test_a_leap_second_is_refused_once_and_the_times_after_it_are_right():
    """2016-12-31 had a second 23:59:60; Unix time has none for it."""
    parser, times_ns, refused = NmeaParser(), [], []
    for clock, day in (("235959", "311216"), ("235960", "311216"), ("000000", "010117")):
        for body in (
            f"GPRMC,{clock},A,4807.038,N,01131.000,E,022.4,084.4,{day},003.1,W",
            f"GPGGA,{clock},4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,",
        ):
            try:
                fix = parser.receive(nmea(body), 0)
            except BadReading as error:
                refused.append(error.problem)
            else:
                times_ns += [] if fix is None else [fix.time_ns]
    assert refused == [FeedProblem.MALFORMED]
    assert times_ns == [1_483_228_799 * 10**9, 1_483_228_800 * 10**9]
    with pytest.raises(BadReading):
        JsonParser().receive(line(time_s=..., time="2016-12-31T23:59:60Z"))


@pytest.mark.parametrize("order", ["RMC first", "GGA first"])
def test_at_midnight_gga_is_of_the_day_that_follows_the_date_of_rmc(order):
    parser, times_ns = NmeaParser(), []
    for clock, day in (("235959.00", "230394"), ("000000.00", "240394"), ("000001.00", "240394")):
        bodies = [
            f"GPRMC,{clock},A,4807.038,N,01131.000,E,022.4,084.4,{day},003.1,W",
            f"GPGGA,{clock},4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,",
        ]
        for body in bodies if order == "RMC first" else bodies[::-1]:
            fix = parser.receive(nmea(body), 764_467_199 * 10**9)
            times_ns += [] if fix is None else [fix.time_ns]
    assert times_ns == [(764_467_199 + n) * 10**9 for n in range(3)]  # 1994-03-23 23:59:59


def test_two_antennas_go_before_the_course_and_gst_before_the_table():
    parser = NmeaParser()
    parser.receive(nmea("GPHDT,274.07,T"), NOON_NS)
    parser.receive(nmea("GPVTG,054.7,T,034.4,M,005.5,N,010.2,K"), NOON_NS)
    parser.receive(nmea("GPGST,221321.000,15.5,15.3,7.2,21.8,0.9,0.5,0.8"), NOON_NS)
    fix = parser.receive(gga(), NOON_NS)
    assert (fix.heading_deg, fix.rotation_std_deg) == (274.07, 1.0)
    assert fix.position_std_m == (0.5, 0.9, 0.8)


def test_a_gga_without_the_geoids_separation_has_no_height():
    parser = NmeaParser()
    parser.receive(nmea("GPGST,221321.000,15.5,15.3,7.2,21.8,0.9,0.5,0.8"), NOON_NS)
    without = "GPGGA,221321.500,4807.038,N,01131.000,E,4,08,0.9,545.4,M,,M,,"
    fix = parser.receive(nmea(without), NOON_NS)
    assert fix.geodetic[2] is None
    assert fix.position_std_m == (0.5, 0.9, 50.0)


@pytest.mark.parametrize(("mode", "heading_deg"), [("A", 77.5), ("V", None)])
def test_the_heading_of_ths_is_taken_if_it_is_valid(mode, heading_deg):
    parser = NmeaParser()
    assert parser.receive(nmea(f"GNTHS,77.5,{mode}"), NOON_NS) is None
    assert parser.receive(gga(), NOON_NS).heading_deg == heading_deg


def test_a_sentence_that_nobody_knows_is_ignored():
    assert NmeaParser().receive(nmea("PXYZ,1,2"), NOON_NS) is None
    assert NmeaParser().receive(nmea("GNQQQ,1,2"), NOON_NS) is None


def test_a_vehicle_that_stands_has_no_course():
    parser = NmeaParser()
    parser.receive(nmea("GPVTG,054.7,T,034.4,M,000.1,N,000.2,K"), NOON_NS)
    assert parser.receive(gga(), NOON_NS).heading_deg is None


def test_without_gga_the_position_is_that_of_rmc():
    parser = NmeaParser()
    rmc = "GPRMC,{},A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W"
    assert parser.receive(nmea(rmc.format("123518")), 0) is None
    fix = parser.receive(nmea(rmc.format("123519")), 0)
    assert fix.geodetic == pytest.approx((48.1173, 11.516667, None))
    assert fix.position_std_m[2] == 50.0


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        (gga()[:-2] + "00", FeedProblem.CHECKSUM),
        (gga().partition("*")[0], FeedProblem.CHECKSUM),
        (gga(quality=0), FeedProblem.NO_FIX),
        (gga(place="9907.038,N,01131.000,E"), FeedProblem.NOT_FINITE),
        (gga(place=",,,"), FeedProblem.MALFORMED),
        (gga(clock=""), FeedProblem.MALFORMED),
        (nmea("GPGGA,1"), FeedProblem.MALFORMED),
        (nmea("GPRMC,123519,V,,,,,,,230394,,"), FeedProblem.NO_FIX),
        ("$", FeedProblem.MALFORMED),
    ],
)
def test_a_bad_sentence_is_refused_with_its_reason(line, problem):
    with pytest.raises(BadReading) as refused:
        NmeaParser().receive(line, NOON_NS)
    assert refused.value.problem in (problem, FeedProblem.CHECKSUM if line == "$" else problem)


OURS = {"time_s": 1700000000.5, "latitude_deg": 48.1, "longitude_deg": 11.5, "height_m": 519.0}


def line(**changes: object) -> str:
    return json.dumps({k: v for k, v in {**OURS, **changes}.items() if v is not ...})


def test_our_schema_has_positions_headings_and_covariances():
    fix = JsonParser().receive(
        line(heading_deg=90, covariance_m2=[[4, 0, 0], [0, 9, 0], [0, 0, 1]], rotation_std_deg=2)
    )
    assert fix.geodetic == (48.1, 11.5, 519.0)
    assert fix.time_ns == 1_700_000_000_500_000_000
    assert fix.position_std_m == (2.0, 3.0, 1.0)
    assert (fix.heading_deg, fix.rotation_std_deg) == (90.0, 2.0)
    fix = JsonParser().receive(
        '{"time": "2023-11-14T23:13:20+01:00", "x_m": 1, "y_m": 2, "z_m": 3,'
        ' "quaternion": [1, 0, 0, 0], "covariance_m2": [1, 4, 9]}'
    )
    assert (fix.xyz_m, fix.rotation) == ((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    assert (fix.time_ns, fix.position_std_m) == (NOON_NS, (1.0, 2.0, 3.0))


def test_a_report_of_gpsd_is_a_fix_with_the_heading_of_att():
    parser = JsonParser()
    assert parser.receive('{"class":"VERSION","release":"3.25"}') is None
    att = '{"class":"ATT","time":"2023-11-14T22:13:20.000Z","heading":12.5}'
    assert parser.receive(att) is None
    fix = parser.receive(
        '{"class":"TPV","mode":3,"time":"2023-11-14T22:13:20.100Z","lat":48.1,"lon":11.5,'
        '"altHAE":519.2,"epx":3.92,"epy":1.96,"epv":9.8,"track":80,"speed":9}'
    )
    assert fix.geodetic == (48.1, 11.5, 519.2)
    assert fix.position_std_m == pytest.approx((2.0, 1.0, 5.0))
    assert fix.heading_deg == 12.5
    course = JsonParser().receive(
        '{"class":"TPV","mode":2,"time":"2023-11-14T22:13:20.100Z","lat":48.1,"lon":11.5,'
        '"track":80,"speed":9}'
    )
    assert (course.heading_deg, course.geodetic[2]) == (80.0, None)


def tpv(time: str = "20.100", **more: object) -> str:
    at = f"2023-11-14T22:13:{time}Z"
    return json.dumps(
        {"class": "TPV", "mode": 3, "time": at, "lat": 48.1, "lon": 11.5, "altHAE": 519.2, **more}
    )


def test_a_heading_without_a_time_is_that_of_the_next_position():
    """gpsd 3.22 reports HDT so."""
    parser = JsonParser()
    assert parser.receive('{"class":"ATT","device":"/dev/ttyS0","heading":123.4}') is None
    assert parser.receive(tpv()).heading_deg == 123.4
    assert parser.receive(tpv("21.100")).heading_deg is None


def test_standard_deviations_are_those_of_gst_then_of_the_kind_of_solution_then_of_gpsd():
    """gpsd 3.22 leaves RTK out of its estimates: eph 24.7 m where GST says 1 cm."""
    parser = JsonParser()
    fixed = tpv(status=3, eph=24.7, epv=48.3)
    assert parser.receive(fixed).position_std_m == pytest.approx((0.03, 0.03, 0.045))
    gst = '{"class":"GST","time":"2023-11-14T22:13:20.000Z","lat":0.012,"lon":0.02,"alt":0.025}'
    assert parser.receive(gst) is None
    assert parser.receive(fixed).position_std_m == pytest.approx((0.02, 0.012, 0.025))
    later = tpv("30.000", status=1, eph=3.92, epv=9.8)
    assert parser.receive(later).position_std_m == pytest.approx((2.0, 2.0, 5.0))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("{", FeedProblem.MALFORMED),
        ("[1]", FeedProblem.MALFORMED),
        (line(time_s=...), FeedProblem.MALFORMED),
        (line(time_s=..., time="2023-11-14T22:13:20"), FeedProblem.MALFORMED),
        (line(time_s=-1), FeedProblem.NOT_FINITE),
        (line(latitude_deg=math.nan), FeedProblem.NOT_FINITE),
        (line(latitude_deg=math.inf), FeedProblem.NOT_FINITE),
        (line(latitude_deg=...), FeedProblem.MALFORMED),
        (line(latitude_deg=True), FeedProblem.MALFORMED),
        (line(longitude_deg=181), FeedProblem.NOT_FINITE),
        (line(quaternion=[0, 0, 0, 0]), FeedProblem.NOT_FINITE),
        (line(covariance_m2=[1, -1, 1]), FeedProblem.NOT_FINITE),
        (line(covariance_m2=3), FeedProblem.MALFORMED),
        (line(covariance_m2=[[1, 0, 0]]), FeedProblem.MALFORMED),
        (line(lat=3), FeedProblem.MALFORMED),
        ('{"class":"TPV","mode":1}', FeedProblem.NO_FIX),
    ],
)
def test_a_bad_line_is_refused_with_its_reason(text, problem):
    with pytest.raises(BadReading) as refused:
        JsonParser().receive(text)
    assert refused.value.problem is problem


@given(st.binary(max_size=400))
def test_no_bytes_break_the_reader(data):
    problems: list[BadReading] = []
    reader = FeedReader(problems.append)
    reader.receive(data, NOON_NS)
    reader.receive(b"\n", NOON_NS)
    assert len(reader.receive(line().encode() + b"\n", NOON_NS)) == 1


values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4),
    max_leaves=6,
)


SOME_KEYS = [*OURS, "quaternion", "covariance_m2", "class", "lat", "lon", "mode", "time", "x_m"]


@given(st.dictionaries(st.sampled_from(SOME_KEYS), values))
def test_any_object_is_a_fix_or_is_refused(content):
    try:
        fix = JsonParser().receive(json.dumps(content))
    except BadReading:
        return
    if fix is not None:
        assert 0 <= fix.time_ns < 1 << 64
        assert all(0 < std < math.inf for std in fix.position_std_m)


SOME_FIELDS = ["", "1", "4807.038", "N", "E", "-3", "nan", "A", "x", "230394", "123519", "1e9"]
fields = st.lists(st.sampled_from(SOME_FIELDS), max_size=16)


@given(st.sampled_from(["GGA", "RMC", "VTG", "HDT", "GST", "GSV"]), fields)
def test_any_sentence_is_a_fix_or_is_refused(kind, parts):
    try:
        fix = NmeaParser().receive(nmea(",".join([f"GP{kind}", *parts])), NOON_NS)
    except BadReading:
        return
    if fix is not None:
        assert -90 <= fix.geodetic[0] <= 90


@given(st.lists(st.integers(1, 60), max_size=20))
def test_how_the_bytes_are_cut_does_not_matter(cuts):
    sentences = [gga(f"2213{n:02d}.0") + "\r\n" for n in range(4)]
    data = ("".join(sentences) + line() + "\n").encode()
    reader, found, at = FeedReader(lambda error: pytest.fail(str(error))), [], 0
    for cut in [*cuts, len(data)]:
        found += reader.receive(data[at : at + cut], NOON_NS)
        at += cut
    assert len(found) == 5


def test_a_line_without_an_end_is_given_up_and_the_next_is_read():
    problems: list[BadReading] = []
    reader = FeedReader(problems.append)
    for _ in range(5):
        assert reader.receive(b"x" * MAX_LINE_BYTES, NOON_NS) == []
    assert [error.problem for error in problems] == [FeedProblem.MALFORMED]
    assert len(reader.receive(b"tail\n" + line().encode() + b"\n", NOON_NS)) == 1
