"""Network addresses, and the rule that plaintext stays on this machine unless allowed out."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass

from rfcore.errors import InvalidInput
from rfcore.wire.checks import shown

__all__ = ["Address"]


@dataclass(frozen=True)
class Address:
    """``host:port``; an IPv6 host stands in brackets in text."""

    host: str
    port: int

    @staticmethod
    def parse(field: str, text: str) -> Address:
        """Return the address in ``text``; raise ``InvalidInput`` naming ``field``."""
        host, colon, port = text.rpartition(":")
        bare = host[1:-1] if host.startswith("[") and host.endswith("]") else host
        if not colon or not bare or (":" in bare and bare == host):
            raise InvalidInput(field, f"{shown(text)} must be HOST:PORT, as 127.0.0.1:50051")
        if not (port.isascii() and port.isdigit() and int(port) <= 65535):
            raise InvalidInput(field, f"port {shown(port)} must be a number in 0..65535")
        return Address(bare, int(port))

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    @property
    def is_loopback(self) -> bool:
        """Whether the address cannot be reached from another machine."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    def require_private(self, field: str, allow_insecure: bool) -> None:
        """Raise ``InvalidInput`` for plaintext that would leave the machine without permission."""
        if not (self.is_loopback or allow_insecure):
            raise InvalidInput(
                field,
                f"{self} is not a loopback address and the stream is not encrypted; "
                "give --allow-insecure if the network is trusted",
            )
