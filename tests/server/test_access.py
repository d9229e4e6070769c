"""An access file grants and takes away, as a table; files that make no sense are refused."""

import os
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mec_server.access import EVERYTHING, AccessFile, AccessList, Grant, read_access
from rfcore.errors import AccessDenied, InvalidInput
from rfcore.wire.tls import PeerIdentity, Role, identity_uri

NOW = datetime(2030, 1, 2, tzinfo=UTC)
FILE = """
revoked = ["spiffe://rfedge/vehicle/cav-7", "serial:0x2a"]
[consumers.desk]
tiles = ["west"]
[consumers.owner]
vehicles = ["cav-1"]
[consumers.auditor]
all = true
"""


def who(role: Role, name: str, serial: int = 1, until: datetime = datetime.max) -> PeerIdentity:
    return PeerIdentity((identity_uri(role, name),), serial, until.replace(tzinfo=UTC))


@pytest.fixture
def access(tmp_path: Path) -> AccessList:
    (tmp_path / "access.toml").write_text(FILE)
    return read_access(tmp_path / "access.toml")


@pytest.mark.parametrize(
    ("peer", "cav_1_west", "cav_2_west", "cav_2_east", "west_field"),
    [
        (who(Role.CONSUMER, "desk"), True, True, False, True),
        (who(Role.CONSUMER, "owner"), True, False, False, False),
        (who(Role.CONSUMER, "auditor"), True, True, True, True),
        (who(Role.CONSUMER, "stranger"), False, False, False, False),
        (who(Role.OPERATOR, "op"), True, True, True, True),
        (who(Role.VEHICLE, "cav-1"), True, False, False, True),
        (who(Role.SERVER, "edge"), False, False, False, False),
        (who(Role.PROXY, "edge"), False, False, False, False),
        (None, True, True, True, True),
    ],
)
def test_each_role_sees_what_it_is_granted(
    access: AccessList,
    peer: PeerIdentity | None,
    cav_1_west: bool,
    cav_2_west: bool,
    cav_2_east: bool,
    west_field: bool,
) -> None:
    grant, west = access.grant(peer), frozenset({"west"})
    assert grant.covers("cav-1", west) is cav_1_west
    assert grant.covers("cav-2", west) is cav_2_west
    assert grant.covers("cav-2", frozenset({"east"})) is cav_2_east
    assert access.may_fetch(peer, west) is west_field


def test_without_a_file_consumers_see_everything() -> None:
    assert AccessList().grant(who(Role.CONSUMER, "anybody")) == EVERYTHING


@pytest.mark.parametrize(
    ("peer", "problem"),
    [
        (who(Role.VEHICLE, "cav-7"), "revoked"),
        (who(Role.VEHICLE, "cav-1", serial=0x2A), "revoked"),
        (who(Role.VEHICLE, "cav-1", until=datetime(2030, 1, 2)), "expired at 2030-01-02"),
        (PeerIdentity(()), "names one identity"),
        (PeerIdentity(("https://example.org",)), "unknown here"),
        (PeerIdentity((identity_uri(Role.VEHICLE, "a"), identity_uri(Role.OPERATOR, "a"))), "one"),
    ],
)
def test_who_is_not_let_in_is_told_why(
    access: AccessList, peer: PeerIdentity, problem: str
) -> None:
    with pytest.raises(AccessDenied, match=problem):
        access.check(peer, NOW)


def test_others_are_let_in(access: AccessList) -> None:
    access.check(who(Role.VEHICLE, "cav-1"), NOW)
    access.check(None, NOW)


@given(
    st.frozensets(st.sampled_from("abc")),
    st.frozensets(st.sampled_from("xyz")),
    st.sampled_from("abc"),
    st.frozensets(st.sampled_from("xyz")),
)
def test_a_grant_covers_what_it_names_and_nothing_else(
    vehicles: frozenset[str], tiles: frozenset[str], vehicle: str, of: frozenset[str]
) -> None:
    covers = Grant(False, vehicles, tiles).covers(vehicle, of)
    assert covers == (vehicle in vehicles or any(tile in tiles for tile in of))


@pytest.mark.parametrize(
    "text",
    [
        "revoked = 3",
        'revoked = ["cav-7"]',
        'revoked = ["serial:many"]',
        "[consumers.desk]\neverything = true",
        '[consumers.desk]\nall = "yes"',
        '[consumers."../etc"]',
        "consumers = 1",
        "grants = []",
        "[",
        "consumers.desk = 1",
    ],
)
def test_a_file_that_makes_no_sense_is_refused_by_name(tmp_path: Path, text: str) -> None:
    path = tmp_path / "access.toml"
    path.write_text(text)
    with pytest.raises(InvalidInput, match=r"access: .*access\.toml: "):
        read_access(path)


def test_a_file_that_breaks_later_leaves_the_list_before_it(tmp_path: Path) -> None:
    path = tmp_path / "access.toml"
    path.write_text(FILE)
    file = AccessFile(path)
    file.start()
    before = file.current
    assert not file.refresh()
    path.write_text("[ broken")
    with pytest.raises(InvalidInput):
        file.refresh()
    assert file.current == before
    assert not file.refresh(), "told once"
    path.write_text("revoked = []")
    assert file.refresh()
    assert file.current.consumers == {}


def test_what_is_no_file_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(InvalidInput, match="is no file, but a pipe, a folder or a device"):
            read_access(path)


def test_a_long_file_is_not_read_to_its_end(tmp_path: Path) -> None:
    long = tmp_path / "long.toml"
    with long.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InvalidInput, match="more than 4194304 bytes"):
        read_access(long)
