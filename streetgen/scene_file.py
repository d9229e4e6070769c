"""Read scene files: the street, where cameras drive, which pictures are taken, which effects run.

``streetgen/scenes/NAME.toml`` holds the ready-made ones. A scene runs exactly the effects that it
names in ``[effects.<name>]`` (``streetgen.effects``). A scene with several ``[[passes]]`` describes
as many drives through one street. Each has its own ``lane_offset_m``, and its own effects beside
those of the scene; ``NAME:2`` is the second of them, ``NAME`` the first.

Each table of the file becomes a frozen dataclass (``read_record``). A field's type is ``bool``,
``int``, ``float``, ``str`` or a tuple of numbers; ``Annotated`` metadata holds its ``Range`` or
``OneOf``. Every error names the file, the line and the key; a key that no field has is an error.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, replace
from dataclasses import field as with_factory
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

from rfcore.dataset.rig import mounts_named
from rfcore.errors import InvalidInput
from rfcore.tables import Range, Table
from streetgen.effects import EFFECTS, EffectKind, load_effect
from streetgen.geometry.layout import Geometry

T = TypeVar("T")
HEADER = re.compile(r"\s*\[+\s*([\w.\-\"]+)\s*\]+")
KEY = re.compile(r"\s*([\w\-\"]+)\s*=")
INDEX = re.compile(r"\[\d+\]$")


@dataclass(frozen=True)
class OneOf:
    """Permits only these strings."""

    choices: tuple[str, ...]


class TomlFile:
    """A parsed TOML file that knows on which line each key stands; ``top`` is its own table."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            text = path.read_text(encoding="utf-8")
            content = tomllib.loads(text)
        except OSError as error:
            raise InvalidInput("scene", f"{path}: cannot be read ({error.strerror})") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InvalidInput("scene", f"{path}: {error}") from error
        self._lines = _lines_of_keys(text)
        self.top = Table(content, self.error)

    def error(self, key: str, problem: str) -> InvalidInput:
        """Return an error at a dotted key, or at the table it would stand in."""
        place = INDEX.sub("", key)
        while place and place not in self._lines:
            place = place.rpartition(".")[0]
        line = self._lines.get(place, 1)
        return InvalidInput("scene", f"{self.path}: line {line}: {key}: {problem}")


def read_record(table: Table, kind: type[T]) -> T:
    """Return a table as the dataclass ``kind``; raise the table's error for a wrong value."""
    hints = get_type_hints(kind, include_extras=True)
    kinds = fields(kind)  # type: ignore[arg-type]
    table.require_known(sorted(field.name for field in kinds))
    values = {}
    for field in kinds:
        optional = field.default is not MISSING or field.default_factory is not MISSING
        if field.name in table or not optional:
            values[field.name] = _value(table, field.name, hints[field.name])
    try:
        return kind(**values)
    except InvalidInput as error:
        raise table.error(error.field, error.problem) from error


def _value(table: Table, key: str, hint: Any) -> Any:
    kind, *rules = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    within = next((rule for rule in rules if isinstance(rule, Range)), Range())
    if get_origin(kind) is tuple:
        return _tuple(table, key, get_args(kind), within)
    if kind is bool:
        return table.flag(key)
    if kind is str:
        choices = [rule.choices for rule in rules if isinstance(rule, OneOf)]
        return table.choice(key, choices[0]) if choices else table.text(key)
    return table.whole(key, within) if kind is int else table.number(key, within)


def _tuple(table: Table, key: str, kinds: tuple[Any, ...], within: Range) -> tuple[float, ...]:
    """Return a list of numbers: ``(float, ...)`` has any length, ``(int, int)`` exactly two."""
    items = table.items(key, None if Ellipsis in kinds else len(kinds))
    check = table.checked_whole if kinds[0] is int else table.checked
    numbers = (check(f"{key}[{i}]", item, within) for i, item in enumerate(items))
    return tuple(kinds[0](number) for number in numbers)


def _lines_of_keys(text: str) -> dict[str, int]:
    """Return the lines where tables and keys begin; a multi-line string may add some."""
    found: dict[str, int] = {}
    table = ""
    for number, line in enumerate(text.splitlines(), start=1):
        if header := HEADER.match(line):
            table = header[1].replace('"', "")
            found.setdefault(table, number)
        elif key := KEY.match(line):
            found.setdefault(".".join(filter(None, (table, key[1].replace('"', "")))), number)
    return found


SCENES = Path(__file__).parent / "scenes"
PASS_MARK = ":"
LANE_OFFSET_M = Range(-5, 5)
Size = Annotated[tuple[int, int], Range(16, 8192)]


@dataclass(frozen=True)
class RigSettings:
    """The cameras of the car that takes the training and evaluation views."""

    cameras: Annotated[int, Range(1, 18)] = 18
    fov_deg: Annotated[float, Range(20, 150)] = 90.0
    directions: Annotated[str, OneOf(("both", "there"))] = "both"


@dataclass(frozen=True)
class TrainingSettings:
    """The views that a field is trained on."""

    views: Annotated[int, Range(1, 100_000)] = 120
    size_px: Size = (640, 360)


@dataclass(frozen=True)
class EvaluationSettings:
    """Evaluation views by the whole rig at ``stations``, none of them a training pose."""

    stations: Annotated[int, Range(1, 1000)] = 8
    size_px: Size = (640, 360)


