"""Addresses are read strictly, and plaintext stays on the machine unless allowed out."""

import re
import socket

import pytest

from rfcore.errors import InvalidInput, RfedgeError
from rfcore.wire.address import Address


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [
        ("127.0.0.1:50051", "127.0.0.1", 50051),
        ("localhost:0", "localhost", 0),
        ("[::1]:65535", "::1", 65535),
        ("edge.example.org:443", "edge.example.org", 443),
    ],
)
def test_an_address_survives_its_text(text: str, host: str, port: int) -> None:
    address = Address.parse("listen", text)
    assert address == Address(host, port)
    assert str(address) == text


@pytest.mark.parametrize("text", ["", "host", ":1", "::1:80", "[]:1", "h:", "h:-1", "h:65536"])
def test_what_is_no_address_is_refused_by_name(text: str) -> None:
    with pytest.raises(InvalidInput, match=r"^listen: "):
        Address.parse("listen", text)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.9.1", "::1", "localhost"])
def test_loopback_needs_no_permission(host: str) -> None:
    Address(host, 1).require_private("listen", allow_insecure=False)


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.1", "::", "example.org", "localhost.org"])
def test_anything_else_does(host: str) -> None:
    with pytest.raises(InvalidInput, match="--allow-insecure"):
        Address(host, 1).require_private("listen", allow_insecure=False)
    Address(host, 1).require_private("listen", allow_insecure=True)


def test_an_address_in_use_is_named_with_the_option_to_change() -> None:
    with socket.create_server(("127.0.0.1", 0)) as holder:
        address = Address("127.0.0.1", holder.getsockname()[1])
        problem = f"cannot listen on {address}: Address already in use; give another --listen"
        with pytest.raises(RfedgeError, match=f"^{re.escape(problem)}$"):
            address.check_free("--listen")
    address.check_free("--listen")
    address.check_free("--listen")


def test_an_address_that_is_not_of_this_machine_is_named() -> None:
    with pytest.raises(RfedgeError, match=r"on 192\.0\.2\.1:1: Cannot assign requested address"):
        Address("192.0.2.1", 1).check_free("--listen")


def test_port_0_is_always_free() -> None:
    Address("192.0.2.1", 0).check_free("--listen")
