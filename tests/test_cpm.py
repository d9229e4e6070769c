"""Objects as Collective Perception Messages: content, bits, rules of generation, bad input."""

import importlib.util
import json
import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pycrate_asn1c.asnproc import PycrateGenerator, compile_text, generate_modules

from rfcore.errors import InvalidInput
from rfcore.field import FieldMetadata, SplatField, load_field, save_field
from rfcore.geodesy import Anchor
from rfcore.motion import quaternion_from_vector
from rfcore.perception.objects import StreetObject
from rfedge import cpm
from rfedge.cli import parse
from rfedge.cpm import CollectivePerception, Cpm, CpmFile, MessageWriter, its_time_ms
from rfedge.watch import WatchSettings, watch
from tests.field.some import make_gaussians

ANCHOR = Anchor(48.137, 11.575, 519.0)
NOW_NS = 1_795_000_000_000_000_000
MS = 1_000_000
CAR = StreetObject(7, (10.0, 20.0, 0.0), (3.0, -4.0, 0.0), 1.8, 1.5, 1.0, 2.0, 0.0, (), label="car")
PERSON = replace(CAR, object_id=8, label="person")


def objects_in(messages: Iterable[Cpm]) -> list[dict[str, Any]]:
    """Return the perceived objects of messages."""
    containers = [message.content["payload"]["cpmContainers"][1] for message in messages]
    return [each for one in containers for each in one["containerData"]["perceivedObjects"]]


def told(messages: Iterable[Cpm]) -> list[int]:
    return [each["objectId"] for each in objects_in(messages)]


def content_of(one: StreetObject, anchor: Anchor = ANCHOR) -> dict[str, Any]:
    (content,) = objects_in(MessageWriter(anchor).messages([(one, 9)], 1, NOW_NS))
    return content


def values(content: dict[str, Any], part: str) -> list[int]:
    each = content[part][1] if part == "velocity" else content[part]
    return [axis["value"] for axis in each.values()]


# What a second compiler reads


