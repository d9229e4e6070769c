"""A proxy's header names a vehicle, or is refused."""

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from typing import Any
from urllib.parse import quote

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mec_server.guard import FORWARDED, Proxies, forwarded_auth_context
from rfcore.errors import AccessDenied, RfedgeError
from rfcore.wire.tls import Role, peer_identity
from rfedge.certs import Members, certify

NOW = datetime(2030, 1, 2, tzinfo=UTC)
ISSUED = {
    one.name: one
    for one in certify(Members(("cav-1",), ("desk",), ("h",), ("op",), ("edge",)), NOW, 10)
}
CERT = f'Cert="{quote(ISSUED["vehicle-cav-1"].certificate)}"'
URI = "URI=spiffe://rfedge/vehicle/cav-1"
HEADER = f"By=spiffe://rfedge/server/edge;Hash=ab12;{CERT};{URI}"


class Call:
    """The part of gRPC's context of a call that is used."""

    def __init__(self, peer: str | None, headers: Iterable[str]) -> None:
        self._auth: Mapping[str, Iterable[bytes]] = {}
        if peer is not None:
            pem = ISSUED[peer]
            self._auth = {
                "transport_security_type": (b"ssl",),
                "peer_uri": (pem.identity.encode(),),
                "x509_pem_cert": (pem.certificate,),
            }
        self._metadata = [("user-agent", "x"), *((FORWARDED, header) for header in headers)]

    def auth_context(self) -> Mapping[str, Iterable[bytes]]:
        return self._auth

    def invocation_metadata(self) -> Any:
        return tuple(self._metadata)

    def peer(self) -> str:
        return "ipv4:127.0.0.1:1"


def test_a_header_names_the_client_as_its_own_connection_would() -> None:
    direct = peer_identity(Call("vehicle-cav-1", ()).auth_context())
    assert peer_identity(forwarded_auth_context(HEADER)) == direct
    assert direct is not None
    assert direct.role_and_name() == (Role.VEHICLE, "cav-1")
    assert direct.until == datetime(2030, 1, 12, tzinfo=UTC)


@pytest.mark.parametrize(
    "header",
    [
        f"{URI};{CERT}",
        f'Subject="CN=a\\"b;c,d";{CERT};{URI}',
        f'{CERT};URI="spiffe://rfedge/vehicle/cav-1"',
    ],
)
def test_keys_may_come_in_any_order_and_values_be_quoted(header: str) -> None:
    assert peer_identity(forwarded_auth_context(header)) == peer_identity(
        forwarded_auth_context(HEADER)
    )


@pytest.mark.parametrize(
    ("header", "problem"),
    [
        ("", "cannot be read"),
        ("cav-1", "cannot be read"),
        (f"{HEADER};", "cannot be read"),
        (f'{HEADER};Subject="a', "cannot be read"),
        (f"{HEADER},{HEADER}", "of several proxies"),
        (URI, "0 certificates"),
        (f"{HEADER};{CERT}", "2 certificates"),
        (f"{HEADER};URI=spiffe://rfedge/vehicle/cav-2", "names one identity"),
        (CERT, "names one identity"),
        (f"{CERT};URI=https://example.org", "unknown here"),
        (f"{CERT};URI=spiffe://rfedge/proxy/edge", "does not speak for"),
        (f"{CERT};URI=spiffe://rfedge/server/edge", "does not speak for"),
        (f"Cert=nonsense;{URI}", "certificate cannot be read"),
        (f"Cert=%ff%fe;{URI}", "certificate cannot be read"),
    ],
)
def test_a_header_that_names_not_one_client_is_refused(header: str, problem: str) -> None:
    with pytest.raises(RfedgeError, match=problem):
        forwarded_auth_context(header)


@given(st.text(alphabet='aB=;,"\\%/: U', max_size=60))
def test_no_text_is_an_unexpected_error(text: str) -> None:
    with pytest.raises(RfedgeError):
        forwarded_auth_context(text)


@pytest.mark.parametrize("peer", ["vehicle-cav-1", "consumer-desk", "operator-op", "server", None])
def test_only_a_proxy_that_was_named_is_one(peer: str | None) -> None:
    call: Any = Call(peer, (HEADER,))
    assert Proxies(("edge",)).proxy_of(call) is None


def test_a_proxy_is_one_only_to_a_server_that_was_told_its_name() -> None:
    call: Any = Call("proxy-edge", (HEADER,))
    assert Proxies(()).proxy_of(call) is None
    assert Proxies(("other",)).proxy_of(call) is None
    assert Proxies(("other", "edge")).proxy_of(call) == peer_identity(call.auth_context())


def test_a_proxys_call_is_its_clients_and_without_a_header_its_own() -> None:
    proxies = Proxies(("edge",))
    own: Any = Call("proxy-edge", ())
    assert proxies.client_context(own) is own
    forwarded: Any = Call("proxy-edge", (HEADER,))
    seen = proxies.client_context(forwarded)
    assert peer_identity(seen.auth_context()) == peer_identity(forwarded_auth_context(HEADER))
    assert seen.peer() == forwarded.peer()
    twice: Any = Call("proxy-edge", (HEADER, HEADER))
    with pytest.raises(AccessDenied, match="2 headers"):
        proxies.client_context(twice)
