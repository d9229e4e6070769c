"""Rows of objects of ``rfedge-lab world``: what is found of vehicles, and what where none are.

Pictures are looked at as a server has them: at poses as they travel, coded against the field at the
default quality and decoded again, noise included.

Every confirmed object counts with its distance from the outline of the nearest vehicle, however far
that is. A vehicle is found by one object, and one object finds one vehicle: of all pairs nearer
than ``MATCH_M`` the nearest first. An object further than that from every vehicle is none.

*The empty minute* is as many drives through the empty street as take a minute together, each the
same pictures with sensor noise of a seed of its own; ``EvalWorld.long_empty`` gives a longer drive,
so that more of them are different. What the field itself shows wrongly is in all of them: a thing
found wherever the field errs counts once a drive, not once.

*Dusk* is the same street and the same drives under the generator's evening sky, followed in the
light that a colour layer on the field learnt from another vehicle's pass through the empty street,
``TEACHER_LEFT_M`` beside the drives. The generator renders it (``streetgen.build``), which
prints its cost before, keeps each finished picture and goes on where it was interrupted.
"""

from __future__ import annotations

import hashlib
import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as with_factory
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from lab.servers.cases import WorldRow
from lab.world import EvalWorld
from lab.world.truth import Drive, SceneTruth, VisibleVehicle
from rfcore.camera import Camera
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.sender.encoder import DeltaEncoder
from rfcore.dataset import read_dataset
from rfcore.errors import RfedgeError
from rfcore.field import RadianceField, load_field, save_field
from rfcore.image import Rgb
from rfcore.native.yuv import field_view_from_view, i420_from_rgb, rgb_from_i420
from rfcore.perception.composition import live_picture
from rfcore.perception.contacts import detect
from rfcore.perception.ground import FieldGround
from rfcore.perception.objects import FollowedObject, ObjectTracker
from rfcore.update.passes import Pass
from rfcore.update.run import LearnAs, UpdateSettings, learn
from rfcore.views import View
from rfedge.offline import FrameInput, decode_promised, encode_frames
from streetgen.build.run import Settings, build_scene
from streetgen.effects.dusk import Dusk
from streetgen.scene_file import Scene, load_scene
from streetgen.shots import Selection

LEAST_PX, REACH_M, MATCH_M = 400, 30.0, 2.0
"""Least size and greatest distance of a vehicle that must be found; distance from its outline
beyond which an object is a false one."""
CAMERA = ("eval", "front")
NOISE_SIGMA, NOISE_SEED = 3.0, 3
SAME_TIME_S = 1e-6
MINUTE_S = 60.0
TEACHER_LEFT_M, TEACHER_HZ = 0.5, 5.0


@dataclass(frozen=True, eq=False)
class AnnotatedPicture:
    """A picture of a drive, when it was taken, what the field shows there, and what vehicles are in
    it, by the truth."""

    camera: Camera
    time_s: float
    rgb: Rgb
    view: View
    vehicles: tuple[VisibleVehicle, ...]


@dataclass(frozen=True, eq=False)
class AnnotatedDrive:
    """A drive against a field, and that field's ground."""

    pictures: tuple[AnnotatedPicture, ...]
    ground: FieldGround

    @staticmethod
    def of(drive: Drive, field: RadianceField, truth: SceneTruth | None) -> AnnotatedDrive:
        """Read and render everything. ``truth`` None: no vehicles are there."""
        pictures = []
        for index, picture in enumerate(drive.pictures):
            time_s = drive.time_s(index)
            vehicles = () if truth is None else tuple(truth.vehicles(picture.camera, time_s))
            camera = picture.camera.rounded()
            view = field.render(camera)
            pictures.append(AnnotatedPicture(camera, time_s, picture.read(), view, vehicles))
        return AnnotatedDrive(tuple(pictures), FieldGround(field.render, field.metadata.vertical))

    @property
    def seconds(self) -> float:
        """Duration, with the last picture as long as the others."""
        count = len(self.pictures)
        return self.pictures[-1].time_s * count / max(1, count - 1)


@dataclass
class FoundVehicles:
    """Comparison of objects with the vehicles in a drive's pictures.

    ``errors_m``: errors of every object in every picture with a vehicle; ``false``: the objects
    that were further than ``MATCH_M`` from every vehicle in some picture.
    """

    to_find: int = 0
    found: int = 0
    errors_m: list[float] = with_factory(default_factory=list)
    false: set[int] = with_factory(default_factory=set)

    def take(self, picture: AnnotatedPicture, objects: Sequence[FollowedObject]) -> None:
        """Compare the confirmed objects after a picture."""
        places = [vehicle.footprint for vehicle in picture.vehicles]
        for each in objects:
            if picture.time_s - each.last_s > SAME_TIME_S:
                continue
            distances_m = [place.distance_m(each.at(picture.time_s)) for place in places]
            self.errors_m += [min(distances_m)] if distances_m else []
            if not distances_m or min(distances_m) > MATCH_M:
                self.false.add(each.object_id)
        found = _found_by(picture, objects)
        for vehicle in picture.vehicles:
            if vehicle.pixels >= LEAST_PX and vehicle.nearest_m <= REACH_M:
                self.to_find += 1
                self.found += vehicle.number in found


