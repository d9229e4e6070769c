"""Commands beside the services: ``rfedge watch`` and ``rfedge certs``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg, subcommand

from rfedge.arguments import ADDRESS, FIELD, FOLDER, TwinConnection, open_field


@dataclass(frozen=True)
class Watch:
    """Print, and if asked keep, the pictures a server reconstructs, until it stops or Ctrl-C."""

    address: Annotated[str | None, Positional, ADDRESS] = None
    """Address of mec-server."""
    vehicle: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ()
    """Only these vehicles; default: all."""
    dir: Annotated[Path | None, FOLDER] = None
    """Keep pictures as DIR/VEHICLE/CAMERA/SEQUENCE.png (or .jpg) beside an index.jsonl."""
    mp4: Annotated[Path | None, arg(metavar="FILE.mp4")] = None
    """Keep one camera, the first that is seen, as a video; its times are those of capture."""
    mcap: Annotated[Path | None, arg(metavar="FILE.mcap")] = None
    """Keep all cameras as MCAP for Foxglove and the like: video, calibration, poses, metrics, and
    the objects of a server, which cost it time (docs/how-to/bags.md)."""
    cpm: Annotated[Path | None, arg(metavar="FILE.jsonl")] = None
    """Keep the objects of a server on --field, which needs an anchor, as Collective Perception
    Messages of ETSI, a line of JSON each with the UPER as hexadecimal digits."""
    station: int = 0
    """With --cpm: the stationId of the messages."""
    field: Annotated[Path | None, FIELD] = None
    """With --mcap: show this field's splats as points; its world is that of the poses. With --cpm:
    the field of the objects."""
    encoding: Literal["none", "i420", "jpeg", "png"] | None = None
    """Form in which pictures are sent; default: i420 (exact) for a video or an MCAP, jpeg for a
    folder, else none."""
    pictures: int | None = None
    """Stop after this many pictures."""
    connection: OmitArgPrefixes[TwinConnection] = TwinConnection()

    def run(self) -> None:
        """Watch until the server ends the stream, enough was seen, SIGINT or SIGTERM."""
        from rfcore.errors import InvalidInput
        from rfcore.extras import require
        from rfedge.watch import WatchSettings, watch_until_stopped

        if self.field is not None and self.mcap is None and self.cpm is None:
            raise InvalidInput("field", "belongs to --mcap or --cpm")
        if self.mcap is not None:
            require("bags", "mcap", "foxglove_schemas_protobuf")
        if self.cpm is not None:
            require("v2x", "asn1tools", "pymap3d")
        field = open_field(self.field) if self.field is not None else None
        settings = WatchSettings(
            vehicle_ids=frozenset(self.vehicle),
            folder=self.dir,
            video=self.mp4,
            mcap=self.mcap,
            cpm=self.cpm,
            station=self.station,
            encoding=self.encoding,
            pictures=self.pictures,
        )
        urls = self.connection.nats
        if (self.address is None) == (urls is None):
            raise InvalidInput("address", "give one: HOST:PORT of a server, or --nats URL")
        if urls is not None:
            from rfedge.twin.nats_source import NatsPictures

            pictures = NatsPictures(self.connection.nats_servers(urls))
            watch_until_stopped(settings, pictures, field=field)
            return
        from rfcore.wire.twin_client import TwinClient

        tls, allow_insecure = self.connection.tls(), self.connection.allow_insecure
        with TwinClient(self.address or "", tls, allow_insecure=allow_insecure) as client:
            watch_until_stopped(settings, client, client.objects, field)


@dataclass(frozen=True)
class CertsInit:
    """Make a folder of certificates: an authority, servers, vehicles, consumers of the twin."""

    out: Annotated[Path, FOLDER] = Path("out/certs")
    """The folder to make: ca.pem, server.pem, vehicle-NAME.pem, consumer-NAME.pem, each with its
    .key, which only the owner may read."""
    vehicles: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ("cav-1",)
    """Vehicles; each certificate is good for that name (cav-agent --vehicle) only."""
    consumers: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ("watch",)
    """Consumers, which are no vehicles; they may watch the twin and ask for the server's health."""
    operators: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ()
    """Operators, which may see everything, whatever consumers are granted."""
    proxies: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ()
    """Proxies before the servers, as in mec-server --proxy-identity."""
    hosts: Annotated[tuple[str, ...], arg(metavar="HOST ...")] = ("localhost", "127.0.0.1", "::1")
    """Names and addresses by which vehicles reach the server."""
    days: int = 365
    """Days for which the certificates are valid."""
    replace: bool = False
    """Replace the certificates in OUT; earlier ones are then refused."""

    def run(self) -> None:
        """Make them and say what is where."""
        from datetime import UTC, datetime

        from rfedge.certs import Members, certify, write_certificates

        members = Members(self.vehicles, self.consumers, self.hosts, self.operators, self.proxies)
        issued = certify(members, datetime.now(UTC), self.days)
        write_certificates(self.out, issued, replace=self.replace)
        for certificate in issued:
            print(f"{self.out / certificate.name}.pem  {certificate.identity}")
        print(f"keep {self.out / 'ca.key'} away from servers and vehicles")


@dataclass(frozen=True)
class CertsAdd:
    """Add certificates to a folder, by its authority; those that are there stay as they are."""

    folder: Annotated[Path, Positional, FOLDER] = Path("out/certs")
    """The folder of `rfedge certs init`, with the authority's key."""
    vehicles: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ()
    """Vehicles to add."""
    consumers: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ()
    """Consumers to add; what they may see stands in the server's --access file."""
    operators: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ()
    """Operators to add."""
    proxies: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ()
    """Proxies to add."""
    days: int = 90
    """Days for which the certificates are valid."""

    def run(self) -> None:
        """Sign, write, and say what is where."""
        from datetime import UTC, datetime

        from rfedge.certs import Members, add_certificates

        members = Members(
            self.vehicles, self.consumers, operators=self.operators, proxies=self.proxies
        )
        for one in add_certificates(self.folder, members, datetime.now(UTC), self.days):
            print(f"{self.folder / one.name}.pem  {one.identity}")


@dataclass(frozen=True)
class CertsShow:
    """Print what each certificate in a folder says; one that is no longer good is an error."""

    folder: Annotated[Path, Positional, FOLDER] = Path("out/certs")
    """The folder of `rfedge certs init`."""
    within_days: int = 0
    """Also fail if one expires within this many days."""

    def run(self) -> None:
        """Read, print, judge."""
        from datetime import UTC, datetime, timedelta

        from rfcore.errors import InvalidData
        from rfedge.certs import read_certificates

        soon = datetime.now(UTC) + timedelta(days=self.within_days)
        ending = []
        for name, says in read_certificates(self.folder).items():
            print(f"{name}  until {says.until:%Y-%m-%d %H:%M} UTC  {', '.join(says.names)}")
            if says.until <= soon:
                ending.append(name)
        if ending:
            raise InvalidData(f"{', '.join(ending)}: make new ones (rfedge certs init --replace)")


@dataclass(frozen=True)
class Certs:
    """Certificates for mec-server, vehicles and consumers."""

    verb: Annotated[
        Annotated[CertsInit, subcommand("init")]
        | Annotated[CertsAdd, subcommand("add")]
        | Annotated[CertsShow, subcommand("show")],
        arg(name=""),
    ]

    def run(self) -> None:
        """Run the sub-verb."""
        self.verb.run()
