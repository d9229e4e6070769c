"""The history of learning of each tile, kept beside the recordings.

RECORDINGS/.learning/tiles.json holds a ``TileHistory`` by the tile's name: lights learnt, tried and
withdrawn. The learning process writes it (``mec_server.tile_learning``); the server reads it for
its metrics.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rfcore.errors import InvalidInput
from rfcore.files import write_whole
from rfcore.wire.tiles import LearntLight

LEARNING = ".learning"
HISTORIES = "tiles.json"


@dataclass(frozen=True)
class Learnt:
    """One learnt field; written before it is published, so that none goes unchecked.

    ``replaced_id``: the field that vehicles used before, and use again if it is withdrawn.
    ``identities``: the number of vehicles whose passes were used.
    """

    field_id: str
    light: str
    replaced_id: str
    passes: int
    saved_percent: float
    time_ms: int
    withdrawn: bool = False
    identities: int = 0


@dataclass(frozen=True)
class TileHistory:
    """The history of one tile.

    ``tried``: recordings that were used, as paths below the folder; ``checked``: for each recording
    and learnt field, the number of frames that were checked for a withdrawal.
    """

    learnt: tuple[Learnt, ...] = ()
    tried: tuple[str, ...] = ()
    checked: Mapping[str, int] = field(default_factory=dict)
    cpu: tuple[tuple[int, float], ...] = ()
    """CPU time spent on learning in the last hour: when, and how many seconds."""

    def newest(self, tile: str) -> Iterator[LearntLight]:
        """Yield the last result of each light of ``tile``, whose history this is."""
        for one in {one.light: one for one in self.learnt}.values():
            saved_ratio = one.saved_percent / 100
            yield LearntLight(
                tile, one.light, one.field_id, one.passes, one.time_ms, saved_ratio, one.withdrawn
            )

    @property
    def withdrawals(self) -> int:
        """The number of updates that were withdrawn because they increased bits."""
        return sum(one.withdrawn for one in self.learnt)


def read_histories(recordings: Path) -> dict[str, TileHistory]:
    """Return the histories, by tile; raise ``InvalidInput`` for a damaged file."""
    path = recordings / LEARNING / HISTORIES
    if not path.exists():
        return {}
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        return {name: _history(one) for name, one in stored.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InvalidInput("learning", f"{path} is damaged ({error}); remove it") from error


def _history(stored: Mapping[str, Any]) -> TileHistory:
    return TileHistory(
        learnt=tuple(Learnt(**one) for one in stored["learnt"]),
        tried=tuple(stored["tried"]),
        checked=dict(stored["checked"]),
        cpu=tuple((int(at_ms), float(spent_s)) for at_ms, spent_s in stored["cpu"]),
    )


def write_histories(recordings: Path, histories: Mapping[str, TileHistory]) -> None:
    """Write the histories, by tile, atomically."""
    stored = {name: asdict(one) for name, one in histories.items()}
    write_whole(recordings / LEARNING / HISTORIES, json.dumps(stored))