def _found_by(picture: AnnotatedPicture, objects: Sequence[FollowedObject]) -> dict[int, int]:
    """Return which vehicle is found by which object, one by one, the nearest first."""
    pairs = sorted(
        (distance_m, vehicle.number, each.object_id)
        for vehicle in picture.vehicles
        for each in objects
        if (distance_m := vehicle.footprint.distance_m(each.at(picture.time_s))) <= MATCH_M
    )
    found: dict[int, int] = {}
    for _, number, object_id in pairs:
        if number not in found and object_id not in found.values():
            found[number] = object_id
    return found


def object_rows(asked: EvalWorld, field: RadianceField) -> list[WorldRow]:
    """Return the rows of vehicles found, with and without noise, and of false objects."""
    vehicles, empty = Drive.given(asked.vehicles), Drive.given(asked.empty)
    with_vehicles = AnnotatedDrive.of(vehicles, field, SceneTruth(vehicles.scene))
    nothing = AnnotatedDrive.of(empty, field, None)
    rows = []
    for name, sigma in (("", 0.0), (f", noise {NOISE_SIGMA:g}", NOISE_SIGMA)):
        found = followed(with_vehicles, sigma)
        rows += _rows_of_found(f"vehicles{name}", found, with_vehicles.seconds)
        rows.append(_row_of_empty(f"false ones where nothing stands{name}", nothing, sigma))
    if asked.long_empty:
        nothing = AnnotatedDrive.of(Drive.given(asked.long_empty), field, None)
    return [*rows, empty_minute(nothing)]


def empty_minute(drive: AnnotatedDrive) -> WorldRow:
    """Return how many objects a minute of an empty street has."""
    drives = math.ceil(MINUTE_S / drive.seconds)
    false = sum(len(followed(drive, NOISE_SIGMA, seed).false) for seed in range(1, drives + 1))
    minutes = drives * drive.seconds / 60
    return WorldRow(
        "objects",
        f"false ones in the empty minute: {drives} times the drive of {drive.seconds:.1f} s "
        f"and {len(drive.pictures)} pictures, "
        f"noise {NOISE_SIGMA:g} of seeds 1 to {drives}",
        "<= 1 a minute",
        f"{false} in {60 * minutes:.0f} s",
        false <= minutes,
    )


def followed(drive: AnnotatedDrive, sigma: float, seed: int = NOISE_SEED) -> FoundVehicles:
    """Follow the objects of a drive with noise of ``sigma`` levels added; compare with the
    truth."""
    tracker, found = ObjectTracker(), FoundVehicles()
    rng = np.random.default_rng(seed)
    sent = [noisy(picture.rgb, sigma, rng) for picture in drive.pictures]
    for picture, rgb in zip(drive.pictures, received(drive.pictures, sent), strict=True):
        live = live_picture(picture.camera, rgb, picture.view)
        tracker.take(detect(live, drive.ground), CAMERA, picture.time_s, live.rules_out)
        found.take(picture, tracker.confirmed(picture.time_s))
    return found


def received(pictures: Sequence[AnnotatedPicture], sent: Sequence[Rgb]) -> Iterator[Rgb]:
    """Yield what a server decodes of the pictures ``sent`` from there by one camera."""
    k = pictures[0].camera.intrinsics
    encoder = DeltaEncoder(CodecConfig(k.width_px, k.height_px))
    inputs = (
        FrameInput(i420_from_rgb(rgb), field_view_from_view(picture.view, picture.camera))
        for picture, rgb in zip(pictures, sent, strict=True)
    )
    for _, frame in decode_promised(DeltaDecoder(encoder.header), encode_frames(encoder, inputs)):
        yield rgb_from_i420(frame)


