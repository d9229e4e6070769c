"""Write the files that describe a built dataset: transforms, points, manifest, and its origin.

``transforms_SPLIT.json`` lists the finished shots of a split, ``transforms_drive_RATEhz.json``
those that a lower rate keeps. ``..._measured.json`` lists the same pictures with measured poses,
where the scene declares localisation noise. For the split ``rig`` each camera has a dataset
``transforms_rig_CAMERA.json`` of the finished instants, and ``rig.toml`` describes the cameras
(``rfcore.dataset.rig``). ``transforms.json`` is a copy of the training split's file, or of the
first split's where there is no training split. ``build.json`` identifies the build, so that it
continues only in its own folder.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import streetgen
from rfcore.camera import Pose
from rfcore.dataset import write_manifest
from rfcore.dataset.rig import RIG_FILE, Rig, RigCamera, mounts_named, write_rig
from rfcore.dataset.source import SourceCamera, SourcePoints, read_points
from rfcore.dataset.write import POINTS_NAME, WrittenPicture, transforms_of, write_points
from rfcore.errors import InvalidInput
from rfcore.files import write_whole
from rfcore.lens import LensCamera
from streetgen.build.scene_renderer import RenderJob, ShotFiles, camera_of_pictures
from streetgen.scene_file import Scene
from streetgen.shots import Shot, Split, shots_of, thinned_indices
from streetgen.trajectory import measured_pose, mounted

TIMED = (Split.DRIVE, Split.RIG)
"""Splits whose pictures were taken one after the other."""


def list_dataset(job: RenderJob, about: dict[str, Any]) -> dict[str, int]:
    """Write transforms, points and manifest of what is finished; return how many of each split."""
    finished = {split: _finished(job, split) for split in Split}
    finished = {split: shots for split, shots in finished.items() if shots}
    if not finished:
        return {}
    first = Split.TRAIN if Split.TRAIN in finished else next(iter(finished))
    write_points(job.folder / POINTS_NAME, _points(job.folder, finished[first]))
    for split, shots in finished.items():
        if split is Split.RIG:
            _list_rig(job, shots)
        else:
            _list_split(job, split, shots)
        if split is first:
            _write(job.folder / "transforms.json", _written(job, shots, measured=False))
    write_manifest(job.folder, about)
    return {str(split): len(shots) for split, shots in finished.items()}


def _finished(job: RenderJob, split: Split) -> list[Shot]:
    shots = shots_of(job.scene, split, job.size_px)
    return [shot for shot in shots if ShotFiles.of(job.folder, shot).done]


def _list_split(job: RenderJob, split: Split, shots: Sequence[Shot]) -> None:
    kept = {"": shots}
    if split is Split.DRIVE:
        for rate_hz in job.scene.drive.thinned_hz:
            indices = thinned_indices(job.scene, rate_hz)
            kept[f"_{rate_hz:g}hz"] = [shot for shot in shots if shot.index in indices]
    noise = job.scene.pose_noise
    noisy = noise.position_m > 0 or noise.rotation_deg > 0
    for suffix, chosen in kept.items():
        stem = job.folder / f"transforms_{split}{suffix}"
        if chosen:
            _write(stem.with_suffix(".json"), _written(job, chosen, measured=False))
        if chosen and noisy:
            measured = stem.with_name(f"{stem.name}_measured.json")
            _write(measured, _written(job, chosen, measured=True))


def _list_rig(job: RenderJob, shots: Sequence[Shot]) -> None:
    mounts = mounts_named(job.scene.drive.rig)
    instants = Counter(shot.index // len(mounts) for shot in shots)
    cameras = []
    for number, mount in enumerate(mounts):
        mine = [shot for shot in shots if shot.index % len(mounts) == number]
        whole = [shot for shot in mine if instants[shot.index // len(mounts)] == len(mounts)]
        file = job.folder / f"transforms_{Split.RIG}_{mount.name}.json"
        if whole:
            _write(file, _written(job, whole, measured=False))
        rig_from_cam = mounted(mount, np.zeros(3), 0.0)
        cameras.append(RigCamera(mount.name, rig_from_cam.inverse(), file))
    write_rig(job.folder / RIG_FILE, Rig(tuple(cameras)))


def _written(job: RenderJob, shots: Sequence[Shot], measured: bool) -> list[WrittenPicture]:
    seen_by = camera_of_pictures(job.scene, shots[0].camera)
    lens = seen_by.lens if isinstance(seen_by, LensCamera) else None
    camera = SourceCamera(seen_by.intrinsics, lens)
    return [
        WrittenPicture(
            file_path=ShotFiles.of(job.folder, shot).picture_name,
            camera=camera,
            world_from_cam=_pose(job, shot, measured),
            time_ns=round(shot.time_s * 1e9) if shot.split in TIMED else None,
        )
        for shot in shots
    ]


def _pose(job: RenderJob, shot: Shot, measured: bool) -> Pose:
    true = shot.camera.world_from_cam
    return measured_pose(true, job.scene.pose_noise, shot.number) if measured else true


def _write(file: Path, pictures: list[WrittenPicture]) -> None:
    write_whole(file, json.dumps(transforms_of(pictures, POINTS_NAME), indent=1) + "\n")


def _points(folder: Path, shots: Sequence[Shot]) -> SourcePoints:
    each = [read_points(ShotFiles.of(folder, shot).points) for shot in shots]
    return SourcePoints(
        np.concatenate([points.xyz_m for points in each]),
        np.concatenate([points.rgb for points in each]),
    )


ORIGIN_NAME = "build.json"
STREET = Path(streetgen.__file__).parent


def origin_of(job: RenderJob) -> dict[str, Any]:
    """Return scene, settings, versions and the digest of the generator's own code.

    The code of effects that the scene does not declare is no part of it.
    """
    return {
        "scene": asdict(job.scene),
        "size_px": job.size_px,
        "samples": job.sampling.samples,
        "seed": job.sampling.seed,
        "renderer": job.backend.variant,
        "versions": {name: version(name) for name in ("rfedge", "mitsuba", "pyoidn")},
        "generator_sha256": _code_digest(job.scene),
    }


def claim_folder(job: RenderJob) -> None:
    """Make the dataset's folder, or check that it holds the same build.

    Raises ``InvalidInput`` for a folder of another build, or of something else.
    """
    origin = json.loads(json.dumps(origin_of(job)))
    file = job.folder / ORIGIN_NAME
    if not job.folder.exists() or not any(job.folder.iterdir()):
        job.folder.mkdir(parents=True, exist_ok=True)
        write_whole(file, json.dumps(origin, indent=1) + "\n")
        return
    try:
        found = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise InvalidInput("out", f"{job.folder} holds no build of a scene") from error
    differing = [key for key in origin if found.get(key) != origin[key]]
    if differing:
        raise InvalidInput(
            "out",
            f"{job.folder} holds another build (differs in {', '.join(differing)}); remove it or "
            "name another folder",
        )


def _code_digest(scene: Scene) -> str:
    digest = hashlib.sha256()
    for path in sorted(STREET.rglob("*.py")):
        if path.parent.name == "effects" and path.stem not in {"__init__", *scene.effects}:
            continue
        digest.update(path.relative_to(STREET).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()
