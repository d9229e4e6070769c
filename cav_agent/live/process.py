"""The reader's process as its parent sees it: started, read with a time limit, killed."""

from __future__ import annotations

import os
import select
import subprocess
import sys

from cav_agent.live.record import HEADER_BYTES, EndRecord, Header, Record, record_of
from cav_agent.live.settings import ReaderSettings
from rfcore.errors import RfedgeError

__all__ = ["ReaderProcess"]

BODY_TIMEOUT_S = 5.0
"""For the rest of a record that has begun: the pipe's other end has it in memory."""


class ReaderProcess:
    """``cav_agent.live.reader`` on one source; ``close`` kills it."""

    def __init__(self, settings: ReaderSettings) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "cav_agent.live.reader", settings.to_json()],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
        )
        if self._process.stdout is None:
            raise RfedgeError("the camera's reader has no output")
        self._output = self._process.stdout.fileno()

    def read(self, timeout_s: float) -> Record | None:
        """Return the next record, or None if none begins in time; raise ``RfedgeError``."""
        if not self._is_readable(timeout_s):
            return None
        header_bytes = self._exactly(HEADER_BYTES)
        if header_bytes is None:
            return EndRecord("the camera's reader died")
        header = Header.parsed(bytes(header_bytes))
        body = self._exactly(header.length)
        return EndRecord("the camera's reader died") if body is None else record_of(header, body)

    def close(self) -> None:
        """Kill it and wait for its end."""
        self._process.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        self._process.wait(10.0)

    def _is_readable(self, timeout_s: float) -> bool:
        return bool(select.select([self._output], [], [], timeout_s)[0])

    def _exactly(self, count: int) -> bytearray | None:
        """Read so many bytes; ``None`` if the output ends before."""
        data = bytearray(count)
        view, have = memoryview(data), 0
        while have < count:
            if not self._is_readable(BODY_TIMEOUT_S):
                raise RfedgeError("the camera's reader stopped within a frame")
            got = os.readv(self._output, [view[have:]])
            if not got:
                return None
            have += got
        return data