@pytest.fixture(scope="module")
def second(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The module of the declaration, compiled by pycrate."""
    path = tmp_path_factory.mktemp("asn1") / "declared.py"
    compile_text(Path(cpm.__file__).with_name("cpm.asn").read_text(encoding="ascii"))
    generate_modules(PycrateGenerator, str(path))
    spec = importlib.util.spec_from_file_location("declared", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Rfedge_Cpm


def read_by(second: Any, uper: bytes) -> dict[str, Any]:
    """Return the content of a message as the second compiler's code reads it."""
    second.CollectivePerceptionMessage.from_uper(uper)
    content = second.CollectivePerceptionMessage.get_val()
    kinds = {2: second.OriginatingRsuContainer, 5: second.PerceivedObjectContainer}
    for container in content["payload"]["cpmContainers"]:
        kind = kinds[container["containerId"]]
        kind.from_uper(container["containerData"])
        container["containerData"] = kind.get_val()
    return content


sizes_m = st.floats(-1, 40)
labels = st.sampled_from(["", "zebra", *cpm.LABELS])
street_objects = st.builds(
    StreetObject,
    *(st.integers(0, 2**32), st.tuples(*[st.floats(-1e9, 1e9)] * 3)),
    *(st.tuples(*[st.floats(-300, 300)] * 3), sizes_m, sizes_m, st.floats(0, 1)),
    *(st.floats(0, 1e4), st.floats(0, 3), st.just(()), st.just(False), labels),
)
anchors = st.builds(
    Anchor, st.floats(-90, 90), st.floats(-180, 180), st.floats(-400, 9000),
    st.tuples(*[st.floats(-3, 3)] * 3).map(quaternion_from_vector),
)  # fmt: skip


@settings(max_examples=30)
@given(anchors, st.integers(0, 2**32 - 1), st.lists(street_objects, max_size=36))
def test_a_second_decoder_reads_every_value(second, anchor, station_id, objects):
    pairs = [(one, index % 16) for index, one in enumerate(objects)]
    for message in MessageWriter(anchor, station_id).messages(pairs, len(pairs), NOW_NS):
        assert read_by(second, message.uper) == message.content
        assert json.loads(message.line())["uper"] == message.uper.hex()


GOLDEN = (
    "020e0000002a02a07e6ee62292b0448391803387ffffff08928ae788808022100c04c3e8001e0030"
    "1f47ffc0fa1fff0025fffd04aff3e6ffc1df11f88feee600b9187d0004400603e8fff81f43ffe004"
    "bfffa095fe7cdff83be23f11fddc90406400"
)
"""Decoded to the same values by pycrate 0.8.1 from the published ASN.1 of TS 103 324 V2.1.1 and
TS 102 894-2 V2.4.1, without inner subtype constraints and with 0..14 for the vehicle classes."""


def test_the_bits_are_those_of_the_published_definitions():
    (message,) = MessageWriter(ANCHOR, 42).messages([(CAR, 12), (PERSON, 9)], 3, NOW_NS)
    assert message.uper.hex() == GOLDEN


# Values and units


def test_values_are_in_the_standards_units_rounded_up():
    content = content_of(replace(CAR, at_m=(10.001, -20.001, 0.5)))
    assert values(content, "position") == [1001, -2000, 125], "the middle of a box 1.5 m high"
    assert values(content, "velocity") == [300, -400]
    assert [content[f"objectDimension{axis}"]["value"] for axis in "XYZ"] == [18, 18, 15]
    assert (content["objectAge"], content["measurementDeltaTime"]) == (1500, 0)
    assert content["classification"] == [{"objectClass": ("vehicleSubClass", 5), "confidence": 101}]


def test_an_object_is_where_it_was_seen_and_not_where_it_may_be_now():
    content = content_of(replace(CAR, unseen_s=0.5))
    assert content["measurementDeltaTime"] == -500
    assert values(content, "position")[:2] == [850, 2200]


def test_what_is_unknown_has_the_codes_for_it_or_is_absent():
    content = content_of(replace(CAR, width_m=0.0, label="zebra"))
    assert {axis["confidence"] for axis in content["position"].values()} == {4096}
    assert {axis["confidence"] for axis in content["velocity"][1].values()} == {127}
    assert content["objectDimensionX"] == {"value": 256, "confidence": 32}
    assert not {"angles", "acceleration", "classification"} & set(content)


def test_values_out_of_range_have_the_codes_for_it():
    far = replace(
        *(CAR,), at_m=(2000.0, -2000.0, 0.0), velocity_mps=(170.0, -170.0, 0.0), height_m=25.5
    )
    content = content_of(far)
    assert values(content, "position")[:2] == [131071, -131072]
    assert values(content, "velocity") == [16382, -16383]
    assert content["objectDimensionZ"]["value"] == 255


def test_times_are_the_standards():
    """TS 102 894-2 gives the first; five leap seconds came since 2004, the last in 2016."""
    assert its_time_ms(1_167_609_600_000_000_000) == 94_694_401_000
    assert its_time_ms(NOW_NS) == 1_795_000_000_000 - 1_072_915_200_000 + 5000


@pytest.mark.parametrize(("time_ns", "year"), [(0, 1970), (6 * 10**18, 2160)])
def test_a_time_that_the_standard_cannot_state_is_refused(time_ns, year):
    with pytest.raises(InvalidInput, match=f"time: the year {year} is outside 2004..2143: set"):
        its_time_ms(time_ns)


def test_axes_that_are_not_east_north_up_are_turned():
    # a camera's axes looking north: x east, y down, z north
    down = Anchor(48.0, 11.0, 500.0, quaternion_from_vector((-math.pi / 2, 0.0, 0.0)))
    content = content_of(replace(CAR, at_m=(10.0, 1.0, 20.0), velocity_mps=(1.0, 0.0, 2.0)), down)
    assert values(content, "position") == pytest.approx([1000, 2000, -25], abs=1)
    assert values(content, "velocity") == pytest.approx([100, 200], abs=1)


@given(
    st.floats(-85, 85), st.floats(-179, 179), st.tuples(*[st.floats(-400, 400)] * 3),
    st.tuples(*[st.floats(-800, 800)] * 2),
)  # fmt: skip
def test_reference_and_position_together_are_the_place_on_the_earth(
    latitude_deg, longitude_deg, point_m, at_m
):
    """1 cm of rounding for each axis."""
    anchor = Anchor(latitude_deg, longitude_deg, 300.0, point_m=point_m)
    one = replace(CAR, at_m=(*at_m, 0.0), height_m=0.0)
    (message,) = MessageWriter(anchor).messages([(one, 9)], 1, NOW_NS)
    position = message.content["payload"]["managementContainer"]["referencePosition"]
    reference = Anchor(
        position["latitude"] / 1e7,
        position["longitude"] / 1e7,
        position["altitude"]["altitudeValue"] / 100,
    )
    sent_m = [value / 100 for value in values(objects_in([message])[0], "position")]
    found_m = anchor.world_from_geodetic(*reference.geodetic_from_world(tuple(sent_m)))
    assert found_m == pytest.approx(one.at_m, abs=0.015)


# Rules of generation


def service() -> CollectivePerception:
    return CollectivePerception(MessageWriter(ANCHOR))


def turned(one: StreetObject, degrees: float) -> StreetObject:
    angle = math.atan2(*reversed(one.velocity_mps[:2])) + math.radians(degrees)
    speed = math.hypot(*one.velocity_mps)
    return replace(one, velocity_mps=(speed * math.cos(angle), speed * math.sin(angle), 0.0))


@pytest.mark.parametrize(
    ("later", "after_ms", "is_told"),
    [
        (CAR, 900, False),
        (CAR, 1000, True),
        (replace(CAR, at_m=(13.9, 20.0, 0.0)), 200, False),
        (replace(CAR, at_m=(14.1, 20.0, 0.0)), 200, True),
        (replace(CAR, velocity_mps=(3.24, -4.32, 0.0)), 200, False),
        (replace(CAR, velocity_mps=(3.36, -4.48, 0.0)), 200, True),
        (turned(CAR, 3.9), 200, False),
        (turned(CAR, -4.1), 200, True),
        (replace(CAR, object_id=9), 200, True),
    ],
)
def test_an_object_is_told_of_again_by_the_standards_thresholds(later, after_ms, is_told):
    rules = service()
    assert told(rules.take([CAR], NOW_NS)) == [7]
    assert (told(rules.take([later], NOW_NS + after_ms * MS)) != []) is is_told


def test_the_direction_of_a_thing_that_stands_is_noise():
    rules, parked = service(), replace(CAR, velocity_mps=(0.1, 0.0, 0.0))
    rules.take([parked], NOW_NS)
    assert rules.take([turned(parked, 90)], NOW_NS + 200 * MS) == []


def test_people_are_told_of_twice_as_often_and_all_together():
    rules, second = service(), replace(PERSON, object_id=9)
    assert told(rules.take([CAR, PERSON], NOW_NS)) == [7, 8]
    assert told(rules.take([CAR, PERSON, second], NOW_NS + 300 * MS)) == [9], "the new one"
    assert told(rules.take([CAR, PERSON, second], NOW_NS + 400 * MS)) == []
    assert told(rules.take([CAR, PERSON, second], NOW_NS + 500 * MS)) == [8, 9]


moments = st.lists(
    st.tuples(
        st.integers(1, 120),
        st.lists(st.tuples(st.integers(1, 4), st.floats(-9, 9), st.floats(-9, 9)), max_size=4),
    ),
    min_size=1,
    max_size=40,
)


@settings(max_examples=25)
@given(moments)
def test_messages_are_a_tenth_of_a_second_apart_and_a_second_at_most(steps):
    """The second has one step of at most 120 ms, and the tenth after it, on top."""
    rules, time_ns, sent_ns = service(), NOW_NS, []
    for step_ms, moves in steps:
        time_ns += step_ms * MS
        seen = [replace(CAR, object_id=i, at_m=(x, y, 0.0)) for i, x, y in moves]
        sent_ns += [time_ns] * bool(rules.take({o.object_id: o for o in seen}.values(), time_ns))
    gaps_ms = [(b - a) / MS for a, b in zip(sent_ns, [*sent_ns[1:], time_ns], strict=True)]
    assert sent_ns[0] == NOW_NS + steps[0][0] * MS
    assert min([100.0, *gaps_ms[:-1]]) >= 100
    assert max(gaps_ms) <= 1000 + 220


def test_doubtful_and_bad_objects_are_not_told_of():
    rules = service()
    doubtful = replace(CAR, is_doubtful=True)
    faint = replace(PERSON, confidence=0.0, age_s=0.0)
    first = rules.take([doubtful, faint], NOW_NS)
    assert told(first) == [8]
    assert objects_in(first)[0]["objectPerceptionQuality"] == 5, "(0 + 15 + 0) / 3"
    later = rules.take([doubtful, replace(faint, unseen_s=1.0)], NOW_NS + 1000 * MS)
    assert len(later) == 1, "a message without objects"
    assert told(later) == [], "its quality is (0 + 7 + 0) / 3"


def test_quality_is_the_mean_of_three_ratings():
    """Confidence, how often it was seen, age; the averages weigh the newest by a half."""
    rules = service()
    rules.take([replace(CAR, confidence=0.8, age_s=0.2)], NOW_NS)
    again = replace(CAR, confidence=0.4, age_s=1.2, unseen_s=0.1)
    (content,) = objects_in(rules.take([again], NOW_NS + 1000 * MS))
    assert content["objectPerceptionQuality"] == (math.floor(15 * 0.6) + 15 + 12) // 3
    (content,) = objects_in(rules.take([replace(again, unseen_s=1.1)], NOW_NS + 2000 * MS))
    assert content["objectPerceptionQuality"] == (math.floor(15 * 0.5) + 7 + 12) // 3


def test_many_objects_are_told_of_in_messages_that_fit():
    rules = service()
    crowd = [replace(PERSON, object_id=index, unseen_s=0.01) for index in range(300)]
    messages = rules.take(crowd, NOW_NS)
    assert len(told(messages)) == len(set(told(messages))) == 255
    assert max(len(message.uper) for message in messages) <= 1100
    managed = [message.content["payload"]["managementContainer"] for message in messages]
    assert [each["segmentationInfo"]["thisMsgNo"] for each in managed] == list(range(1, 9))
    assert len({each["referenceTime"] for each in managed}) == 1
    rest = told(rules.take(crowd, NOW_NS + 100 * MS))
    assert sorted(rest + told(messages)) == list(range(300))


def test_a_clock_that_is_set_back_makes_all_objects_new():
    rules = service()
    rules.take([CAR], NOW_NS)
    assert told(rules.take([CAR], NOW_NS - 3600_000 * MS)) == [7]


# Files and bad input


def test_a_file_has_a_line_for_each_message_at_once(tmp_path):
    path = tmp_path / "new" / "street.jsonl"
    with CpmFile(path, FieldMetadata(anchor=ANCHOR), 42) as file:
        file.show_objects([CAR], NOW_NS)
        file.show_objects([CAR], NOW_NS + 100 * MS)
        (line,) = path.read_text().splitlines()
    file.show_objects([PERSON], NOW_NS + 200 * MS)
    assert path.read_text().splitlines() == [line]
    content = json.loads(line)["cpm"]
    assert content["header"] == {"protocolVersion": 2, "messageId": 14, "stationId": 42}
    (one,) = content["payload"]["cpmContainers"][1]["containerData"]["perceivedObjects"]
    assert one["classification"][0]["objectClass"] == {"vehicleSubClass": 5}


def test_a_field_without_an_anchor_is_refused_with_the_command_that_gives_it_one(tmp_path):
    save_field(SplatField(make_gaussians()), tmp_path / "street.rff")
    bare = load_field(tmp_path / "street.rff").metadata
    with pytest.raises(InvalidInput, match="states no place on the Earth") as refused:
        CpmFile(tmp_path / "no.jsonl", bare)
    assert not (tmp_path / "no.jsonl").exists()
    command = refused.value.problem.partition("rfedge ")[2].partition(", and")[0]
    filled = {"FIELD": tmp_path / "street.rff", "LATITUDE": 48.1, "LONGITUDE": 11.5}
    filled |= {"HEIGHT": 500, "FILE.rff": tmp_path / "anchored.rff"}
    parse([str(filled.get(word, word)) for word in command.split()]).run()
    with CpmFile(tmp_path / "yes.jsonl", load_field(tmp_path / "anchored.rff").metadata):
        pass


@pytest.mark.parametrize("station_id", [-1, 2**32])
def test_a_station_id_has_32_bits(station_id):
    with pytest.raises(InvalidInput, match=f"station: {station_id} is outside 0..4294967295"):
        MessageWriter(ANCHOR, station_id)


def test_values_that_are_not_finite_are_refused():
    with pytest.raises(InvalidInput, match="object: 7 has values that are not finite"):
        service().take([replace(CAR, width_m=math.nan)], NOW_NS)


class NoSource:
    """A source that must not be asked."""

    def watch(self, *_: Any) -> Any:
        raise AssertionError("it was asked")

    def stop(self) -> None:
        return


@pytest.mark.parametrize(
    ("objects", "problem"),
    [(None, "do not come by NATS: name one, HOST:PORT"), (lambda _: iter(()), "needs --field")],
)
def test_messages_need_a_server_and_a_field(tmp_path, objects, problem):
    with pytest.raises(InvalidInput, match=problem):
        watch(WatchSettings(cpm=tmp_path / "no.jsonl"), NoSource(), objects)
