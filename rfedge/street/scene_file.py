"""A scene: what the street is, where cameras drive, which pictures are wanted, which effects run.

``samples/scenes/NAME.toml`` holds the ready-made ones. A scene runs exactly the effects it names in
``[effects.<name>]``; what they are is ``rfedge.street.effects``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import field as with_factory
from pathlib import Path
from typing import Annotated, Any

from rfcore.errors import InvalidInput
from rfcore.tables import Range
from rfedge.street.effects import EFFECTS, EffectKind, load_effect
from rfedge.street.schema import OneOf, TomlFile, read_record

__all__ = ["Drive", "Evaluation", "Geometry", "PoseNoise", "Rig", "Scene", "Training", "load_scene"]

SCENES = Path("samples/scenes")
Size = Annotated[tuple[int, int], Range(16, 8192)]


@dataclass(frozen=True)
class Geometry:
    """The street. ``tiles`` of ``length_m`` each follow one another."""

    length_m: Annotated[float, Range(20, 1000)] = 120.0
    tiles: Annotated[int, Range(1, 20)] = 1
    seed: Annotated[int, Range(0, 2**31)] = 1
    trees: bool = True
    signs: bool = True
    wires: bool = True


@dataclass(frozen=True)
class Rig:
    """The cameras of the car that takes the training and evaluation views."""

    cameras: Annotated[int, Range(1, 18)] = 18
    fov_deg: Annotated[float, Range(20, 150)] = 90.0
    directions: Annotated[str, OneOf(("both", "there"))] = "both"


@dataclass(frozen=True)
class Training:
    """Views a field is trained on."""

    views: Annotated[int, Range(1, 100_000)] = 120
    size_px: Size = (640, 360)


@dataclass(frozen=True)
class Evaluation:
    """``stations`` of the whole rig, none of them a training pose."""

    stations: Annotated[int, Range(1, 1000)] = 8
    size_px: Size = (640, 360)


@dataclass(frozen=True)
class Drive:
    """A camera that moves, rendered at ``rate_hz`` and thinned out to the lower rates."""

    duration_s: Annotated[float, Range(0.1, 600)] = 2.4
    speed_mps: Annotated[float, Range(0, 60)] = 9.0
    rate_hz: Annotated[float, Range(1, 120)] = 30.0
    thinned_hz: Annotated[tuple[float, ...], Range(0.1, 120)] = (10.0, 2.0)
    lane_offset_m: Annotated[float, Range(-5, 5)] = 0.0
    size_px: Size = (640, 360)

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


@dataclass(frozen=True)
class PoseNoise:
    """The measured pose, written beside the true one, differs by normal deviates."""

    position_m: Annotated[float, Range(0, 5)] = 0.0
    rotation_deg: Annotated[float, Range(0, 10)] = 0.0
    seed: Annotated[int, Range(0, 2**31)] = 1


@dataclass(frozen=True)
class Scene:
    """A scene file, checked. ``field`` names the scene whose training views its field saw.

    ``effects`` holds the settings of each declared effect by its name, in the order they run.
    """

    name: str
    field: str
    geometry: Geometry = Geometry()
    rig: Rig = Rig()
    train: Training = Training()
    evaluation: Evaluation = Evaluation()
    drive: Drive = Drive()
    pose_noise: PoseNoise = PoseNoise()
    effects: Mapping[str, Any] = with_factory(default_factory=dict)


PARTS = {
    "geometry": Geometry,
    "rig": Rig,
    "train": Training,
    "evaluation": Evaluation,
    "drive": Drive,
    "pose_noise": PoseNoise,
}


def load_scene(name_or_path: str) -> Scene:
    """Read a ready-made scene by its name or any scene file by its path.

    Raises ``InvalidInput`` naming the file, the line and the key. Only the modules of the effects
    that the scene declares are imported.
    """
    file = TomlFile(_path(name_or_path))
    top = file.top
    top.require_known(sorted({"name", "field", "effects", *PARTS}))
    declared = top.table("effects", {})
    declared.require_known(sorted(effect.name for effect in EFFECTS))
    order = [effect for effect in EFFECTS if effect.name in declared]
    lights = [effect.name for effect in order if effect.kind is EffectKind.LIGHT]
    if len(lights) > 1:
        raise declared.error(lights[1], f"is a second light beside {lights[0]}")
    return Scene(
        name=top.text("name"),
        field=top.text("field"),
        effects={e.name: read_record(declared.table(e.name), load_effect(e)) for e in order},
        **{key: read_record(top.table(key, {}), kind) for key, kind in PARTS.items()},
    )


def _path(name_or_path: str) -> Path:
    path = Path(name_or_path)
    if path.suffix == ".toml":
        return path
    ready_made = SCENES / f"{name_or_path}.toml"
    if not ready_made.is_file():
        known = ", ".join(sorted(p.stem for p in SCENES.glob("*.toml"))) or f"none in {SCENES}"
        raise InvalidInput("scene", f"'{name_or_path}' is no ready-made scene ({known})")
    return ready_made
