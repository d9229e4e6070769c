"""The authority signs the right names, and keys are for their owner alone."""

import stat
from datetime import UTC, datetime
from pathlib import Path

import pytest
from cryptography import x509

from rfcore.errors import AccessDenied, InvalidData, InvalidInput
from rfcore.wire.tls import PeerIdentity, Role, identity_uri, peer_identity
from rfedge.certs import (
    Issued,
    Members,
    add_certificates,
    certify,
    read_certificates,
    write_certificates,
)

NOW = datetime(2030, 1, 2, tzinfo=UTC)


@pytest.fixture(scope="module")
def issued() -> tuple[Issued, ...]:
    return certify(Members(("cav-1",), ("watch",), ("edge.example", "10.0.0.1")), NOW, 10)


def test_everyone_is_named_by_one_uri_and_the_server_also_by_its_hosts(
    issued: tuple[Issued, ...], tmp_path: Path
) -> None:
    write_certificates(tmp_path / "c", issued)
    says = read_certificates(tmp_path / "c")
    assert {name: one.names for name, one in says.items()} == {
        "ca.pem": (),
        "consumer-watch.pem": ("spiffe://rfedge/consumer/watch",),
        "server.pem": ("spiffe://rfedge/server/edge", "edge.example", "10.0.0.1"),
        "vehicle-cav-1.pem": ("spiffe://rfedge/vehicle/cav-1",),
    }
    assert {one.until for one in says.values()} == {datetime(2030, 1, 12, tzinfo=UTC)}


def test_only_the_authority_may_sign(issued: tuple[Issued, ...]) -> None:
    for one in issued:
        extensions = x509.load_pem_x509_certificate(one.certificate).extensions
        basic = extensions.get_extension_for_class(x509.BasicConstraints)
        assert basic.critical
        assert basic.value.ca is (one.name == "ca")


def test_keys_are_for_their_owner_alone(issued: tuple[Issued, ...], tmp_path: Path) -> None:
    write_certificates(tmp_path / "c", issued)
    keys = sorted((tmp_path / "c").glob("*.key"))
    assert [key.stem for key in keys] == ["ca", "consumer-watch", "server", "vehicle-cav-1"]
    assert {stat.S_IMODE(key.stat().st_mode) for key in keys} == {0o600}


def test_certificates_are_replaced_only_when_told_to(
    issued: tuple[Issued, ...], tmp_path: Path
) -> None:
    folder = tmp_path / "c"
    write_certificates(folder, issued)
    before = (folder / "ca.key").read_bytes()
    again = certify(Members(("cav-9",)), NOW, 10)
    with pytest.raises(InvalidInput, match="--replace"):
        write_certificates(folder, again)
    assert (folder / "ca.key").read_bytes() == before
    write_certificates(folder, again, replace=True)
    assert (folder / "ca.key").read_bytes() != before
    assert not (folder / "vehicle-cav-1.pem").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["c"]


def test_a_folder_that_holds_something_else_is_not_replaced(
    issued: tuple[Issued, ...], tmp_path: Path
) -> None:
    with pytest.raises(InvalidInput, match="no folder that `rfedge certs init` made"):
        write_certificates(tmp_path, issued, replace=True)
    folder = tmp_path / "c"
    write_certificates(folder, issued)
    (folder / "thesis.tex").write_text("all of it")
    with pytest.raises(InvalidInput, match=r"also holds thesis\.tex"):
        write_certificates(folder, issued, replace=True)
    assert (folder / "thesis.tex").read_text() == "all of it"


def test_a_write_that_fails_leaves_nothing(issued: tuple[Issued, ...], tmp_path: Path) -> None:
    twice = (*issued, issued[-1])
    with pytest.raises(FileExistsError):
        write_certificates(tmp_path / "c", twice)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("members", "problem"),
    [
        ({"vehicles": ("a/b",)}, r"vehicle: 'a/b' must be"),
        ({"vehicles": ("a", "a")}, "vehicles: a, a: a name is there twice"),
        ({"vehicles": (), "hosts": ()}, "hosts: a server without a name"),
        ({"vehicles": (), "hosts": ("a b",)}, "hosts: 'a b' is neither"),
    ],
)
def test_members_that_make_no_sense_are_refused(
    members: dict[str, tuple[str, ...]], problem: str
) -> None:
    with pytest.raises(InvalidInput, match=problem):
        Members(**members)


