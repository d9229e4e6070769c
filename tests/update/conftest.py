"""A wall of splats, passes of vehicles along it in the light of the field or in another, and what
a server has recorded of them."""

import os
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mec_server.tile_history import LEARNING, Learnt, TileHistory, write_histories
from mec_server.tile_learning import LearningJob, LearningRounds
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.dataset.recorded_session import RECORDING_NAME, RecordedCamera, RecordedPicture
from rfcore.field import SplatField, save_field
from rfcore.harmonics import SH_DC
from rfcore.image import Rgb, write_png
from rfcore.raster.gaussians import Gaussians
from rfcore.update.passes import Pass
from rfcore.update.run import LearnAs, Update, UpdateSettings, learn
from rfcore.views import PosedPicture
from rfcore.wire.tile_manifest import (
    Ground,
    TileVersions,
    VersionLabel,
    publish,
    read_publication,
)
from tests.clouds import upright

K = Intrinsics(96, 64, 70.0, 70.0, 48.0, 32.0)
Paint = Callable[[int, Rgb], Rgb]
MakePass = Callable[..., Pass]


def wall() -> Gaussians:
    """900 flat splats at a depth of 4 m, textured."""
    x, y = np.meshgrid(np.linspace(-4, 4, 36), np.linspace(-2.5, 2.5, 25))
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, 4.0)], axis=1)
    colours = 0.5 + 0.3 * np.random.default_rng(0).uniform(-1, 1, (x.size, 3))
    size_m = np.float32([0.13, 0.13, 0.02])
    return upright(means, (colours - 0.5) / SH_DC, size_m, 3.0).gaussians


def darkened(gaussians: Gaussians) -> Gaussians:
    """A third of the light, bluer, and darker to one side: no matrix of colours says it."""
    shade = 1.0 / (1.0 + np.exp(-2 * gaussians.means[:, 0]))
    colours = gaussians.sh[:, 0] * SH_DC + 0.5
    tint = np.array([0.25, 0.3, 0.5]) * (0.4 + shade)[:, None]
    return replace(gaussians, sh=((colours * tint - 0.5) / SH_DC).astype(np.float32)[:, None])


@pytest.fixture(scope="session")
def noon() -> SplatField:
    return SplatField(wall())


@pytest.fixture(scope="session")
def dusk() -> SplatField:
    return SplatField(darkened(wall()))


@pytest.fixture(scope="session")
def make_pass() -> MakePass:
    """Return a maker of passes of 12 frames along a field, 0.1 m apart."""

    def make(
        field: SplatField, identity: str = "cav-1", shift_m: float = 0.0, paint: Paint | None = None
    ) -> Pass:
        pictures = []
        for number in range(12):
            pose = Pose((0.1 * number - 0.6 + shift_m, 0.0, 0.0), (1.0, 0, 0, 0))
            camera = Camera(K, pose.rounded())
            rgb = np.rint(np.clip(field.render_colour(camera), 0, 1) * 255).astype(np.uint8)
            rgb = rgb if paint is None else paint(number, rgb)
            pictures.append(PosedPicture(f"{number}.png", camera, lambda rgb=rgb: rgb))
        return Pass(identity, tuple(pictures))

    return make


def pasted(number: int, _: Rgb) -> Rgb:
    """A picture of another place."""
    rng = np.random.default_rng(number)
    return np.kron(rng.integers(0, 255, (8, 12, 3)), np.ones((8, 8, 1))).astype(np.uint8)


def sometimes(number: int, rgb: Rgb) -> Rgb:
    """Two frames of a pass show another place."""
    return pasted(100 + number, rgb) if number in (3, 7) else rgb


NOW_MS = 1_767_290_400_000
"""18:00 UTC."""
NOW = datetime.fromtimestamp(NOW_MS / 1e3, UTC)


class Street:
    """A folder of fields with tile west at noon, and a folder of recordings."""

    def __init__(self, folder: Path, noon: SplatField) -> None:
        self.fields, self.recordings = folder / "fields", folder / "recordings"
        self.fields.mkdir()
        self.recordings.mkdir()
        self.noon_id = save_field(noon, folder / "noon.rff")
        publish(self.fields, "west", folder / "noon.rff", Ground(), NOW)
        self.job = LearningJob(self.fields, self.recordings, frames=16)
        self.parts = 0

    def record(self, drive: Pass, field_id: str = "", times: int = 1) -> None:
        """Record a pass, its pictures so many times over, that ended a minute ago."""
        self.parts += 1
        part = self.recordings / drive.identity / "front" / f"{NOW_MS - 60_000 + self.parts}-s"
        part.mkdir(parents=True)
        camera = drive.pictures[0].camera
        lines = [RecordedCamera(drive.identity, "front", "s", camera.intrinsics).line()]
        for number, picture in enumerate(drive.pictures * times):
            name, pose = f"{number:06}.png", picture.camera.world_from_cam
            write_png(part / name, picture.read())
            time_ns = (NOW_MS - 60_000 + 100 * number) * 1_000_000
            line = RecordedPicture(name, time_ns, 0, number, field_id or self.noon_id, pose, "00")
            lines.append(line.line())
        (part / RECORDING_NAME).write_text("".join(lines))
        os.utime(part / RECORDING_NAME, (NOW_MS / 1e3 - 60, NOW_MS / 1e3 - 60))

    def publish_harm(self, field: SplatField) -> str:
        """Publish a field as a light that the process has learnt; return its id."""
        path = self.fields.parent / "bad.rff"
        bad_id = save_field(field, path)
        (self.recordings / LEARNING).mkdir(exist_ok=True)
        learnt = Learnt(bad_id, "h17", self.noon_id, 2, 20.0, NOW_MS)
        write_histories(self.recordings, {"west": TileHistory((learnt,))})
        publish(self.fields, "west", path, Ground(), NOW, VersionLabel("h17", "", 2, 17.0))
        return bad_id

    def rounds(self, **changes: Any) -> LearningRounds:
        return LearningRounds(replace(self.job, **changes), lambda: NOW_MS)

    def west(self) -> TileVersions:
        return read_publication(self.fields).tiles["west"]


@pytest.fixture
def street(tmp_path: Path, noon: SplatField) -> Street:
    return Street(tmp_path, noon)


@pytest.fixture
def at_dusk(street: Street, dusk: SplatField, make_pass: MakePass) -> Street:
    """Two vehicles were recorded at dusk."""
    street.record(make_pass(dusk, "a"))
    street.record(make_pass(dusk, "b", 0.15))
    return street


@pytest.fixture(scope="session")
def update(noon: SplatField, dusk: SplatField, make_pass: MakePass) -> Update:
    """The update that the passes of ``at_dusk`` teach; learnt once."""
    settings = UpdateSettings(LearnAs.COLOURS, frames=16)
    made = learn(noon, [make_pass(dusk, "a"), make_pass(dusk, "b", 0.15)], settings)
    assert not made.refused
    return made


@pytest.fixture
def learnt_before(update: Update, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the worker take what was learnt once: what it does around learning is tested."""
    monkeypatch.setattr("mec_server.tile_learning.learn_from", lambda *_: update)
