"""Identities in certificates: one URI as the subject alternative name, in the form of a SPIFFE ID.

``spiffe://rfedge/vehicle/cav-1`` may send frames as ``cav-1`` and as nobody else; every other role
(``server``, ``consumer``) may send none. <https://spiffe.io/docs/latest/spiffe-specs/spiffe-id/>
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum

from rfcore.errors import AccessDenied
from rfcore.wire.checks import check_name, shown

__all__ = ["PeerIdentity", "Role", "identity_uri", "peer_identity"]


class Role(StrEnum):
    """What a certificate is for."""

    SERVER = "server"
    VEHICLE = "vehicle"
    CONSUMER = "consumer"


def identity_uri(role: Role, name: str) -> str:
    """Return the URI that stands in the certificate of ``name``."""
    return f"spiffe://rfedge/{role}/{check_name(role, name)}"


@dataclass(frozen=True)
class PeerIdentity:
    """The URIs of a certificate that the authority vouches for."""

    uris: tuple[str, ...]

    def check_vehicle(self, vehicle_id: str) -> None:
        """Raise ``AccessDenied`` unless this is the certificate of ``vehicle_id``."""
        if self.uris != (identity_uri(Role.VEHICLE, vehicle_id),):
            named = ", ".join(shown(uri) for uri in self.uris) or "nobody"
            raise AccessDenied(
                f"vehicle {shown(vehicle_id)} is not whom its certificate names ({named})"
            )


def peer_identity(auth_context: Mapping[str, Iterable[bytes]]) -> PeerIdentity | None:
    """Return who a gRPC peer is, or None on a connection that is not encrypted."""
    if b"ssl" not in auth_context.get("transport_security_type", ()):
        return None
    uris = auth_context.get("peer_uri", ())
    return PeerIdentity(tuple(uri.decode("ascii", "backslashreplace") for uri in uris))
