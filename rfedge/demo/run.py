"""Run the demo: its field, its processes, its measurements, and the files it leaves."""

from __future__ import annotations

import json
import math
import os
import shlex
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from rfcore.camera import Camera
from rfcore.codec.h264.config import CoderSettings, check_effort
from rfcore.dataset import Dataset, read_dataset, verify_manifest
from rfcore.dataset.recorded_session import read_recorded_part, recordings_under
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.field import RadianceField, load_field, render_field_view
from rfcore.image import Rgb, read_rgb
from rfcore.native.yuv import rgb_from_i420
from rfedge.demo import Demo
from rfedge.demo.field import choose_field
from rfedge.demo.measure import (
    DriveFigures,
    DriveOutcome,
    FrameAddress,
    Pictures,
    measure_drive,
)
from rfedge.processes import command_of, run_to_end, service
from rfedge.results import make_result, provenance, write_result
from rfedge.training.run import training_config
from rfedge.video import write_mp4

DRIVES = ("empty", "vehicles")
VEHICLE = "demo"
CAMERA = "front"
RECORDED = "recorded"
"""Folder of the pictures that the server reconstructed of a drive, as a dataset."""
DRIVE_TIMEOUT_S = 300.0


@dataclass(frozen=True)
class DemoRun:
    """A finished demo: the content of ``result.json`` and the pictures of each drive."""

    result: Mapping[str, Any]
    pictures: Mapping[str, Sequence[Pictures]]
    field: Path

    def twin_command(self, out: Path) -> str:
        """Return the command that shows the field and the last drive's pictures in a browser."""
        recorded = out / "work" / DRIVES[-1] / RECORDED
        program = "rfedge" if shutil.which("rfedge") else os.path.relpath(command_of("rfedge")[0])
        return shlex.join((program, "twin", str(self.field), "--drive", str(recorded)))

    def require_complete(self) -> None:
        """Raise ``RfedgeError`` unless every frame was reconstructed with a matching digest."""
        for name, entry in self.result["sequences"].items():
            for key in ("frames_reconstructed", "digest_matches"):
                if entry[key] != entry["frames"]:
                    raise RfedgeError(
                        f"drive {name}: {key} is {entry[key]} of {entry['frames']} frames"
                    )


def run_demo(settings: Demo, console: Console) -> DemoRun:
    """Run the processes, measure, and write ``result.json`` and ``reconstructed.mp4``.

    Raises ``InvalidInput`` for a setting, ``RfedgeError`` naming the process or file that failed.
    Nothing is written to ``settings.out`` before the sample has been verified.
    """
    if not settings.link_bps > 0:
        raise InvalidInput("link-bps", f"{settings.link_bps:g} must be above 0 bit/s")
    if not settings.rate_hz > 0:
        raise InvalidInput("rate-hz", f"{settings.rate_hz:g} must be above 0 Hz")
    check_effort("effort", settings.effort)
    console.print(f"[bold]Sample[/] {settings.sample}: verifying")
    verify_manifest(settings.sample)
    _refuse_foreign_folder(settings.out)
    training = training_config(settings.gaussians, settings.iterations, settings.threads)
    field_path = choose_field(
        settings.sample, settings.cache, training, console, anew=settings.train
    )
    shutil.rmtree(settings.out, ignore_errors=True)
    field = load_field(field_path, threads=settings.threads)
    elsewhere = _elsewhere(settings.sample, field)
    sequences: dict[str, DriveFigures] = {}
    pictures: dict[str, list[Pictures]] = {}
    for drive in DRIVES:
        console.print(f"[bold]Drive[/] {drive}: server, link and vehicle as processes")
        outcome = _drive_outcome(settings, drive, field_path, field, elsewhere)
        sequences[drive] = measure_drive(outcome)
        pictures[drive] = list(outcome.pictures)
    content = {
        "format": "rfedge-demo-1",
        "settings": settings,
        "field": {
            "id": field.field_id,
            "kind": field.metadata.kind,
            "gaussians": field.primitives,
            "held_out_psnr_db": field.metadata.held_out_psnr_db,
        },
        "sequences": sequences,
    }
    result = make_result("demo", provenance(), content)
    # Camera on the left, the server's reconstruction on the right.
    pairs = (np.hstack([p.camera, p.reconstruction]) for drive in pictures.values() for p in drive)
    write_mp4(settings.out / "reconstructed.mp4", pairs, settings.rate_hz)
    write_result(settings.out / "result.json", result)
    return DemoRun(result, pictures, field_path)


