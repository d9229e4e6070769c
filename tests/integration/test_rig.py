"""A rig: several cameras in one session of a real agent with a real server."""

import asyncio
from collections import Counter, defaultdict
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import pytest
from structlog.testing import capture_logs

from cav_agent.config import PaceKind
from integration.conftest import FRAMES, Street, write_rig_drives
from live_server import watched
from mec_server.session import DecodeJob
from mec_server.twin.state import ReceivedPicture, Twin
from rfcore.camera import Pose, camera_on_rig
from rfcore.dataset.rig import read_rig, read_rig_drive
from rfcore.errors import PacketRejected, RejectReason
from rfcore.image import Rgb
from rfcore.views import View

CAMERA = "[camera]\nwidth_px = 76\nheight_px = 52\nfx_px = 50.0\ncx_px = 38.0\ncy_px = 26.0\n"


@pytest.fixture(scope="module")
def rig(street: Street, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_rig_drives(tmp_path_factory.mktemp("rig"), street.field, 4)


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[ReceivedPicture]:
    """Return the pictures that the twin of any server shows."""
    views: list[ReceivedPicture] = []
    show = Twin.show

    def keep(twin: Twin, view: ReceivedPicture, *render: View) -> None:
        views.append(view)
        show(twin, view, *render)

    monkeypatch.setattr(Twin, "show", keep)
    return views


def refuse(_: str, job: DecodeJob) -> None:
    """Refuse the frames of one camera."""
    if job.frame.camera_id == "cam2":
        raise PacketRejected(RejectReason.DECODER_FAILED, "it is broken")


async def test_four_cameras_are_one_session_with_one_pose_an_instant(
    serve: Any, vehicle: Any, seen: list[ReceivedPicture], rig: Path
) -> None:
    async with serve() as server, vehicle(server.address, drive=None, rig=rig) as driving:
        counts = await driving.end()
        lines = driving.lines()
        value = server.registry.get_sample_value
        assert value("rfedge_server_poses_ahead_total", {"result": "taken"}) >= 4
        assert value("rfedge_server_poses_ahead_total", {"result": "refused"}) == 0
    assert counts == Counter(acked=4 * FRAMES)
    assert {view.session_id for view in seen} == {seen[0].session_id}
    instants = defaultdict(set)
    for view in seen:
        instants[view.frame.instant].add((view.frame.camera_id, view.frame.capture_time_ns))
    assert len(instants) == FRAMES
    for pictures in instants.values():
        assert {camera for camera, _ in pictures} == {f"cam{i}" for i in range(4)}
        assert len({time_ns for _, time_ns in pictures}) == 1
    assert {line["camera"] for line in lines} == {f"cam{i}" for i in range(4)}
    read = read_rig(rig)
    drive = read_rig_drive(read)
    places = {camera.name: camera.camera_from_rig for camera in read.cameras}
    for view in seen:
        instant = drive[view.frame.instant - 1]
        wanted = camera_on_rig(instant.world_from_rig, places[view.frame.camera_id])
        assert view.frame.pose == wanted


async def test_a_camera_whose_pictures_cannot_be_read_takes_no_other_with_it(
    serve: Any, vehicle: Any, street: Street, tmp_path: Path
) -> None:
    file = write_rig_drives(tmp_path / "rig", street.field, 3)
    for i in range(2, FRAMES):
        picture = tmp_path / "rig" / "cam1" / f"{i:03}.png"
        picture.write_bytes(picture.read_bytes()[:200])
    async with (
        serve() as server,
        vehicle(server.address, drive=None, rig=file) as driving,
    ):
        counts = await driving.end()
        lines = driving.lines()
    assert counts == Counter(acked=2 * FRAMES + 2, dropped=FRAMES - 2)
    lost = {(line["camera"], line["reason"]) for line in lines if line["result"] != "acked"}
    assert lost == {("cam1", "not_coded")}


async def test_a_camera_whose_decoder_fails_takes_no_other_with_it(
    serve: Any, vehicle: Any, rig: Path
) -> None:
    async with (
        serve(watched(refuse)) as server,
        vehicle(server.address, drive=None, rig=rig) as driving,
    ):
        counts = await driving.end()
        results = Counter((line["camera"], line["result"]) for line in driving.lines())
    assert counts == Counter(acked=3 * FRAMES, nacked=FRAMES)
    assert results["cam2", "nacked"] == FRAMES


async def test_under_a_delay_the_cameras_share_one_budget(
    serve: Any, vehicle: Any, rig: Path
) -> None:
    changes = {"pace": PaceKind.REALTIME, "rate": 2.0, "max_delay_ms": 5000.0}
    async with (
        serve() as server,
        vehicle(server.address, drive=None, rig=rig, **changes) as driving,
    ):
        await driving.end()
        lines = [line for line in driving.lines() if line["result"] == "acked"]
    assert len({line["camera"] for line in lines}) == 4
    assert all(line["target_bytes"] > 0 for line in lines)


def write_live_rig(folder: Path, drives: Path) -> Path:
    """Make videos at 5 Hz of the drives of a rig, with the reference's poses; return the rig file.

    The video of cam1 is none.
    """
    rig = read_rig(drives)
    instants = read_rig_drive(rig)
    lines = []
    for camera in rig.cameras:
        (folder / camera.name).mkdir(parents=True)
        (folder / camera.name / "camera.toml").write_text(CAMERA)
        video = folder / f"{camera.name}.mkv"
        write_video(video, [instant.pictures[camera.name].read() for instant in instants])
        turn, at = camera.camera_from_rig.rotation_matrix(), camera.camera_from_rig.translation_m
        rows = [[*row, metres] for row, metres in zip(turn, at, strict=True)]
        lines += ["[[camera]]", f'name = "{camera.name}"', f'source = "{video}"']
        lines += [f'camera_file = "{camera.name}/camera.toml"', f"camera_from_rig = {rows!r}"]
    poses = [instant.pictures["cam0"].camera.world_from_cam for instant in instants]
    reference = folder / "cam0"
    (reference / "camera.toml").write_text(CAMERA + '[trajectory]\nfile = "poses.txt"\n')
    (reference / "poses.txt").write_text("".join(map(tum_line, range(FRAMES), poses)))
    (folder / "cam1.mkv").write_bytes(b"no video" * 100)
    (folder / "rig.toml").write_text("\n".join(lines) + "\n")
    return folder / "rig.toml"


def tum_line(index: int, pose: Pose) -> str:
    w, x, y, z = pose.rotation
    return " ".join(map(repr, (index / 5, *pose.translation_m, x, y, z, w))) + "\n"


def write_video(path: Path, pictures: list[Rgb]) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=5)
        stream.width, stream.height, stream.pix_fmt = 76, 52, "yuv420p"
        stream.options = {"crf": "10", "bf": "0"}
        for i, rgb in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(rgb, format="rgb24")
            frame.pts, frame.time_base = i, Fraction(1, 5)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


