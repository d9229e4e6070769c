"""The evening demo: what the first vehicle of an evening sends teaches the field of the second.

Server, link and vehicles are processes, as in ``rfedge.demo.run``. Two drives along the same way:

* ``first``: once, at dusk, against the field of noon, with consent to be recorded. The server's
  learning process makes a colour layer of what it decoded, tries it on frames held back, and
  publishes it.
* ``second``: round and round at dusk, by another vehicle, which holds the field of noon, finds that
  it does not fit, fetches the published light while it drives, and codes its frames against it.

Figures are of one round of each, the drive's first frame apart, where there is nothing to predict
from: of the second vehicle, the first round that has the light throughout. Both see the same
frames, so that this is the least that another drive costs; how much is left in another lane is
measured by ``rfedge-lab adapt``. The server learns from a single vehicle here, where it asks for
two by itself.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from rich.console import Console

from rfcore.codec.h264.config import CoderSettings
from rfcore.dataset import read_dataset, verify_manifest
from rfcore.dataset.recorded_session import read_recorded_part, recordings_under
from rfcore.errors import RfedgeError
from rfcore.field import FieldStore, RadianceField, load_field
from rfcore.image import Rgb, read_rgb
from rfcore.metrics import psnr
from rfcore.views import PosedPicture
from rfcore.wire.publish import Ground, publish
from rfedge.demo.dusk import write_dusk
from rfedge.demo.field import FieldChoice, choose_field
from rfedge.demo.processes import Service, await_result, command_of, run_to_end, run_until, service
from rfedge.demo.run import (
    CAMERA,
    DRIVES,
    DemoSettings,
    empty_folder,
    json_lines,
    refuse_foreign_folder,
    rendered,
)
from rfedge.results import make_result, provenance, write_result

__all__ = ["EveningDrive", "EveningPictures", "EveningRun", "LearntLight", "run_evening"]

TILE = "street"
QUIET_S = 2.0
DRIVE_TIMEOUT_S = 300.0
LEARN_TIMEOUT_S = 900.0
RECORD_TIMEOUT_S = 30.0
LEARNING = ("--learn", "--learn-min-identities", "1", "--learn-quiet-s", f"{QUIET_S:g}")
RECORDED = "recorded"
SHOWN = 3
"""Frames of which the report has pictures, evenly over the drive."""
NOT_LEARNT = ("not learnt", "update not kept", "learning failed", "learning postponed")
"""What the learning process logs when it publishes nothing."""


@dataclass(frozen=True)
class EveningDrive:
    """One round of one vehicle: means over its frames, the first one apart."""

    name: str
    light: str | None
    """Whose field frames were coded against; None: the tile's own."""
    frames: int
    kbit_per_frame: float
    """Of whole packets."""
    psnr_db: float
    """Of the server's pictures against the camera's, RGB."""
    rf_psnr_db: float
    """Of the field's render alone."""
    rounds: float
    """Driven in all."""
    fetched_bytes: int
    """Fields and layers that the vehicle fetched on the way."""
    seconds: float
    """From the vehicle's start to its stop."""


@dataclass(frozen=True)
class LearntLight:
    """What the server published after the first vehicle's drive."""

    light: str
    field_id: str
    passes: int
    saved_percent: float
    """Bits on the frames held back."""
    size_bytes: int
    seconds: float
    """From the end of the first vehicle's drive until vehicles are told of it."""


@dataclass(frozen=True)
class EveningPictures:
    """What a frame looked like: camera, renders of noon's field and of the learnt one, uint8."""

    name: str
    camera: Rgb
    noon: Rgb
    learnt: Rgb


@dataclass(frozen=True)
class EveningRun:
    """The content of ``result.json``, and pictures of a few frames."""

    result: Mapping[str, Any]
    pictures: Sequence[EveningPictures]


def run_evening(settings: DemoSettings, dusk: Path | None, console: Console) -> EveningRun:
    """Run the two drives and write ``result.json``.

    ``dusk``: a drive through the sample's street in another light; None makes one of the sample's
    own (``rfedge.demo.dusk``). Raises ``RfedgeError`` naming the process or file that failed, or
    why nothing was learnt. Nothing is written before the sample has been verified.
    """
    verify_manifest(settings.sample)
    refuse_foreign_folder(settings.out)
    choice = FieldChoice(settings.sample, settings.cache, settings.training, settings.train_anew)
    field_path = choose_field(choice, console)
    empty_folder(settings.out)
    street = _Street(
        settings, settings.out / "work", load_field(field_path, threads=settings.threads)
    )
    publish(street.published, TILE, field_path, Ground(), datetime.now(UTC))
    noon = settings.sample / f"transforms_drive_{DRIVES[0]}.json"
    evening = dusk or write_dusk(noon, street.field, street.work / "dusk")
    with street.server() as server:
        first = street.drive(server, "first", evening, console)
        console.print("[bold]Server[/] learns from what it decoded")
        light = street.learnt(server)
        second = street.drive(server, "second", evening, console, light)
    result = _result(settings, dusk, street.field, light, (first, second))
    write_result(settings.out / "result.json", result)
    shown = _shown(read_dataset(evening, tile_origin=street.field.metadata.tile_origin).pictures)
    learnt = street.opened(light.field_id)
    return EveningRun(result, [_pictures(picture, street.field, learnt) for picture in shown])