def _refuse_foreign_folder(folder: Path) -> None:
    """Raise ``InvalidInput`` for a folder whose content no demo made: it would be deleted."""
    content = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    if content - {"work"} and "result.json" not in content:
        raise InvalidInput(
            "out", f"{folder} is not empty and holds no result.json; name another folder"
        )


def _drive_outcome(
    settings: Demo, drive: str, field_path: Path, field: RadianceField, elsewhere: Rgb
) -> DriveOutcome:
    work = settings.out / "work" / drive
    work.mkdir(parents=True)
    drive_path = settings.sample / f"transforms_drive_{drive}.json"
    _run_processes(settings, drive_path, field_path, field.field_id, work)
    lines = (work / "agent.jsonl").read_text().splitlines()
    agent_rows = [json.loads(line) for line in lines]
    parts = [read_recorded_part(file) for file in recordings_under(work / RECORDED)]
    recorded = {(r.epoch, r.sequence): (part, r) for part in parts for r in part.pictures}
    dataset = read_dataset(drive_path)
    if not recorded:
        raise RfedgeError(f"drive {drive}: the server reconstructed nothing, see {work}")
    return DriveOutcome(
        agent_rows=agent_rows,
        server_digests={address: row.digest for address, (_, row) in recorded.items()},
        link=json.loads((work / "link.json").read_text()),
        pictures=_pictures(
            dataset,
            field,
            agent_rows,
            {address: part.path(row) for address, (part, row) in recorded.items()},
        ),
        elsewhere=elsewhere,
        preset=settings.preset,
        crf=settings.crf,
        rate_hz=settings.rate_hz,
    )


def _run_processes(
    settings: Demo, drive_path: Path, field_path: Path, field_id: str, work: Path
) -> None:
    server_command = [
        *command_of("mec-server"),
        *("--fields", str(field_path.parent), "--record", str(work / RECORDED)),
        *("--listen", "127.0.0.1:0", "--threads", str(settings.threads)),
    ]
    with service("mec-server", server_command, work) as server:
        link_command = [
            *command_of("rfedge"),
            *("link", "--listen", "127.0.0.1:0", "--to", server.address),
            *("--uplink-bps", str(settings.link_bps), "--downlink-bps", str(settings.link_bps)),
            *("--delay-ms", str(settings.link_delay_ms), "--report", str(work / "link.json")),
        ]
        with service("link", link_command, work) as link:
            agent_command = [
                *command_of("cav-agent"),
                *("--server", link.address, "--drive", str(drive_path), "--camera", CAMERA),
                *("--fields", str(field_path.parent), "--field", field_id, "--vehicle", VEHICLE),
                *("--rate", str(settings.rate_hz), "--pace", "lockstep"),
                *("--crf", str(settings.crf), *CoderSettings.of(settings.effort).arguments),
                *("--threads", str(settings.threads), "--report", str(work / "agent.jsonl")),
                *("--give-up-s", "30", "--allow-recording"),
            ]
            run_to_end("cav-agent", agent_command, work, DRIVE_TIMEOUT_S)


def _address(row: Mapping[str, Any]) -> FrameAddress:
    return (row["epoch"], row["sequence"])


def _pictures(
    dataset: Dataset,
    field: RadianceField,
    agent_rows: list[dict[str, Any]],
    recorded: Mapping[FrameAddress, Path],
) -> list[Pictures]:
    """Pair each reconstructed frame with its camera picture and its render."""
    posed = {picture.name: picture for picture in dataset.pictures}
    return [
        Pictures(
            row["name"],
            posed[row["name"]].read(),
            _rendered(field, posed[row["name"]].camera),
            read_rgb(recorded[_address(row)]),
        )
        for row in agent_rows
        if _address(row) in recorded
    ]


def _rendered(field: RadianceField, camera: Camera) -> Rgb:
    """Return the render as the codec sees it: through YUV 4:2:0 and back."""
    return rgb_from_i420(render_field_view(field, camera).render)


def _elsewhere(sample: Path, field: RadianceField) -> Rgb:
    """Return a render of the field at the training view that is farthest from the drive."""
    train = read_dataset(sample / "transforms_train.json")
    drive = read_dataset(sample / f"transforms_drive_{DRIVES[0]}.json")
    start_m = drive.pictures[0].camera.world_from_cam.translation_m
    farthest = max(
        train.pictures,
        key=lambda view: math.dist(view.camera.world_from_cam.translation_m, start_m),
    )
    return _rendered(field, farthest.camera)