@dataclass(frozen=True)
class DriveSettings:
    """A camera that moves, rendered at ``rate_hz`` and thinned out to the lower rates."""

    duration_s: Annotated[float, Range(0.1, 600)] = 2.4
    speed_mps: Annotated[float, Range(0, 60)] = 9.0
    rate_hz: Annotated[float, Range(1, 120)] = 30.0
    thinned_hz: Annotated[tuple[float, ...], Range(0.1, 120)] = (10.0, 2.0)
    lane_offset_m: Annotated[float, LANE_OFFSET_M] = 0.0
    size_px: Size = (640, 360)
    rig: str = "mid_front,mid_left,mid_right,mid_back"
    """The car's cameras that take the split ``rig`` (``rfcore.dataset.rig``), or all."""

    @property
    def frames(self) -> int:
        """Number of frames at the full rate."""
        return max(round(self.duration_s * self.rate_hz), 1)

    def __post_init__(self) -> None:
        for rate_hz in self.thinned_hz:
            if abs(self.rate_hz / rate_hz - round(self.rate_hz / rate_hz)) > 1e-9:
                raise InvalidInput(
                    "thinned_hz", f"{rate_hz:g} does not divide rate_hz = {self.rate_hz:g}"
                )
        mounts_named(self.rig)


@dataclass(frozen=True)
class LocalisationNoise:
    """Standard deviations of the measured pose, which is written beside the true one."""

    position_m: Annotated[float, Range(0, 5)] = 0.0
    rotation_deg: Annotated[float, Range(0, 10)] = 0.0
    seed: Annotated[int, Range(0, 2**31)] = 1


@dataclass(frozen=True)
class Scene:
    """A scene file, checked. ``field`` names the scene whose training views its field saw.

    ``effects`` holds the settings of each declared effect by its name, in the order they run.
    ``passes`` is how many drives the file declares, of which this is one, or 0.
    """

    name: str
    field: str
    geometry: Geometry = with_factory(default_factory=Geometry)
    rig: RigSettings = RigSettings()
    train: TrainingSettings = TrainingSettings()
    evaluation: EvaluationSettings = EvaluationSettings()
    drive: DriveSettings = DriveSettings()
    pose_noise: LocalisationNoise = LocalisationNoise()
    effects: Mapping[str, Any] = with_factory(default_factory=dict)
    passes: int = 0


PARTS = {
    "geometry": Geometry,
    "rig": RigSettings,
    "train": TrainingSettings,
    "evaluation": EvaluationSettings,
    "drive": DriveSettings,
    "pose_noise": LocalisationNoise,
}


def load_scene(name_or_path: str) -> Scene:
    """Read a ready-made scene by its name or any scene file by its path, or one pass of either.

    Raises ``InvalidInput`` naming the file, the line and the key. Only the modules of the effects
    that the scene declares are imported.
    """
    base, _, number = name_or_path.partition(PASS_MARK)
    file = TomlFile(_path(base))
    top = file.top
    top.require_known(sorted({"name", "field", "effects", "passes", *PARTS}))
    passes = top.items("passes", default=[])
    chosen = _chosen_pass(file, passes, number)
    parts: dict[str, Any] = {
        key: read_record(top.table(key, {}), kind) for key, kind in PARTS.items()
    }
    if "lane_offset_m" in chosen:
        offset_m = chosen.number("lane_offset_m", LANE_OFFSET_M)
        parts["drive"] = replace(parts["drive"], lane_offset_m=offset_m)
    return Scene(
        name=top.text("name") + (f"{PASS_MARK}{number}" if number else ""),
        field=top.text("field"),
        effects=_effects(top.table("effects", {}), chosen.table("effects", {})),
        passes=len(passes),
        **parts,
    )


def _chosen_pass(file: TomlFile, passes: list[Any], number: str) -> Table:
    """Return the table of the pass ``number``, the first where none is named."""
    if number and not (re.fullmatch("[1-9][0-9]{0,3}", number) and int(number) <= len(passes)):
        raise file.error("passes", f"'{number}' is none of {len(passes)} passes")
    index = int(number or 1) - 1
    chosen = Table(passes[index] if passes else {}, file.error, f"passes[{index}]")
    chosen.require_known(("effects", "lane_offset_m"))
    return chosen


def _effects(scene: Table, own: Table) -> dict[str, Any]:
    """Return the settings of the scene's effects and of a pass's own, which replace them."""
    names = sorted(effect.name for effect in EFFECTS)
    scene.require_known(names)
    own.require_known(names)
    order = [effect for effect in EFFECTS if effect.name in scene or effect.name in own]
    lights = [effect.name for effect in order if effect.kind is EffectKind.LIGHT]
    if len(lights) > 1:
        table = own if lights[1] in own else scene
        raise table.error(lights[1], f"is a second light beside {lights[0]}")
    tables = ((e, (own if e.name in own else scene).table(e.name)) for e in order)
    return {effect.name: read_record(table, load_effect(effect)) for effect, table in tables}


def _path(name_or_path: str) -> Path:
    path = Path(name_or_path)
    if path.suffix == ".toml":
        return path
    ready_made = SCENES / f"{name_or_path}.toml"
    if not ready_made.is_file():
        known = ", ".join(sorted(p.stem for p in SCENES.glob("*.toml"))) or f"none in {SCENES}"
        raise InvalidInput("scene", f"'{name_or_path}' is no ready-made scene ({known})")
    return ready_made
