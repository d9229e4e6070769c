"""The scene of the page: fields where they lie, cameras with their newest pictures.

Positions sent to the page are metres relative to the first field's tile origin, so that they are
small enough for the browser's float32.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rfcore.camera import Intrinsics, Pose, TileOrigin
from rfcore.field import RadianceField, SplatField
from rfcore.field.spz import encode_spz
from rfcore.localise.fix import State
from rfcore.perception.objects import StreetObject
from rfcore.wire.sensing import ClockKind
from rfedge.twin.board import Board, Message

__all__ = ["CameraKey", "PlacedField", "SeenPicture", "TwinScene"]

CameraKey = tuple[str, str]
"""(vehicle, camera)"""
CONNECTION, FIELDS, TILES = ("connection",), ("fields",), ("tiles",)


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
class SeenPicture:
    """A camera's picture as JPEG: ``pose`` is world_from_cam, relative to its field's tile;
    ``None``: the vehicle is lost.

    ``age_ms``: from capture until this process had it. ``payload_bytes``: 0 where not known.
    ``clock``: what a live camera's capture time rests on. ``localisation``: of a vehicle that finds
    its camera in the field; ``None``: the pose was given. ``truth``: ``jpeg`` is what the camera
    saw, not what a receiver made of it; ``name``: its file in the drive.
    ``instant``: of a rig, which pictures of its cameras were taken together; 0: the camera stands
    alone.
    """

    key: CameraKey
    sequence: int
    pose: Pose | None
    intrinsics: Intrinsics
    field_id: str
    jpeg: bytes
    age_ms: float
    capture_time_ns: int = 0
    payload_bytes: int = 0
    references: tuple[str, ...] = ()
    skipped: int = 0
    clock: ClockKind | None = None
    localisation: State | None = None
    truth: bool = False
    name: str = ""
    instant: int = 0


class TwinScene:
    """Fields and cameras, told to the ``board`` as they change. Used by one thread."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._fields: dict[str, PlacedField] = {}
        self._notes: dict[str, str] = {}
        self._newest: dict[CameraKey, SeenPicture] = {}
        self._origin: TileOrigin | None = None
        self._tiles: Mapping[str, Any] = {}

    @property
    def newest(self) -> Mapping[CameraKey, SeenPicture]:
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
        """Tell whether pictures can come: ``state`` is connected, waiting or offline."""
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

    def note(self, tile: str, text: str, now_s: float) -> None:
        """Say beside the fields what becomes of one that is not there."""
        self._notes[tile] = text
        self._post_fields(now_s)

    def show(self, picture: SeenPicture, now_s: float) -> None:
        """Take in a camera's picture."""
        self._newest[picture.key] = picture
        header = {
            "kind": "picture",
            **_name(picture.key),
            "sequence": picture.sequence,
            "capture_time_ms": picture.capture_time_ns / 1e6,
            "age_ms": picture.age_ms,
            "field": picture.field_id,
            "origin_m": self._offset_m(picture.field_id),
            "translation_m": picture.pose and picture.pose.translation_m,
            "rotation_wxyz": picture.pose and picture.pose.rotation,
            "intrinsics": _intrinsics(picture.intrinsics),
            "payload_bytes": picture.payload_bytes,
            "references": picture.references,
            "skipped": picture.skipped,
            "clock": picture.clock,
            "localisation": picture.localisation,
            "truth": picture.truth,
            "instant": picture.instant,
        }
        self._board.post(("picture", picture.key), Message(header, now_s, (picture.jpeg,)))

    def leave(self, key: CameraKey, now_s: float) -> None:
        """Remove a camera."""
        self._newest.pop(key, None)
        for kind in ("picture", "comparison"):
            farewell = Message({"kind": "departure", **_name(key)}, now_s)
            self._board.clear((kind, key), farewell)

    def compare(
        self,
        picture: SeenPicture,
        comparison: Mapping[str, Any],
        parts: tuple[bytes, ...],
        now_s: float,
    ) -> None:
        """Show how ``picture`` differs from its field's render; see ``rfedge.twin.comparing``."""
        header = {
            "kind": "comparison",
            **_name(picture.key),
            "sequence": picture.sequence,
            "name": picture.name,
            "origin_m": self._offset_m(picture.field_id),
            **comparison,
        }
        key = ("comparison", picture.key)
        self._board.post(key, Message(header, now_s, (picture.jpeg, *parts)))

    def show_tiles(self, rows: Sequence[Mapping[str, Any]], now_s: float) -> None:
        """Show these rows as the table of tiles and their lights; nothing if they are shown."""
        header = {"kind": "tiles", "rows": list(rows)}
        if header != self._tiles:
            self._tiles = header
            self._board.post(TILES, Message(header, now_s))

    def show_objects(
        self, field_id: str, objects: Sequence[StreetObject], now_s: float, problem: str = ""
    ) -> None:
        """Show what stands on a field's ground that the field does not have, in place of what was
        shown there; ``problem``: why nothing is known of it."""
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
        field = placed.field
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


def _intrinsics(k: Intrinsics) -> dict[str, float]:
    return {
        "width_px": k.width_px,
        "height_px": k.height_px,
        "fx_px": k.fx_px,
        "fy_px": k.fy_px,
        "cx_px": k.cx_px,
        "cy_px": k.cy_px,
    }
