"""``rfedge twin``: the street in a browser."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from rfedge.arguments import ADDRESS, DATASET, FOLDER

if TYPE_CHECKING:
    from collections.abc import Callable

    from rfcore.camera import TileOrigin
    from rfcore.field import RadianceField
    from rfedge.twin.drive_source import FieldVersions
    from rfedge.twin.scene import TwinScene
    from rfedge.twin.web import Source

__all__ = ["Twin"]

PEM = arg(metavar="FILE.pem")


@dataclass(frozen=True)
class Twin:
    """Look at a server's street, or at one field, in a browser, until Ctrl-C."""

    target: Annotated[str, Positional, arg(metavar="HOST:PORT|FIELD")]
    """Where mec-server listens; or a field (archive, name, .ply, .spz) to look at without one."""
    http: Annotated[str, ADDRESS] = "127.0.0.1:8080"
    """Where to serve the page; port 0 takes a free one. For browsers elsewhere give a token."""
    token: Annotated[str | None, arg(metavar="TOKEN")] = None
    """What a browser must know, as /?token=TOKEN; at least 16 characters. Default: the
    environment variable RFEDGE_TWIN_TOKEN, which a list of processes does not show."""
    drive: Annotated[Path | None, DATASET] = None
    """With a field: show the pictures of this drive beside the field's renders."""
    follow: bool = False
    """With a field archive: show it anew each time that it is written."""
    until_exit_of: Annotated[int | None, arg(metavar="PID")] = None
    """End when this process has ended, too."""
    rate_hz: float = 10.0
    """With a drive: pictures a second."""
    threads: int = 1
    """Threads that render a field for comparison."""
    fields: Annotated[Path, FOLDER] = Path("out/twin/fields")
    """With a server: where its fields are kept."""
    tls_cert: Annotated[Path | None, PEM] = None
    """Certificate of this consumer (PEM), for a server that has one."""
    tls_key: Annotated[Path | None, PEM] = None
    """Its private key."""
    tls_ca: Annotated[Path | None, PEM] = None
    """Certificate of the authority that vouches for the server."""
    allow_insecure: bool = False
    """Watch a server on another machine in plaintext."""
    ready_file: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the page's address here once it can be opened."""

    def run(self) -> None:
        """Serve the page until SIGINT or SIGTERM."""
        from rfcore.wire.address import Address
        from rfedge.twin.web import TwinRun, WebSettings, run_twin

        token = self.token or os.environ.get("RFEDGE_TWIN_TOKEN")
        web = WebSettings(Address.parse("http", self.http), token)
        source = self._server() if self._is_address() else self._field()
        run_twin(TwinRun(web, source, self.ready_file, self.until_exit_of))

    def _is_address(self) -> bool:
        """Whether the target reads HOST:PORT and is no file."""
        port = self.target.rpartition(":")[2]
        return ":" in self.target and port.isdigit() and not Path(self.target).exists()

    def _server(self) -> Callable[[TwinScene], Source]:
        from rfcore.errors import InvalidInput
        from rfcore.wire.tls import TlsFiles
        from rfedge.twin.server_source import ServerSource, ServerTarget

        if self.drive is not None:
            raise InvalidInput("drive", "belongs to a field; a server shows what vehicles send")
        tls = TlsFiles.of(self.tls_cert, self.tls_key, self.tls_ca)
        target = ServerTarget(self.target, self.fields, tls, self.allow_insecure)
        return lambda scene: ServerSource(target, scene, self.threads)

    def _field(self) -> Callable[[TwinScene], Source]:
        from rfcore.dataset import read_dataset
        from rfcore.errors import InvalidInput
        from rfedge.twin.drive_source import DriveSource

        if not 0 < self.rate_hz <= 120:
            raise InvalidInput("rate_hz", f"{self.rate_hz:g} is outside 0..120")
        versions, origin = self._versions()
        drive = read_dataset(self.drive, tile_origin=origin).pictures if self.drive else ()
        name = Path(self.target).stem
        return lambda scene: DriveSource(name, versions, drive, self.rate_hz, scene)

    def _versions(self) -> tuple[FieldVersions, TileOrigin | None]:
        """Return the field, or the file that is followed; and its origin where it is known."""
        from rfedge.twin.drive_source import FollowedFile, OneField

        if self.follow:
            return FollowedFile(Path(self.target), self.threads), None
        field = self._open()
        return OneField(field), field.metadata.tile_origin

    def _open(self) -> RadianceField:
        from rfcore.field import FieldMetadata, SplatField, read_splat_file
        from rfcore.field.splat_file import SPLAT_SUFFIXES
        from rfedge.arguments import open_field

        if self.target.endswith(SPLAT_SUFFIXES):
            splats, antialiased = read_splat_file(Path(self.target))
            metadata = FieldMetadata(antialiased=antialiased is True)
            return SplatField(splats, metadata, threads=self.threads)
        return open_field(self.target, threads=self.threads)
