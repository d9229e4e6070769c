"""The commands of the tutorials do what their pages say, in their order, as a reader types them.

Shell blocks marked ``sh`` run in one bash, in an empty folder; what the page tells the reader to
bring is made here, small. Blocks marked ``bash`` install something or are of another day.
"""

import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from docs.pages import ROOT, Page
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.dataset import read_dataset
from rfcore.field import load_field
from rfcore.image import write_png
from rfedge.cli import parse

SAVED, LIVE = Page("tutorials/pictures-to-saved-bits.md"), Page("tutorials/vehicle-server-twin.md")
FIELD = ROOT / "samples" / "fields" / "street.rff"
DRIVE = ROOT / "samples" / "street" / "transforms_drive_vehicles.json"
WAIT = "until (exec 3<>/dev/tcp/127.0.0.1/{0}) 2>/dev/null; do sleep 0.1; done"
"""Bash waits until a port accepts."""


def run(script: str, folder: Path, changes: Mapping[str, str], timeout_s: float) -> str:
    """Run a page's commands with job control; return what they print. All of them end with it."""
    for given, here in changes.items():
        assert given in script, f"the page no longer says {given!r}"
        script = script.replace(given, here)
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    process = subprocess.Popen(
        ["bash", "-euo", "pipefail", "-c", f"set -m\n{script}"],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        said, _ = process.communicate(timeout=timeout_s)
    finally:
        for pid in session_members(process.pid):
            os.kill(pid, signal.SIGKILL)
    assert process.returncode == 0, said + logs(folder)
    return said


def session_members(session: int) -> list[int]:
    """Return the processes of a session: job control puts each job into a group of its own."""
    stats = [path.read_text() for path in Path("/proc").glob("[0-9]*/stat") if path.exists()]
    fields = [(stat.split(" ", 1)[0], stat.rpartition(") ")[2].split()) for stat in stats]
    return [int(pid) for pid, rest in fields if int(rest[3]) == session]


def logs(folder: Path) -> str:
    return "\n".join(f"== {log.name}\n{log.read_text()}" for log in folder.glob("*.log"))


def make_pictures(folder: Path, count: int) -> None:
    """Walk through the sample's field, the camera turned to the side: what a phone would film."""
    folder.mkdir()
    field = load_field(FIELD)
    intrinsics = Intrinsics(480, 270, 288.0, 288.0, 240.0, 135.0)
    for index in range(count):
        part = index / (count - 1)
        at_m = (-14 + 14 * part, -1.8, 1.6 + 0.3 * math.sin(3 * part))
        camera = Camera(intrinsics, looking(at_m, math.radians(20 + 50 * part)))
        colour = np.clip(field.render_colour(camera), 0, 1)
        write_png(folder / f"{index:03d}.png", np.round(colour * 255).astype(np.uint8))


def looking(at_m: tuple[float, float, float], heading: float) -> Pose:
    """Return the pose of a level camera that looks along a heading (0: along x; z is up)."""
    cos, sin = math.cos(heading), math.sin(heading)
    right, down, forward = (sin, -cos, 0.0), (0.0, 0.0, -1.0), (cos, sin, 0.0)
    return Pose.from_matrix(
        [[*axes, at] for *axes, at in zip(right, down, forward, at_m, strict=True)]
    )


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.sample
def test_pictures_become_a_field_and_saved_bits(tmp_path):
    make_pictures(tmp_path / "pictures", 16)
    script = "\n".join(SAVED.blocks("sh"))
    said = run(script, tmp_path, {"--minutes 2": "--minutes 0.3"}, 600)
    assert re.search(r"^posed: 16 pictures placed", said, re.MULTILINE)
    assert len(read_dataset(tmp_path / "map").pictures) == 8
    assert len(list((tmp_path / "decoded").glob("*.png"))) == 8
    rows = json.loads((tmp_path / "out/eval/compare.json").read_text())["rows"]
    bits = {
        (row["method"].split("-default")[0], row["rival"]): row["bd_rate_percent"] for row in rows
    }
    assert bits["rfedge", "x264-our-tools-veryfast"] < -30, "a field of the very street saves bits"
    assert bits["rfedge", "best-of-any-cpu"] < -20
    assert bits["rfedge-without-field", "x264-our-tools-veryfast"] > -20


@pytest.fixture
def sample_drive(tmp_path: Path) -> None:
    """Make a small field and a small drive, in place of those of the first tutorial."""
    few = ["--size", "160x90", "--every", "4"]
    parse(["dataset", "convert", str(DRIVE), "--out", str(tmp_path / "drive"), *few]).run()
    out = str(tmp_path / "street.rff")
    parse(["field", "slim", str(FIELD), "--keep", "3000", "--raw", "--out", out]).run()


def free_ports(count: int) -> list[str]:
    probes = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [str(probe.getsockname()[1]) for probe in probes]
    for probe in probes:
        probe.close()
    return ports


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.usefixtures("sample_drive")
def test_a_vehicle_drives_over_a_link_and_the_twin_shows_it(tmp_path):
    server, link, page = free_ports(3)
    publish, serve, connect, drive, watch, twin, worse, stop = LIVE.blocks("sh")
    look = f"exec 3<>/dev/tcp/127.0.0.1/{page}; printf 'GET / HTTP/1.0\\r\\n\\r\\n' >&3; cat <&3"
    script = "\n".join(
        (
            *(publish, serve, WAIT.format(server), connect, WAIT.format(link)),
            *(drive, watch, twin, WAIT.format(page), look, worse, stop, "wait"),
        )
    )
    ports = {":50051": f":{server}", ":50050": f":{link}", ":8080": f":{page}"}
    changes = {**ports, "--rate 5": "--rate 20"}
    said = run(script, tmp_path, changes, 110)
    assert "<title>" in said, "the page of the twin"
    pictures = re.findall(r"cav-1\b.*front", said)
    assert len(pictures) >= 20, said
    assert (tmp_path / "seen.mp4").stat().st_size > 0
    lines = [json.loads(line) for line in (tmp_path / "cav-1.jsonl").read_text().splitlines()]
    acked = [line for line in lines if line["result"] == "acked"]
    assert acked
    assert all(line["server_digest"] == line["reconstruction_digest"] for line in acked)
    assert all("crf" in line and "target_bytes" in line for line in acked), "--max-delay-ms is on"
    fetched = list((tmp_path / "vehicle-fields").glob("*.rff"))
    assert [path.read_bytes() for path in fetched] == [(tmp_path / "street.rff").read_bytes()]