@dataclass(frozen=True)
class _Street:
    """The tile that is published, and the folders of what runs on it."""

    settings: DemoSettings
    work: Path
    field: RadianceField

    @property
    def published(self) -> Path:
        """The server's folder of fields."""
        folder = self.work / "published"
        folder.mkdir(exist_ok=True)
        return folder

    def opened(self, field_id: str) -> RadianceField:
        """Return a published field."""
        return FieldStore(self.published).load(field_id, threads=self.settings.threads)

    @contextmanager
    def server(self) -> Iterator[Service]:
        """Run a server that records and learns; its log is of JSON lines."""
        command = [
            *command_of("mec-server"),
            *("--fields", str(self.published), "--record", str(self.work / RECORDED)),
            *("--listen", "127.0.0.1:0", "--threads", str(self.settings.threads)),
            *("--log", "json", *LEARNING),
        ]
        with service("mec-server", command, self.work) as server:
            yield server

    def drive(
        self,
        server: Service,
        name: str,
        dataset: Path,
        console: Console,
        light: LearntLight | None = None,
    ) -> EveningDrive:
        """Let a vehicle drive once, or until it has had ``light`` for a round."""
        console.print(f"[bold]Vehicle[/] {name}: {dataset}")
        vehicle = _Vehicle(self, name, dataset, light)
        with vehicle.link(server) as link:
            seconds = vehicle.drive(link.address)
        return vehicle.figures(server, seconds)

    def learnt(self, server: Service) -> LearntLight:
        """Wait until the server has published a light and tells vehicles of it."""
        began_s = monotonic()

        def published() -> Mapping[str, Any] | None:
            for event in _events(server.log_path):
                if event["event"] == "update published":
                    return event
                if event["event"] in NOT_LEARNT:
                    raise RfedgeError(
                        f"the server published nothing: {event['event']}, "
                        f"{event.get('reason') or event.get('problem')}; see {server.log_path}"
                    )
            return None

        def taken_up() -> bool | None:
            tiles = [event.get("tiles", []) for event in _events(server.log_path)]
            return True if any(event["light"] in named for named in map(str, tiles)) else None

        event = await_result(server, published, LEARN_TIMEOUT_S)
        await_result(server, taken_up, DRIVE_TIMEOUT_S)
        archive = self.published / f"{event['field']}.rff"
        return LearntLight(
            event["light"],
            event["field"],
            event["passes"],
            event["saved_percent"],
            archive.stat().st_size,
            monotonic() - began_s,
        )


