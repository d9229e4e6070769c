"""``rfedge watch``: look at what an edge server sees."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional

__all__ = ["Watch"]


@dataclass(frozen=True)
class Watch:
    """Print, and if asked keep, the pictures a server reconstructs, until it stops or Ctrl-C."""

    address: Positional[str]
    """HOST:PORT of mec-server."""
    vehicle: tuple[str, ...] = ()
    """Only these vehicles; default: all."""
    dir: Path | None = None
    """Keep pictures as DIR/VEHICLE/CAMERA/SEQUENCE.png (or .jpg) beside an index.jsonl."""
    mp4: Path | None = None
    """Keep one camera, the first that is seen, as a video; its times are those of capture."""
    encoding: Literal["none", "i420", "jpeg", "png"] | None = None
    """How pictures travel; default: i420 (exact) for a video, jpeg for a folder, else none."""
    pictures: int | None = None
    """Stop after so many pictures."""
    tls_cert: Path | None = None
    """Certificate of this consumer (PEM), for a server that has one."""
    tls_key: Path | None = None
    """Its private key."""
    tls_ca: Path | None = None
    """Certificate of the authority that vouches for the server."""
    allow_insecure: Annotated[bool, FlagCreatePairsOff] = False
    """Watch a server on another machine in plaintext."""

    def run(self) -> None:
        """Watch until the server ends the stream, enough was seen, SIGINT or SIGTERM."""
        import signal
        from contextlib import suppress

        from rfcore.wire.tls import TlsFiles
        from rfedge.watch import WatchSettings, watch

        settings = WatchSettings(
            address=self.address,
            vehicle_ids=frozenset(self.vehicle),
            folder=self.dir,
            video=self.mp4,
            encoding=self.encoding,
            pictures=self.pictures,
            tls=TlsFiles.of(self.tls_cert, self.tls_key, self.tls_ca),
            allow_insecure=self.allow_insecure,
        )
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        with suppress(KeyboardInterrupt):  # the usual end; files are closed on the way
            watch(settings)