async def test_the_live_cameras_of_a_rig_are_sent_together_without_the_one_that_is_lost(
    serve: Any, vehicle: Any, seen: list[ReceivedPicture], rig: Path, tmp_path: Path
) -> None:
    file = await asyncio.to_thread(write_live_rig, tmp_path / "live", rig)
    changes = {"pace": PaceKind.REALTIME, "rate": 5.0, "loop": True}
    with capture_logs() as logs:
        async with (
            serve() as server,
            vehicle(server.address, drive=None, rig=file, **changes) as driving,
        ):
            await driving.until(lambda: driving.acked() >= 12)
            lost = {e["camera"] for e in logs if e["event"] == "source lost"}
    assert lost == {"cam1"}
    instants = defaultdict(set)
    for view in seen:
        instants[view.frame.instant].add(view.frame.camera_id)
    assert {"cam0", "cam2", "cam3"} in instants.values()
    assert all("cam1" not in cameras for cameras in instants.values())
    read = read_rig(rig)
    places = {camera.name: camera.camera_from_rig for camera in read.cameras}
    views = {(view.frame.instant, view.frame.camera_id): view for view in seen}
    for (instant, camera_id), view in views.items():
        assert view.frame.pose is not None
        world_from_rig = view.frame.pose.compose(places[camera_id])
        assert world_from_rig.translation_m[0] == pytest.approx(
            -0.25 * world_from_rig.translation_m[2], abs=0.02
        ), (instant, camera_id)
