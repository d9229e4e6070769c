"""The content of the page: fields where they lie, cameras with their newest pictures.

``TwinScene`` turns changes into messages, ``Board`` keeps the newest message of every key for each
browser. Without event loop or clock. Positions sent to the page are metres relative to the first
field's tile origin, so that they are small enough for the browser's float32.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rfcore.camera import TileOrigin, Vec3
from rfcore.field import RadianceField, SplatField
from rfcore.field.spz import encode_spz
from rfcore.perception.objects import CameraKey, StreetObject
from rfcore.vertical import first_sight
from rfcore.wire.twin import NewestQueue, TwinPicture

CONNECTION, FIELDS, TILES = ("connection",), ("fields",), ("tiles",)


@dataclass(frozen=True)
class Message:
    """A JSON object for the page with the binary ``parts`` it names; made at ``made_s``.

    ``parts`` travel one after the other; the header's ``part_bytes`` says how long each is.
    """

    header: Mapping[str, Any]
    made_s: float
    parts: tuple[bytes, ...] = ()

    def encode(self, now_s: float) -> bytes:
        """Return it as one WebSocket message: length of the header (uint32, little-endian), header,
        parts. ``held_ms`` tells how long it waited here (``now_s``: the clock of ``made_s``)."""
        header = {
            **self.header,
            "held_ms": 1000.0 * max(0.0, now_s - self.made_s),
            "part_bytes": [len(part) for part in self.parts],
        }
        text = json.dumps(header, allow_nan=False).encode()
        return b"".join((struct.pack("<I", len(text)), text, *self.parts))


Reader = NewestQueue[Hashable, Message]
"""The messages that one browser has not been sent."""


class Board:
    """The newest message of every key, and the browsers that read them.

    A message replaces the one before it under the same key: a camera's picture, the list of fields,
    the state of the connection.
    """

    def __init__(self) -> None:
        self._messages: dict[Hashable, Message] = {}
        self._readers: list[Reader] = []

    def post(self, key: Hashable, message: Message) -> None:
        """Show ``message`` to all readers, also to those that come later."""
        self._messages[key] = message
        for reader in self._readers:
            reader.put(key, message)

    def clear(self, key: Hashable, farewell: Message) -> None:
        """Remove the message of ``key``; present readers get ``farewell`` instead."""
        if self._messages.pop(key, None) is not None:
            for reader in self._readers:
                reader.put(key, farewell)

    def read(self, arrived: Callable[[], None]) -> Reader:
        """Return a new reader with everything that is shown now; ``arrived`` is called for more."""
        reader = Reader(arrived)
        for key, message in self._messages.items():
            reader.put(key, message)
        self._readers.append(reader)
        return reader

    def leave(self, reader: Reader) -> None:
        """Remove a reader."""
        self._readers.remove(reader)


@dataclass(frozen=True)
class PlacedField:
    """A field that the page draws; ``spz`` is empty for a kind that has no splats."""

    field: RadianceField
    tile: str
    spz: bytes

    @staticmethod
    def of(field: RadianceField, tile: str) -> PlacedField:
        """Return ``field`` with its splats as the page reads them; takes seconds."""
        if not isinstance(field, SplatField):
            return PlacedField(field, tile, b"")
        antialiased = field.metadata.antialiased
        return PlacedField(field, tile, encode_spz(field.gaussians, antialiased=antialiased))


@dataclass(frozen=True)
class DrivePicture(TwinPicture):
    """A camera's own picture from a drive on disk, which nobody has sent; ``file``: its name."""

    file: str = ""


