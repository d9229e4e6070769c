"""Subjects and records of a twin over NATS; a vehicle is where its newest session is."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.errors import InvalidInput, ProtocolError
from rfcore.wire.nats import (
    EXPIRES_S,
    NatsServers,
    VehicleLocation,
    VehicleLocations,
    key_of,
    picture_subject,
    pictures_subject,
    vehicle_of_subject,
    wanted_encoding,
    wanted_subject,
)
from rfcore.wire.twin import PictureEncoding

NAMES = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", fullmatch=True)


def place(
    server: str = "east", session: str = "s1", opened: int = 1, epoch: int = 0
) -> VehicleLocation:
    return VehicleLocation("cav-1", server, session, opened, epoch, "street", "ab" * 32)


# --- subjects and keys


@given(vehicle=NAMES, camera=NAMES, encoding=st.sampled_from(PictureEncoding))
def test_a_subject_has_five_tokens_and_names_its_vehicle(
    vehicle: str, camera: str, encoding: PictureEncoding
) -> None:
    subject = picture_subject(encoding, vehicle, camera)
    assert subject.split(".")[:3] == ["rfedge", "twin", str(encoding)]
    assert len(subject.split(".")) == 5
    assert not set(subject) & set("*> \r\n")
    assert vehicle_of_subject(subject) == vehicle


@given(names=st.sets(NAMES, min_size=2, max_size=2))
def test_two_vehicles_never_share_a_key(names: set[str]) -> None:
    first, second = map(key_of, names)
    assert first != second


def test_what_is_subscribed_to_is_one_encoding_of_one_vehicle_or_of_all() -> None:
    assert pictures_subject(PictureEncoding.JPEG) == "rfedge.twin.jpeg.*.*"
    assert pictures_subject(PictureEncoding.NONE, "cav.1") == "rfedge.twin.none.cav=1.*"


@pytest.mark.parametrize("encoding", PictureEncoding)
def test_an_encoding_is_asked_for_by_its_name(encoding: PictureEncoding) -> None:
    assert wanted_encoding(wanted_subject(encoding)) is encoding


def test_an_encoding_of_a_newer_program_is_not_known_here() -> None:
    assert wanted_encoding("rfedge.wanted.avif") is None


def test_a_subject_that_is_none_of_pictures_is_refused() -> None:
    with pytest.raises(ProtocolError, match=r"'rfedge\.twin' is no subject of pictures"):
        vehicle_of_subject("rfedge.twin")


# --- records


@given(
    vehicle=NAMES,
    server=NAMES,
    session=NAMES,
    opened=st.integers(0, 2**63 - 1),
    epoch=st.integers(0, 2**32 - 1),
    tile=st.one_of(st.just(""), NAMES),
)
def test_a_place_is_one_line_that_reads_back(**values: Any) -> None:
    given_place = VehicleLocation(
        values["vehicle"], values["server"], values["session"], values["opened"],
        values["epoch"], values["tile"], "cd" * 32,
    )  # fmt: skip
    text = given_place.encode()
    assert b"\n" not in text
    assert VehicleLocation.decode(text) == given_place


@pytest.mark.parametrize(
    "change",
    [
        {"vehicle_id": "a b"}, {"server": ""}, {"session_id": "x\r\nEvil: 1"}, {"epoch": -1},
        {"opened_time_ns": 2**63}, {"tile": ">"}, {"field_id": "ab"}, {"extra": 1},
    ],
)  # fmt: skip
def test_an_impossible_place_is_refused(change: dict[str, Any]) -> None:
    text = json.dumps({**asdict(place()), **change}).encode()
    with pytest.raises(ProtocolError, match="impossible place"):
        VehicleLocation.decode(text)


@pytest.mark.parametrize("data", [b"", b"[]", b"null", b'{"vehicle_id": "cav-1"}', b"\xff"])
def test_what_is_no_record_is_refused(data: bytes) -> None:
    with pytest.raises(ProtocolError, match="impossible place"):
        VehicleLocation.decode(data)


# --- who wins

PLACES = st.builds(
    place,
    server=st.sampled_from(["east", "west", "north"]),
    session=st.sampled_from(["s1", "s2", "s3"]),
    opened=st.integers(0, 3),
    epoch=st.integers(0, 2),
)


def of_sessions(places: list[VehicleLocation]) -> list[VehicleLocation]:
    """One place a session: the last that is told of it."""
    return list({each.session: each for each in places}.values())


@given(places=st.lists(PLACES, min_size=1, max_size=8), order=st.randoms(use_true_random=False))
def test_whatever_the_order_of_arrival_the_newest_session_wins(
    places: list[VehicleLocation], order: Any
) -> None:
    sessions = of_sessions(places)
    arrived = sessions * 2
    order.shuffle(arrived)
    heard, known = VehicleLocations(), list[VehicleLocation]()
    for each in arrived:
        known.append(each)
        newest = max(known, key=lambda it: it.rank)
        assert heard.hear(each, 0.0) == (each.session == newest.session)
        assert heard.place_of("cav-1") == newest


@given(places=st.lists(PLACES, min_size=1, max_size=8), ended=st.integers(0, 7))
def test_a_session_that_ended_stays_ended_and_the_next_newest_takes_over(
    places: list[VehicleLocation], ended: int
) -> None:
    sessions = of_sessions(places)
    over = sessions[ended % len(sessions)]
    heard = VehicleLocations()
    for each in sessions:
        heard.hear(each, 0.0)
    heard.end(over, 0.0)
    assert not heard.hear(over, 0.0), "a record that came late"
    left = [each for each in sessions if each.session != over.session]
    assert heard.place_of("cav-1") == max(left, key=lambda it: it.rank, default=None)


def test_a_server_that_fell_silent_loses_its_vehicles_to_one_that_did_not() -> None:
    heard = VehicleLocations()
    dead, alive = place("east", opened=2), place("west", opened=1)
    assert heard.hear(dead, 0.0)
    assert not heard.hear(alive, 1.0)
    heard.hear(alive, EXPIRES_S)
    heard.expire(EXPIRES_S)
    assert heard.place_of("cav-1") == dead, "not yet"
    heard.expire(EXPIRES_S + 0.1)
    assert heard.place_of("cav-1") == alive
    heard.expire(2 * EXPIRES_S + 0.1)
    assert heard.place_of("cav-1") is None


def test_of_vehicles_and_sessions_that_are_over_nothing_is_kept() -> None:
    heard = VehicleLocations()
    for number in range(100):
        each = replace(place(session=f"s{number}"), vehicle_id=f"cav-{number}")
        heard.hear(each, 0.0)
        heard.end(each, 0.0)
    heard.expire(2 * EXPIRES_S)
    assert vars(heard) == vars(VehicleLocations())


# --- how NATS is reached


@pytest.mark.parametrize(
    ("urls", "said"),
    [
        ("http://127.0.0.1:4222", "must be nats://HOST:PORT or tls://HOST:PORT"),
        ("127.0.0.1:4222", "must be nats://HOST:PORT or tls://HOST:PORT"),
        ("nats://127.0.0.1:4222,", "must be nats://HOST:PORT"),
        ("nats://me:secret@127.0.0.1", "a URL shows its secret to everybody; give --nats-login"),
        ("nats://127.0.0.1:99999", "out of range"),
        ("nats://nats.example:4222", "give --allow-insecure if the network is trusted"),
    ],
)
def test_a_bad_address_is_refused_by_what_is_wrong(urls: str, said: str) -> None:
    with pytest.raises(InvalidInput, match=said) as caught:
        NatsServers(NatsServers.parse_urls(urls))
    assert str(caught.value).startswith("nats")
    assert "secret@" not in str(caught.value)


def test_plaintext_goes_to_this_machine_or_where_it_may() -> None:
    assert not NatsServers(("nats://127.0.0.1:4222", "nats://[::1]:4223")).is_secure
    assert not NatsServers(("nats://nats.example",), allow_insecure=True).is_secure
    assert NatsServers(("tls://nats.example:4222",)).is_secure


def test_a_login_is_a_line_of_a_file(tmp_path: Path) -> None:
    here, file = ("nats://127.0.0.1:4222",), tmp_path / "login"
    file.write_text("cav:pass:word\n")
    assert NatsServers(here, file).credentials() == {"user": "cav", "password": "pass:word"}
    file.write_text("token\n")
    assert NatsServers(here, file).credentials() == {"token": "token"}
    for bad in ("", "a:b\nc:d\n"):
        file.write_text(bad)
        with pytest.raises(InvalidInput, match=r"nats-login: .* must hold one line"):
            NatsServers(here, file)
    with pytest.raises(InvalidInput, match=r"nats-login: .*No such file"):
        NatsServers(here, tmp_path / "missing")


def test_files_that_are_no_certificates_are_refused(tmp_path: Path) -> None:
    here, file = ("tls://127.0.0.1:4222",), tmp_path / "ca.pem"
    file.write_text("no certificate")
    with pytest.raises(InvalidInput, match=r"nats-ca: .*ca\.pem"):
        NatsServers(here, authority=file)
    with pytest.raises(InvalidInput, match="--nats-cert and --nats-key belong together"):
        NatsServers(here, certificate=file)
