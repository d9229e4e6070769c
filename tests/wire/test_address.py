"""Addresses are read strictly, and plaintext stays on the machine unless allowed out."""

import pytest

from rfcore.errors import InvalidInput
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