@dataclass(frozen=True)
class _Vehicle:
    """One vehicle of the evening: its drive, its folder of fields and its report."""

    street: _Street
    name: str
    dataset: Path
    light: LearntLight | None

    @property
    def folder(self) -> Path:
        """Where its files lie."""
        return self.street.work / f"vehicle-{self.name}"

    @contextmanager
    def link(self, server: Service) -> Iterator[Service]:
        """Run the link between it and a server."""
        self.folder.mkdir()
        settings = self.street.settings
        bps = str(settings.link_bps)
        command = [
            *command_of("rfedge"),
            *("link", "--listen", "127.0.0.1:0", "--to", server.address),
            *("--uplink-bps", bps, "--downlink-bps", bps),
            *("--delay-ms", str(settings.link_delay_ms)),
        ]
        with service("link", command, self.folder) as link:
            yield link

    def drive(self, address: str) -> float:
        """Drive, with a light to wait for round and round; return the seconds it took."""
        settings, field = self.street.settings, self.street.field
        fields = self.folder / "fields"
        fields.mkdir()
        own = f"{field.field_id}.rff"
        shutil.copyfile(self.street.published / own, fields / own)
        command = [
            *command_of("cav-agent"),
            *("--server", address, "--drive", str(self.dataset), "--camera", CAMERA),
            *("--fields", str(fields), "--vehicle", self.name, "--pace", "lockstep"),
            *("--crf", str(settings.crf), *CoderSettings.of(settings.effort).arguments),
            *("--threads", str(settings.threads), "--report", str(self._report)),
            *("--give-up-s", "30", "--allow-recording"),
        ]
        began_s = monotonic()
        if self.light is None:
            run_to_end("cav-agent", command, self.folder, DRIVE_TIMEOUT_S)
        else:
            command.append("--loop")
            run_until("cav-agent", command, self.folder, self._is_done, DRIVE_TIMEOUT_S)
        return monotonic() - began_s

    def figures(self, server: Service, seconds: float) -> EveningDrive:
        """Return the figures of the round, once the server has written what it saw of it."""
        start = self._frames[0].name
        counted = [row for row in self._counted_round() if row["name"] != start]
        pictures = await_result(server, lambda: self._pictures_of(counted), RECORD_TIMEOUT_S)
        posed = {picture.name: picture for picture in self._frames}
        own = self.street.field
        field = own if self.light is None else self.street.opened(self.light.field_id)
        db, field_db = [], []
        for row, path in zip(counted, pictures, strict=True):
            picture = posed[row["name"]]
            camera = picture.read()
            db.append(psnr(read_rgb(path), camera))
            field_db.append(psnr(rendered(field, picture.camera), camera))
        archives = (self.folder / "fields").glob("*.rff")
        fetched = [path for path in archives if path.stem != own.field_id]
        return EveningDrive(
            name=self.name,
            light=None if self.light is None else self.light.light,
            frames=len(counted),
            kbit_per_frame=8e-3 * float(np.mean([row["packet_bytes"] for row in counted])),
            psnr_db=float(np.mean(db)),
            rf_psnr_db=float(np.mean(field_db)),
            rounds=len(self._acked()) / len(self._frames),
            fetched_bytes=sum(path.stat().st_size for path in fetched),
            seconds=seconds,
        )

    @property
    def _report(self) -> Path:
        return self.folder / "agent.jsonl"

    @cached_property
    def _frames(self) -> Sequence[PosedPicture]:
        origin = self.street.field.metadata.tile_origin
        return read_dataset(self.dataset, tile_origin=origin).pictures

    def _acked(self) -> list[dict[str, Any]]:
        return [row for row in json_lines(self._report) if row["result"] == "acked"]

    def _is_done(self) -> bool:
        return self._report.exists() and bool(self._counted_round())

    def _counted_round(self) -> list[dict[str, Any]]:
        """Return the round that counts: the only one, or with a light the first one that has it
        throughout, or none yet."""
        acked, frames = self._acked(), len(self._frames)
        if self.light is None:
            return acked
        for end in range(frames, len(acked) + 1):
            lit = [row["light_field"] == self.light.field_id for row in acked[end - frames : end]]
            if all(lit):
                return acked[end - frames : end]
        return []

    def _pictures_of(self, rows: Sequence[Mapping[str, Any]]) -> list[Path] | None:
        """Return the server's pictures of frames; None while one is not written."""
        parts = map(read_recorded_part, recordings_under(self.street.work / RECORDED))
        written = {
            (picture.epoch, picture.sequence): part.path(picture)
            for part in parts
            for picture in part.pictures
            if part.camera.vehicle_id == self.name
        }
        found = [written.get((row["epoch"], row["sequence"])) for row in rows]
        there = [path for path in found if path is not None]
        return there if len(there) == len(rows) else None


def _events(log_path: Path) -> list[dict[str, Any]]:
    """Return a log's whole lines in JSON; what other programs write into it is left out."""
    *whole, _ = log_path.read_text(errors="replace").split("\n")
    return [json.loads(line) for line in whole if line.startswith('{"')]


def _shown(pictures: Sequence[PosedPicture]) -> list[PosedPicture]:
    places = np.linspace(0, len(pictures) - 1, min(SHOWN, len(pictures))).round().astype(int)
    return [pictures[place] for place in places]


def _pictures(picture: PosedPicture, noon: RadianceField, learnt: RadianceField) -> EveningPictures:
    camera = picture.camera
    return EveningPictures(
        picture.name, picture.read(), rendered(noon, camera), rendered(learnt, camera)
    )


def _result(
    settings: DemoSettings,
    dusk: Path | None,
    field: RadianceField,
    light: LearntLight,
    drives: Sequence[EveningDrive],
) -> dict[str, Any]:
    content = {
        "format": "rfedge-demo-evening-1",
        "settings": settings,
        "dusk": None if dusk is None else str(dusk),
        "field": {"id": field.field_id, "gaussians": field.primitives},
        "light": light,
        "drives": drives,
    }
    return make_result("demo-evening", provenance(), content)
