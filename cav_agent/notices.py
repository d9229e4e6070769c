"""Sends a server's notices of the street to other programs of the vehicle, as lines of JSON.

Readers connect to a Unix socket that this user alone may open (``--notices PATH``) and get a line
for each notice from then on::

    {"notice_id": 3, "kind": "object", "valid_for_s": 1.0, "received_ns": 1764000000000000000,
     "field_id": "66f5...", "at_m": [12.1, 3.4, 0.0], "velocity_mps": [0.1, -4.2, 0.0],
     "width_m": 1.8, "height_m": 1.4, "distance_m": 31.0, "confidence": 1.0, "age_s": 2.1,
     "unseen_s": 0.12, "vehicles": 1}

``kind`` is object, map or light; the names of the rest are those of ``rfcore.wire.notices``. A
notice replaces an earlier one of its number. A reader that leaves ``MAX_UNREAD_BYTES`` unread is
disconnected, so that none delays the vehicle.
"""

from __future__ import annotations

import asyncio
import json
import socket
import stat
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any

import structlog

from rfcore.errors import InvalidInput
from rfcore.wire.notices import StreetNotice

log = structlog.get_logger()

MAX_UNREAD_BYTES = 64 << 10
MOST_READERS = 8
MAX_PATH_BYTES = 107
"""Longest name of a Unix socket: see unix(7)."""


def notice_line(notice: StreetNotice, received_ns: int) -> dict[str, Any]:
    """Return the line that readers get."""
    return {
        "notice_id": notice.notice_id,
        "valid_for_s": notice.valid_for_s,
        "received_ns": received_ns,
        **asdict(notice.subject),
        "kind": notice.kind,
    }


class NoticeSocket:
    """Listens at ``path`` while it is entered.

    Raises ``InvalidInput`` when it is entered, for a path that is too long, holds something that is
    no socket, or one at which another program listens.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._server: asyncio.Server | None = None
        self._readers: set[asyncio.StreamWriter] = set()

    async def __aenter__(self) -> NoticeSocket:
        _make_room(self._path)
        self._server = await asyncio.start_unix_server(self._serve, self._path)
        self._path.chmod(0o600)
        log.info("notices", socket=str(self._path))
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        assert self._server is not None
        self._server.close()
        for reader in tuple(self._readers):
            reader.close()
        with suppress(FileNotFoundError):
            self._path.unlink()

    def send(self, notice: StreetNotice) -> None:
        """Write a notice to every reader."""
        line = json.dumps(notice_line(notice, time.time_ns())).encode() + b"\n"
        for reader in tuple(self._readers):
            if reader.transport.get_write_buffer_size() + len(line) > MAX_UNREAD_BYTES:
                log.warning("reader of notices is too slow", limit_bytes=MAX_UNREAD_BYTES)
                reader.transport.abort()
                self._readers.discard(reader)
            else:
                reader.write(line)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Keep a reader connected until it leaves; what it sends is ignored."""
        if len(self._readers) >= MOST_READERS:
            log.warning("reader of notices refused", limit=MOST_READERS)
            writer.close()
            return
        self._readers.add(writer)
        try:
            while await reader.read(4096):
                pass
        except ConnectionError:
            pass
        finally:
            self._readers.discard(writer)
            writer.close()


def _make_room(path: Path) -> None:
    """Remove a socket at which no program listens any more."""
    if len(bytes(path)) > MAX_PATH_BYTES:
        raise InvalidInput("notices", f"{path} has more than {MAX_PATH_BYTES} bytes; shorten it")
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise InvalidInput("notices", f"{path} exists and is no socket; give another path")
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()
            return
    raise InvalidInput("notices", f"another program listens at {path}; give another path")
