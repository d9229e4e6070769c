"""The twin of many servers shows a vehicle once, also while it moves."""

from collections import defaultdict

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import Intrinsics
from rfcore.errors import InvalidInput, ProtocolError
from rfcore.wire.nats import EXPIRES_S, VehicleLocation, picture_subject
from rfcore.wire.twin import Departure, PictureEncoding, TwinPicture, twin_message_to_wire
from rfedge.arguments import TwinConnection
from rfedge.cli.services import Watch
from rfedge.cli.twin import Twin
from rfedge.twin.nats_source import SharedTwin, TwinMessage, published_message

K = Intrinsics(2, 2, 1.0, 1.0, 1.0, 1.0)
KEY = ("cav-1", "front")


def place(server: str, opened: int) -> VehicleLocation:
    return VehicleLocation("cav-1", server, f"s{opened}", opened, 0, "street", "ab" * 32)


def picture(sequence: int, session: str = "s1", camera: str = "front") -> TwinPicture:
    return TwinPicture(
        "cav-1", camera, session, 0, sequence, 1, 1, None, K, "ab" * 32, b"d" * 16,
        PictureEncoding.JPEG, b"jpeg",
    )  # fmt: skip


EAST, WEST = place("east", 1), place("west", 2)
DEPARTURE = Departure(*KEY)


def test_what_arrives_late_of_a_session_that_ended_shows_nothing() -> None:
    twin = SharedTwin()
    assert twin.hear(EAST, picture(0), 0.0)
    assert twin.hear(EAST, DEPARTURE, 0.1)
    twin.places.hear(EAST, 0.2)
    assert not twin.hear(EAST, picture(1), 0.3)


def test_a_camera_that_the_new_session_does_not_have_leaves() -> None:
    twin = SharedTwin()
    twin.hear(EAST, picture(0, camera="rear"), 0.0)
    for at_s in range(10):
        twin.hear(WEST, picture(at_s), float(at_s))
    assert twin.expire(EXPIRES_S) == []
    assert twin.expire(EXPIRES_S + 0.1) == [Departure("cav-1", "rear")]


def test_a_vehicle_that_stands_stays_as_long_as_its_server_tells_of_it() -> None:
    twin = SharedTwin()
    twin.hear(EAST, picture(0), 0.0)
    for at_s in range(30):
        twin.places.hear(EAST, float(at_s))
        assert twin.expire(float(at_s)) == []
    assert twin.expire(29.0 + EXPIRES_S + 0.1) == [DEPARTURE]


Event = tuple[VehicleLocation, TwinMessage]


@st.composite
def interleaved(draw: st.DrawFn) -> list[Event]:
    """Interleave what two or three servers publish of one vehicle, each in its own order."""
    waiting = []
    for number in range(draw(st.integers(2, 3))):
        at = place(f"server{number}", number)
        events: list[Event] = [(at, picture(i)) for i in range(draw(st.integers(1, 4)))]
        waiting.append([*events, (at, DEPARTURE)])
    merged = []
    while waiting:
        chosen = waiting[draw(st.integers(0, len(waiting) - 1))]
        merged.append(chosen.pop(0))
        waiting = [each for each in waiting if each]
    return merged


@given(events=interleaved())
def test_in_whatever_order_servers_are_heard_a_vehicle_is_shown_once(events: list[Event]) -> None:
    twin, shown = SharedTwin(), dict[tuple[str, str], str]()
    over = set[str]()
    for at_s, (at, message) in enumerate(events):
        shows = twin.hear(at, message, at_s / 100)
        if isinstance(message, TwinPicture):
            if shows:
                shown[message.vehicle_id, message.camera_id] = at.server
        else:
            over.add(at.server)
            if shows:
                assert shown.pop((message.vehicle_id, message.camera_id)) == at.server
        assert not set(shown.values()) & over, "nobody is shown by a server that ended its session"
        assert len(shown) <= 1
    assert shown == {}
    assert twin.expire(100.0) == []


@given(events=interleaved())
def test_no_older_session_is_shown_after_a_newer_one_that_lives(events: list[Event]) -> None:
    twin = SharedTwin()
    living: dict[str, int] = defaultdict(int)
    for at_s, (at, message) in enumerate(events):
        shows = twin.hear(at, message, at_s / 100)
        if isinstance(message, Departure):
            living.pop(at.server, None)
        else:
            living[at.server] = at.opened_time_ns
            assert shows == (at.opened_time_ns == max(living.values()))


def test_a_message_whose_subject_names_another_vehicle_is_refused() -> None:
    body = twin_message_to_wire(picture(0)).SerializeToString()
    own = picture_subject(PictureEncoding.JPEG, *KEY)
    assert published_message(own, EAST.encode().decode(), body) == (EAST, picture(0))
    other = picture_subject(PictureEncoding.JPEG, "cav-2", "front")
    with pytest.raises(ProtocolError, match="carries what is of cav-1, cav-2"):
        published_message(other, EAST.encode().decode(), body)


@pytest.mark.parametrize(("header", "body"), [("", None), ("{}", None), (None, b"\xff\xff")])
def test_a_message_that_is_none_is_refused(header: str | None, body: bytes | None) -> None:
    subject = picture_subject(PictureEncoding.JPEG, *KEY)
    good = twin_message_to_wire(picture(0)).SerializeToString()
    with pytest.raises(ProtocolError):
        published_message(
            subject, EAST.encode().decode() if header is None else header, body or good
        )


@pytest.mark.parametrize("verb", [Twin, Watch])
@pytest.mark.parametrize("nats", [None, "nats://127.0.0.1:1"])
def test_one_place_to_look_at_is_asked_for(verb: type[Twin | Watch], nats: str | None) -> None:
    targets = () if nats is None else ("127.0.0.1:50051",)
    with pytest.raises(InvalidInput, match=r"give one: .*--nats URL"):
        verb(*targets, connection=TwinConnection(nats)).run()
