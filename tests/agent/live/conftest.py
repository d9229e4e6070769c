"""A camera on the network made of the sample's drive, its ``camera.toml`` and its poses."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from rfcore.dataset import read_dataset
from rfcore.image import jpeg_bytes
from rfcore.views import PosedPicture

SENDER = Path("deploy/live/gst_sender.py")
DRIVE = Path("samples/street/transforms_drive_vehicles.json")
CAMERA = """[camera]
width_px = 640
height_px = 360
fx_px = 320.0

[trajectory]
file = "trajectory.txt"
max_gap_s = 10.0
"""


@dataclass
class Sender:
    """A running sender; ``kill`` ends it, ``start`` begins another on the same port."""

    kind: str
    pictures: str
    port: int
    process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Start, and wait until it is ready."""
        command = ["/usr/bin/python3", str(SENDER), self.kind, self.pictures, str(self.port)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        assert self.process.stdout.readline().strip() == str(self.port), "the sender did not start"

    def kill(self) -> None:
        """End it as a power failure would."""
        if self.process is not None:
            self.process.send_signal(signal.SIGKILL)
            self.process.wait(10)
            if self.process.stdout is not None:
                self.process.stdout.close()


def write_trajectory(folder: Path, pictures: list[PosedPicture], times_s: list[float]) -> None:
    """Write ``camera.toml`` and the poses of pictures at times."""
    (folder / "camera.toml").write_text(CAMERA)
    lines = []
    for picture, time_s in zip(pictures, times_s, strict=True):
        pose = picture.camera.world_from_cam
        w, x, y, z = pose.rotation
        lines.append(" ".join(map(str, (f"{time_s:.6f}", *pose.translation_m, x, y, z, w))))
    (folder / "trajectory.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture
def live_camera(tmp_path: Path) -> Path:
    """Return a folder with pictures and a ``camera.toml``: the drive's middle pose for an hour."""
    pictures = list(read_dataset(DRIVE).pictures)
    for i, picture in enumerate(pictures):
        (tmp_path / f"{i:03d}.jpg").write_bytes(jpeg_bytes(picture.read()))
    now_s = time.time()
    middle = pictures[len(pictures) // 2]
    write_trajectory(tmp_path, [middle, middle], [now_s - 3600, now_s + 3600])
    toml = (tmp_path / "camera.toml").read_text().replace("10.0", "10000.0")
    (tmp_path / "camera.toml").write_text(toml)
    return tmp_path


@pytest.fixture
def sender(live_camera: Path, free_port: int) -> Iterator[Callable[[str], Sender]]:
    """Return what starts a sender, ``rtsp`` or ``rtp``, of the pictures."""
    probe = "import gi; gi.require_version('GstRtspServer', '1.0')"
    if subprocess.run(["/usr/bin/python3", "-c", probe], check=False).returncode:
        pytest.fail("GStreamer is missing: run `make test-system-packages` (root, Debian)")
    running: list[Sender] = []

    def start(kind: str) -> Sender:
        made = Sender(kind, f"{live_camera}/%03d.jpg", free_port)
        running.append(made)
        made.start()
        return made

    yield start
    for made in running:
        made.kill()