class TwinScene:
    """Fields and cameras; posts each change to the ``board``. Not thread-safe."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._fields: dict[str, PlacedField] = {}
        self._notes: dict[str, str] = {}
        self._newest: dict[CameraKey, TwinPicture] = {}
        self._origin: TileOrigin | None = None
        self._tiles: Mapping[str, Any] = {}
        self.up: Vec3 | None = None
        """Up, where it is not to be taken from the fields."""

    @property
    def newest(self) -> Mapping[CameraKey, TwinPicture]:
        """The newest picture of every camera."""
        return self._newest

    @property
    def field_ids(self) -> tuple[str, ...]:
        """The fields that are placed."""
        return tuple(self._fields)

    def field(self, field_id: str) -> PlacedField | None:
        """Return a field that was placed, if it was."""
        return self._fields.get(field_id)

    def connection(self, state: str, detail: str, now_s: float) -> None:
        """Show whether pictures can arrive: ``state`` is connected, waiting or offline."""
        header = {"kind": "connection", "state": state, "detail": detail}
        self._board.post(CONNECTION, Message(header, now_s))

    def place(self, placed: PlacedField, now_s: float) -> None:
        """Add a field, or replace the one of its tile that was placed before."""
        stale = [i for i, p in self._fields.items() if p.tile == placed.tile]
        for field_id in stale:
            del self._fields[field_id]
        self._fields[placed.field.field_id] = placed
        self._notes.pop(placed.tile, None)
        self._origin = self._origin or placed.field.metadata.tile_origin
        self._post_fields(now_s)

    def keep(self, tiles: Collection[str], now_s: float) -> None:
        """Take away the fields and notes of all tiles but these."""
        gone = [i for i, placed in self._fields.items() if placed.tile not in tiles]
        noted = self._notes.keys() - set(tiles)
        for field_id in gone:
            del self._fields[field_id]
        for tile in noted:
            del self._notes[tile]
        if gone or noted:
            self._post_fields(now_s)

    def note(self, tile: str, text: str, now_s: float) -> None:
        """Show, beside the fields, the state of one that is not there yet."""
        self._notes[tile] = text
        self._post_fields(now_s)

    def show(self, picture: TwinPicture, now_s: float) -> None:
        """Show a camera's picture, a JPEG."""
        self._newest[picture.key] = picture
        header = {
            "kind": "picture",
            **_name(picture.key),
            "sequence": picture.sequence,
            "capture_time_ms": picture.capture_time_ns / 1e6,
            "age_ms": picture.age_ns / 1e6,
            "decoding_ms": picture.decoding_ns / 1e6,
            "field": picture.field_id,
            "origin_m": self._offset_m(picture.field_id),
            "translation_m": picture.pose and picture.pose.translation_m,
            "rotation_wxyz": picture.pose and picture.pose.rotation,
            "intrinsics": asdict(picture.intrinsics),
            "payload_bytes": picture.payload_bytes,
            "references": [reference.name.lower() for reference in picture.references],
            "skipped": picture.skipped,
            "clock": picture.clock,
            "localisation": picture.localisation,
            "truth": isinstance(picture, DrivePicture),
            "instant": picture.instant,
        }
        self._board.post(("picture", picture.key), Message(header, now_s, (picture.picture,)))

    def leave(self, key: CameraKey, now_s: float) -> None:
        """Remove a camera."""
        self._newest.pop(key, None)
        for kind in ("picture", "comparison"):
            farewell = Message({"kind": "departure", **_name(key)}, now_s)
            self._board.clear((kind, key), farewell)

    def compare(
        self,
        picture: TwinPicture,
        comparison: Mapping[str, Any],
        parts: tuple[bytes, ...],
        now_s: float,
    ) -> None:
        """Show how ``picture`` differs from its field's render; see ``rfedge.twin.comparing``."""
        header = {
            "kind": "comparison",
            **_name(picture.key),
            "sequence": picture.sequence,
            "name": picture.file if isinstance(picture, DrivePicture) else "",
            "origin_m": self._offset_m(picture.field_id),
            **comparison,
        }
        key = ("comparison", picture.key)
        self._board.post(key, Message(header, now_s, (picture.picture, *parts)))

    def show_tiles(self, rows: Sequence[Mapping[str, Any]], now_s: float) -> None:
        """Show these rows as the table of tiles and their lights; nothing if they are shown."""
        header = {"kind": "tiles", "rows": list(rows)}
        if header != self._tiles:
            self._tiles = header
            self._board.post(TILES, Message(header, now_s))

    def show_objects(
        self, field_id: str, objects: Sequence[StreetObject], now_s: float, problem: str = ""
    ) -> None:
        """Show objects on a field's ground that the field lacks, in place of the previous ones;
        ``problem``: why none are known."""
        header = {
            "kind": "objects",
            "field": field_id,
            "origin_m": self._offset_m(field_id),
            "objects": [_object(each) for each in objects],
            "problem": problem,
        }
        self._board.post(("objects", field_id), Message(header, now_s))

    def hide_objects(self, field_id: str, now_s: float) -> None:
        """Take the objects of a field away."""
        header = {"kind": "objects", "field": field_id, "objects": [], "problem": ""}
        self._board.clear(("objects", field_id), Message(header, now_s))

    def _post_fields(self, now_s: float) -> None:
        shown = [self._described(placed) for placed in self._fields.values()]
        notes = [{"tile": tile, "text": text} for tile, text in self._notes.items()]
        header = {"kind": "fields", "fields": shown, "notes": notes}
        self._board.post(FIELDS, Message(header, now_s))

    def _described(self, placed: PlacedField) -> dict[str, Any]:
        field, sights = placed.field, placed.field.metadata.sights
        start = first_sight(sights)
        return {
            "field": field.field_id,
            "tile": placed.tile,
            "name": field.metadata.name,
            "kind": field.metadata.kind,
            "primitives": field.primitives,
            "held_out_psnr_db": field.metadata.held_out_psnr_db,
            "spz_bytes": len(placed.spz),
            "origin_m": self._offset_m(field.field_id),
            "low_m": field.bounds.low_m,
            "high_m": field.bounds.high_m,
            "up": self.up or field.metadata.vertical,
            "start": start and asdict(start),
            "apart_m": max(
                (math.dist(sight.eye_m, sights[0].eye_m) for sight in sights), default=0
            ),
        }

    def _offset_m(self, field_id: str) -> tuple[float, float, float]:
        """Return where a field's tile lies from the first one's; 0 while that is not known."""
        placed, base = self._fields.get(field_id), self._origin
        if placed is None or base is None:
            return (0.0, 0.0, 0.0)
        own = placed.field.metadata.tile_origin
        return (own.east_m - base.east_m, own.north_m - base.north_m, own.up_m - base.up_m)


def _name(key: CameraKey) -> dict[str, str]:
    return {"vehicle": key[0], "camera": key[1]}


def _object(each: StreetObject) -> dict[str, Any]:
    return {
        "id": each.object_id,
        "at_m": each.at_m,
        "velocity_mps": each.velocity_mps,
        "width_m": each.width_m,
        "height_m": each.height_m,
        "confidence": each.confidence,
        "age_ms": 1e3 * each.age_s,
        "unseen_ms": 1e3 * each.unseen_s,
        "seen_by": ["/".join(camera) for camera in each.seen_by],
        "doubtful": each.is_doubtful,
    }
