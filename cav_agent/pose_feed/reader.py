"""Bytes of a feed into fixes: lines, and the format of each line by how it begins."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from cav_agent.pose_feed.fix import BadReading, FeedProblem, Fix
from cav_agent.pose_feed.json_lines import JsonParser
from cav_agent.pose_feed.nmea import NmeaParser

__all__ = ["FeedReader"]

MAX_LINE_BYTES = 4096
"""NMEA allows 82, gpsd's reports take up to 1.5 KB."""


class FeedReader:
    """Takes bytes as they come; ``refused`` hears of each line that cannot be used."""

    def __init__(self, refused: Callable[[BadReading], None]) -> None:
        self._refused = refused
        self._left = b""
        self._is_skipping = False
        self._json = JsonParser()
        self._nmea: NmeaParser | None = None

    def receive(self, data: bytes, now_ns: int) -> list[Fix]:
        """Return the fixes of the lines that ``data`` completes; never raises on content."""
        lines = (self._left + data).split(b"\n")
        self._left = lines.pop()
        if len(self._left) > MAX_LINE_BYTES:
            if not self._is_skipping:
                self._refused(_too_long())
            self._left, self._is_skipping = b"", True
        return list(self._fixes(lines, now_ns))

    def end(self, now_ns: int) -> list[Fix]:
        """Return the fix of a last line without an end; a datagram is complete, too."""
        return self.receive(b"\n", now_ns) if self._left.strip() else []

    def _fixes(self, lines: list[bytes], now_ns: int) -> Iterator[Fix]:
        for line in lines:
            if self._is_skipping:
                self._is_skipping = False
                continue
            try:
                fix = self._fix(line, now_ns)
            except BadReading as error:
                self._refused(error)
                continue
            if fix is not None:
                yield fix

    def _fix(self, line: bytes, now_ns: int) -> Fix | None:
        if len(line) > MAX_LINE_BYTES:
            raise _too_long()
        try:
            text = line.decode("ascii").strip()
        except UnicodeDecodeError as error:
            raise BadReading(FeedProblem.MALFORMED, f"{line[:40]!r} is not ASCII") from error
        if not text or text.startswith("#"):
            return None
        if text[0] in "$!":
            if self._nmea is None:
                self._nmea = NmeaParser()
            return self._nmea.receive(text, now_ns)
        return self._json.receive(text)


def _too_long() -> BadReading:
    return BadReading(FeedProblem.MALFORMED, f"a line of more than {MAX_LINE_BYTES} bytes")
