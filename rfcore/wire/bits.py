"""Packed bits, most significant first: whole numbers written with as many as they need.

A number is 6 bits, the width w, and w bits; several may share one width. Signed values are written
as 2 v, or -2 v - 1 below 0.
"""

from __future__ import annotations

from rfcore.errors import InvalidInput


class BitReader:
    """Bits that are read from the start of some bytes."""

    def __init__(self, data: bytes) -> None:
        self._value = int.from_bytes(data, "big")
        self._count = self._left = 8 * len(data)

    def take(self, width: int) -> int:
        self._left -= width
        if self._left < 0:
            raise InvalidInput("frame", "ends within its head")
        return self._value >> self._left & (1 << width) - 1

    def number(self) -> int:
        return self.take(self.take(6))

    def signed(self, width: int) -> int:
        value = self.take(width)
        return value >> 1 ^ -(value & 1)

    def triple(self) -> tuple[int, int, int]:
        width = self.take(6)
        return self.signed(width), self.signed(width), self.signed(width)

    def skip_to_byte(self) -> None:
        if self.take(self._left % 8):
            raise InvalidInput("frame", "has bits set between head and check")

    @property
    def bits_taken(self) -> int:
        return self._count - self._left


class BitWriter:
    """Bits that are written one after the other."""

    def __init__(self) -> None:
        self._value, self._count = 0, 0

    def put(self, value: int, width: int) -> None:
        self._value, self._count = self._value << width | value, self._count + width

    def number(self, value: int) -> None:
        self.signed_values((value,), signed=False)

    def signed_values(self, values: tuple[int, ...], *, signed: bool = True) -> None:
        mapped = [2 * v if v >= 0 else -2 * v - 1 for v in values] if signed else list(values)
        width = max(mapped).bit_length()
        self.put(width, 6)
        for value in mapped:
            self.put(value, width)

    def to_bytes(self) -> bytes:
        count = -(-self._count // 8)
        return (self._value << 8 * count - self._count).to_bytes(count, "big")


class ByteReader:
    """Bytes that are cut off one after the other."""

    def __init__(self, data: bytes, start: int) -> None:
        self._data, self._at = data, start

    def take(self, count: int) -> bytes:
        part = self._data[self._at : self._at + count]
        if len(part) < count:
            raise InvalidInput("frame", "ends within its head")
        self._at += count
        return part

    def rest(self) -> bytes:
        return self._data[self._at :]
