"""As much of HPACK (RFC 7541) as one gRPC call needs: literal headers out, the status back.

Names of the static table are not told apart (they are all ``STATIC``): gRPC's own are not among
them. Strings in Huffman code raise ``ProtocolError``: gRPC's servers write none.
"""

from __future__ import annotations

from collections.abc import Iterable

from rfcore.errors import ProtocolError

__all__ = ["STATIC", "HeaderTable", "encoded"]

STATIC = "(static)"
STATIC_ENTRIES = 61
TABLE_BYTES = 4096
ENTRY_BYTES = 32
"""What an entry counts besides its name and value (RFC 7541, 4.1)."""

Header = tuple[str, str]


def encoded(headers: Iterable[Header]) -> bytes:
    """Return a header block of literals that nobody has to remember (6.2.2)."""
    return b"".join(b"\0" + _string(name) + _string(value) for name, value in headers)


class HeaderTable:
    """Reads the header blocks of one connection; each may refer to what earlier ones said."""

    def __init__(self) -> None:
        self._entries: list[Header] = []

    def decoded(self, block: bytes) -> list[Header]:
        """Return the headers of a block; raise ``ProtocolError`` if it is none we can read."""
        headers: list[Header] = []
        at = 0
        try:
            while at < len(block):
                at, header = self._next(block, at)
                if header is not None:
                    headers.append(header)
        except (IndexError, UnicodeDecodeError) as error:
            raise ProtocolError(f"header block of {len(block)} bytes: {error}") from error
        return headers

    def _next(self, block: bytes, at: int) -> tuple[int, Header | None]:
        first = block[at]
        if first & 0x80:  # a whole header by its number
            at, index = _integer(block, at, 7)
            return at, self._entry(index)
        if first & 0xE0 == 0x20:  # a new size for the table; ours never shrinks
            at, _ = _integer(block, at, 5)
            return at, None
        remember = bool(first & 0x40)
        at, index = _integer(block, at, 6 if remember else 4)
        if index:
            name = self._entry(index)[0]
        else:
            at, name = _text(block, at)
        at, value = _text(block, at)
        if remember:
            self._remember((name, value))
        return at, (name, value)

    def _entry(self, index: int) -> Header:
        return (
            (STATIC, "") if index <= STATIC_ENTRIES else self._entries[index - STATIC_ENTRIES - 1]
        )

    def _remember(self, header: Header) -> None:
        self._entries.insert(0, header)
        while sum(len(n) + len(v) + ENTRY_BYTES for n, v in self._entries) > TABLE_BYTES:
            self._entries.pop()


def _string(text: str) -> bytes:
    data = text.encode("ascii")
    if len(data) >= 0x7F:
        raise ProtocolError(f"header text of {len(data)} bytes; 126 may be")
    return bytes([len(data)]) + data


def _integer(block: bytes, at: int, bits: int) -> tuple[int, int]:
    """Read a number that begins in the low ``bits`` of a byte (5.1)."""
    most = (1 << bits) - 1
    value, at, shift = block[at] & most, at + 1, 0
    if value < most:
        return at, value
    while True:
        byte, at = block[at], at + 1
        value += (byte & 0x7F) << shift
        shift += 7
        if not byte & 0x80:
            return at, value


def _text(block: bytes, at: int) -> tuple[int, str]:
    is_huffman = bool(block[at] & 0x80)
    at, length = _integer(block, at, 7)
    if is_huffman:
        raise ProtocolError("a header in Huffman code, which this reader does not know")
    if at + length > len(block):
        raise ProtocolError(f"header text of {length} bytes in a block of {len(block)}")
    return at + length, block[at : at + length].decode("ascii")