def noisy(rgb: NDArray[np.uint8], sigma: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return a picture with sensor noise of ``sigma`` levels."""
    if not sigma:
        return rgb
    return np.clip(np.rint(rgb + rng.normal(scale=sigma, size=rgb.shape)), 0, 255).astype(np.uint8)


def _row_of_empty(case: str, drive: AnnotatedDrive, sigma: float) -> WorldRow:
    false = len(followed(drive, sigma).false)
    told = f"{false} in {drive.seconds:.1f} s"
    return WorldRow("objects", case, "<= 1 a minute", told, false <= drive.seconds / 60)


def _rows_of_found(name: str, found: FoundVehicles, seconds: float) -> list[WorldRow]:
    errors_m = np.array(found.errors_m or [np.nan])
    median_m, p95_m = (float(np.nanpercentile(errors_m, q)) for q in (50, 95))
    share = found.found / max(1, found.to_find)
    return [
        WorldRow(
            "objects",
            f"{name}, distance from the outline, median",
            "<= 0.5 m",
            f"{median_m:.2f} m",
            median_m <= 0.5,
        ),
        WorldRow(
            "objects",
            f"{name}, distance from the outline, p95",
            "<= 1.0 m",
            f"{p95_m:.2f} m",
            p95_m <= 1.0,
        ),
        WorldRow(
            "objects",
            f"{name}, found where >= {LEAST_PX} px are seen within {REACH_M:g} m",
            ">= 90 %",
            f"{100 * share:.0f} % of {found.to_find}",
            share >= 0.9,
        ),
        WorldRow(
            "objects",
            f"{name}, confirmed objects further than {MATCH_M:g} m from every vehicle",
            "<= 1 a minute",
            f"{len(found.false)} in {seconds:.1f} s",
            len(found.false) <= seconds / 60,
        ),
    ]


# --- dusk


@dataclass(frozen=True)
class DuskScenes:
    """The pass that teaches the light, and the drives that are followed in it."""

    teacher: Scene
    empty: Scene
    vehicles: Scene


def dusk_scenes(empty: str, vehicles: str) -> DuskScenes:
    """Return two scenes under the evening's sky, and the teacher's pass through the empty one.

    Raises ``InvalidInput`` for scene files that cannot be read.
    """
    nothing, with_vehicles = _at_dusk(load_scene(empty)), _at_dusk(load_scene(vehicles))
    drive = replace(
        nothing.drive,
        rate_hz=TEACHER_HZ,
        lane_offset_m=nothing.drive.lane_offset_m + TEACHER_LEFT_M,
        thinned_hz=(),
    )
    teacher = replace(nothing, name=f"{nothing.name}-teacher", drive=drive)
    return DuskScenes(teacher, nothing, with_vehicles)


def _at_dusk(scene: Scene) -> Scene:
    return replace(scene, name=f"{scene.name}-dusk", effects={**scene.effects, "dusk": Dusk()})


def dusk_rows(asked: EvalWorld, field: RadianceField) -> list[WorldRow]:
    """Return the rows of vehicles found at dusk, in the light that the field has learnt."""
    paths = [given.partition(",")[0] for given in (asked.empty, asked.vehicles)]
    scenes, console = dusk_scenes(paths[0], paths[1]), Console(soft_wrap=True)
    teacher = _rendered(scenes.teacher, asked.work, console)
    evening = _evening_field(asked.field, field, teacher, asked.work, console)
    empty = Drive(_rendered(scenes.empty, asked.work, console).pictures, paths[0])
    vehicles = Drive(_rendered(scenes.vehicles, asked.work, console).pictures, paths[1])
    with_vehicles = AnnotatedDrive.of(vehicles, evening, SceneTruth(paths[1]))
    rows = _rows_of_found("dusk, vehicles", followed(with_vehicles, 0.0), with_vehicles.seconds)
    nothing = AnnotatedDrive.of(empty, evening, None)
    return [*rows, _row_of_empty("dusk, false ones where nothing stands", nothing, 0.0)]


def _rendered(scene: Scene, work: Path, console: Console) -> Drive:
    """Return a scene's drive; what of it is rendered already is kept."""
    folder = work / scene.name
    build_scene(Selection(scene, "drive"), Settings(folder), console)
    return Drive(read_dataset(folder / "transforms_drive.json").pictures, scene.name)


def _evening_field(
    path: Path, field: RadianceField, teacher: Drive, work: Path, console: Console
) -> RadianceField:
    """Return the field of noon with the light of the teacher's pass; learnt once.

    Raises ``RfedgeError`` if that light does not pay.
    """
    taught = hashlib.sha256(field.field_id.encode())
    for picture in teacher.pictures:
        taught.update(repr(picture.camera).encode() + picture.read().tobytes())
    folder = work / f"evening-{taught.hexdigest()[:12]}"
    learnt = folder / "evening.rff"
    if not learnt.is_file():
        console.print(f"learning the light of {len(teacher.pictures)} frames: about 20 s of a core")
        settings = UpdateSettings(LearnAs.COLOURS, min_identities=1)
        update = learn(field, [Pass("teacher", tuple(teacher.pictures))], settings)
        if update.refused:
            raise RfedgeError(
                f"the light of {teacher.scene} is not worth learning: {update.refused}"
            )
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, folder / "noon.rff")
        save_field(update.learnt, learnt)
    return load_field(learnt)