@pytest.mark.parametrize("days", [0, 3651])
def test_a_certificate_is_good_for_a_day_to_ten_years(days: int) -> None:
    with pytest.raises(InvalidInput, match="days"):
        certify(Members(("cav-1",)), NOW, days)


def test_a_peer_is_whom_its_only_uri_names() -> None:
    mine, other = (identity_uri(Role.VEHICLE, name) for name in ("cav-1", "cav-10"))
    PeerIdentity((mine,)).check_vehicle("cav-1")
    for uris in ((), (other,), (mine, other), (identity_uri(Role.CONSUMER, "cav-1"),)):
        with pytest.raises(AccessDenied, match="'cav-1' is not whom"):
            PeerIdentity(uris).check_vehicle("cav-1")


def test_an_unencrypted_peer_is_nobody_and_a_nameless_certificate_is_not_that() -> None:
    assert peer_identity({}) is None
    assert peer_identity({"transport_security_type": [b"insecure"]}) is None
    assert peer_identity({"transport_security_type": [b"ssl"]}) == PeerIdentity(())


def test_a_certificate_is_added_without_touching_the_others(
    issued: tuple[Issued, ...], tmp_path: Path
) -> None:
    folder = tmp_path / "c"
    write_certificates(folder, issued)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    members = Members(("cav-2",), operators=("op",))
    added = add_certificates(folder, members, NOW, 5)
    assert [one.name for one in added] == ["vehicle-cav-2", "operator-op"]
    assert {name: (folder / name).read_bytes() for name in before} == before
    authority = x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes())
    for one in added:
        path = folder / f"{one.name}.key"
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        certificate = x509.load_pem_x509_certificate((folder / f"{one.name}.pem").read_bytes())
        certificate.verify_directly_issued_by(authority)


@pytest.mark.parametrize(
    ("change", "members", "days", "error"),
    [
        (None, Members(("cav-1",)), 5, "has a certificate of vehicle-cav-1 already"),
        (None, Members(()), 5, "name at least one"),
        (None, Members(("cav-2",)), 50, "beyond the authority's end"),
        ("ca.key", Members(("cav-2",)), 5, "is not the key of ca.pem"),
        ("ca.pem", Members(("cav-2",)), 5, "does not hold ca.pem and ca.key"),
    ],
)
def test_an_addition_that_cannot_be_made_leaves_the_folder_as_it_was(
    issued: tuple[Issued, ...],
    tmp_path: Path,
    change: str | None,
    members: Members,
    days: int,
    error: str,
) -> None:
    folder = tmp_path / "c"
    write_certificates(folder, issued)
    if change == "ca.key":
        (folder / "ca.key").write_bytes((folder / "server.key").read_bytes())
    elif change is not None:
        (folder / change).unlink()
    before = sorted(path.name for path in folder.iterdir())
    with pytest.raises((InvalidInput, InvalidData), match=error):
        add_certificates(folder, members, NOW, days)
    assert sorted(path.name for path in folder.iterdir()) == before


def test_serial_and_end_are_read_as_the_library_reads_them(issued: tuple[Issued, ...]) -> None:
    for one in issued:
        certificate = x509.load_pem_x509_certificate(one.certificate)
        context = {"transport_security_type": [b"ssl"], "x509_pem_cert": [one.certificate]}
        peer = peer_identity(context)
        assert peer is not None
        assert (peer.serial, peer.until) == (
            certificate.serial_number,
            certificate.not_valid_after_utc,
        )


@pytest.mark.parametrize(
    "damage", [b"", b"-----BEGIN-----AAAA-----END-----", b"-----a-----MIIB-----b-----"]
)
def test_a_certificate_that_cannot_be_read_lets_nobody_in(damage: bytes) -> None:
    with pytest.raises(InvalidData, match="cannot be read"):
        peer_identity({"transport_security_type": [b"ssl"], "x509_pem_cert": [damage]})
