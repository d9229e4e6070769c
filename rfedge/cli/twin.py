"""``rfedge twin``: the street in a browser."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from rfedge.arguments import ADDRESS, DATASET, FOLDER, TwinConnection, Up, open_drive

if TYPE_CHECKING:
    from collections.abc import Callable

    from rfcore.camera import Vec3
    from rfcore.field import RadianceField, SplatField
    from rfedge.twin.scene import TwinScene
    from rfedge.twin.web import Source


@dataclass(frozen=True)
class Twin:
    """Look at a server's street, or at one field, in a browser, until Ctrl-C."""

    target: Annotated[str | None, Positional, arg(metavar="HOST:PORT|FIELD")] = None
    """Address of a mec-server; or a field (archive, name, .ply, .spz, .glb) without one."""
    http: Annotated[str, ADDRESS] = "127.0.0.1:8080"
    """Address to serve the page at; port 0 takes a free one. For browsers elsewhere give a
    token."""
    token: Annotated[str | None, arg(metavar="TOKEN")] = None
    """Secret that a browser must send, as /?token=TOKEN; at least 16 characters. Default: the
    environment variable RFEDGE_TWIN_TOKEN, which a list of processes does not show."""
    drive: Annotated[Path | None, DATASET] = None
    """With a field: show the pictures of this drive beside the field's renders."""
    follow: bool = False
    """Show a field archive again each time that it is written."""
    until_exit_of: Annotated[int | None, arg(metavar="PID")] = None
    """End when this process has ended, too."""
    rate_hz: float = 10.0
    """Pictures a second of a drive."""
    up: Up | None = None
    """Axis that points up; default: as the field's training cameras show it, else the drive's."""
    threads: int = 1
    """Threads that render a field for comparison."""
    fields: Annotated[Path, FOLDER] = Path("out/twin/fields")
    """Folder for fields of servers."""
    connection: OmitArgPrefixes[TwinConnection] = TwinConnection()
    sensorsim: Annotated[str | None, ADDRESS] = None
    """Loopback address at which simulators may ask for pictures: SensorsimService of AlpaSim and
    NuRec (docs/how-to/simulators.md)."""
    objects: Annotated[tuple[str, ...], arg(name="object", metavar="ID=FIELD ...")] = ()
    """With --sensorsim: draw the objects of these ids as these fields of splats, each in its
    object's own axes."""
    ready_file: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the page's address here once it can be opened."""

    def run(self) -> None:
        """Serve the page until SIGINT or SIGTERM."""
        from rfcore.errors import InvalidInput
        from rfcore.wire.address import Address
        from rfedge.twin.web import TwinRun, WebSettings, run_twin

        token = self.token or os.environ.get("RFEDGE_TWIN_TOKEN")
        web = WebSettings(Address.parse("http", self.http), token)
        sensorsim = Address.parse("sensorsim", self.sensorsim) if self.sensorsim else None
        if self.objects and sensorsim is None:
            raise InvalidInput("object", "belongs to --sensorsim HOST:PORT, which is not given")
        shapes = dict(map(self._shape, self.objects))
        run_twin(
            TwinRun(web, self._source(), self.ready_file, self.until_exit_of, sensorsim, shapes)
        )

    def _shape(self, text: str) -> tuple[str, SplatField]:
        from rfcore.errors import InvalidInput
        from rfcore.field import SplatField

        track_id, _, path = text.partition("=")
        if not (track_id and path):
            raise InvalidInput("object", f"'{text}' is not ID=FIELD")
        field = self._open(path)
        if not isinstance(field, SplatField):
            raise InvalidInput(
                "object", f"{path} is a field of kind {field.metadata.kind}; give one of splats"
            )
        return track_id, field

    def _source(self) -> Callable[[TwinScene], Source]:
        from rfcore.errors import InvalidInput

        if (self.target is None) == (self.connection.nats is None):
            raise InvalidInput("target", "give one: a server, a field, or --nats URL")
        if self.target is None:
            return self._upright(self._nats(self.connection.nats or ""))
        if _is_address(self.target):
            return self._upright(self._server(self.target))
        return self._field(self.target)

    def _upright(
        self, source: Callable[[TwinScene], Source], otherwise: Vec3 | None = None
    ) -> Callable[[TwinScene], Source]:
        """Return ``source`` for a scene whose vertical is that of --up, or ``otherwise``."""
        from rfedge.fields.viewpoints import UPS

        def upright(scene: TwinScene) -> Source:
            scene.up = otherwise if self.up is None else UPS[self.up]
            return source(scene)

        return upright

    def _nats(self, urls: str) -> Callable[[TwinScene], Source]:
        from rfedge.twin.nats_source import NatsSource

        servers = self.connection.nats_servers(urls)
        return lambda scene: NatsSource(servers, self.fields, scene, self.threads)

    def _server(self, address: str) -> Callable[[TwinScene], Source]:
        from rfcore.errors import InvalidInput
        from rfcore.wire.twin_client import AsyncTwinClient
        from rfedge.twin.server_source import ServerSource

        if self.drive is not None:
            raise InvalidInput("drive", "belongs to a field; a server shows what vehicles send")
        tls, allow_insecure = self.connection.tls(), self.connection.allow_insecure
        client = AsyncTwinClient(address, tls, allow_insecure=allow_insecure)
        return lambda scene: ServerSource(client, self.fields, scene, self.threads)

    def _field(self, target: str) -> Callable[[TwinScene], Source]:
        from rfcore.errors import InvalidInput
        from rfcore.vertical import vertical_of
        from rfedge.twin.drive_source import DriveSource, FollowedFile

        if not 0 < self.rate_hz <= 120:
            raise InvalidInput("rate_hz", f"{self.rate_hz:g} is outside 0..120")
        opened = None if self.follow else self._open(target)
        field = opened or FollowedFile(Path(target), self.threads)
        drive = open_drive(self.drive, opened).pictures if self.drive else ()
        name = Path(target).stem
        up = None
        if not isinstance(field, FollowedFile) and not field.metadata.states_up:
            up = vertical_of(picture.camera.world_from_cam for picture in drive)
        return self._upright(lambda scene: DriveSource(name, field, drive, self.rate_hz, scene), up)

    def _open(self, target: str) -> RadianceField:
        from rfcore.field import FieldMetadata, SplatField, read_splat_file
        from rfcore.field.splat_file import SPLAT_SUFFIXES
        from rfedge.arguments import open_field

        if target.endswith(SPLAT_SUFFIXES):
            read = read_splat_file(Path(target))
            for note in read.notes:
                print(note, file=sys.stderr)
            metadata = FieldMetadata(
                "", read.tile_origin, antialiased=read.antialiased is True, up=read.up
            )
            return SplatField(read.splats, metadata, threads=self.threads)
        return open_field(target, threads=self.threads)


def _is_address(target: str) -> bool:
    """Whether the target reads HOST:PORT and is no file."""
    port = target.rpartition(":")[2]
    return ":" in target and port.isdigit() and not Path(target).exists()
