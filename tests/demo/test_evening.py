"""The evening demo: its dusk, its report, and the whole of it with real processes."""

import io
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.dataset import read_dataset, write_manifest
from rfcore.dataset.source import SourceCamera
from rfcore.dataset.write import WrittenPicture, transforms_of
from rfcore.errors import InvalidInput
from rfcore.field import SplatField
from rfcore.image import write_png
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer
from rfedge.cli.demo import Demo
from rfedge.demo.dusk import LAMP, REACH_M, SHADOW, TINT, DuskLight, at_dusk, write_dusk
from rfedge.demo.evening import EveningDrive, EveningPictures, LearntLight
from rfedge.demo.field import write_sample_field
from rfedge.demo.report import print_evening, write_evening_report
from rfedge.results import Provenance, make_result

K = Intrinsics(8, 6, 4.0, 4.0, 4.0, 3.0)
CAMERA = Camera(K, Pose.identity())
RIGHT = np.float32([1, 0, 0])
UNLIT = DuskLight(RIGHT, 0.0, np.zeros((0, 3), np.float32))
WHITE = np.full((6, 8, 3), 255, np.uint8)


def corridor() -> Gaussians:
    """Two walls, 2 m to either side, of round splats with a texture."""
    rng = np.random.default_rng(0)
    x, y, z = np.meshgrid([-2.0, 2.0], np.linspace(-1.5, 1.5, 16), np.linspace(2, 22, 110))
    n = x.size
    return Gaussians(
        means=np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1).astype(np.float32),
        quaternions=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        log_scales=np.full((n, 3), np.log(0.1), np.float32),
        opacity_logits=np.full(n, 3.0, np.float32),
        sh=rng.uniform(-1, 1, (n, 1, 3)).astype(np.float32),
    )


@pytest.fixture
def corridor_with_its_field(tmp_path: Path) -> Path:
    """Return a sample with a drive of 12 frames along the corridor, and the corridor's field."""
    folder = tmp_path / "samples" / "corridor"
    (folder / "drive_empty").mkdir(parents=True)
    k, written = Intrinsics(256, 144, 128.0, 128.0, 128.0, 72.0), []
    rasterizer = Rasterizer(corridor())
    for number in range(12):
        camera = Camera(k, Pose((0.0, 0.0, 0.4 * number), (1.0, 0.0, 0.0, 0.0)))
        colour = rasterizer.render(camera).colour
        name = f"drive_empty/{number:03d}.png"
        write_png(folder / name, np.rint(np.clip(colour, 0, 1) * 255).astype(np.uint8))
        pose, time_ns = camera.world_from_cam, number * 100_000_000
        written.append(WrittenPicture(name, SourceCamera(k), pose, time_ns))
    content = json.dumps(transforms_of(written, None))
    (folder / "transforms_drive_empty.json").write_text(content)
    write_manifest(folder)
    made = Provenance("make sample-field", "abc", False, {}, {})
    write_sample_field(folder, SplatField(corridor()), made, seconds=0)
    return folder


def shown(linear: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, above its straight part."""
    return np.floor((1.055 * linear ** (1 / 2.4) - 0.055) * 255 + 0.5)


def test_half_way_between_light_and_shadow_white_is_the_tint() -> None:
    far_m = 1e-3  # all pixels within a millimetre of the border
    dusk = at_dusk(WHITE, np.full((6, 8), far_m, np.float32), CAMERA, UNLIT)
    expected = shown((SHADOW + 0.5) * np.array(TINT))
    assert np.abs(dusk.astype(float) - expected).max() <= 1


def test_far_to_either_side_there_is_the_shadow_and_the_light() -> None:
    """The sky, where the field shows nothing, is far away."""
    dusk = at_dusk(WHITE, np.zeros((6, 8), np.float32), CAMERA, UNLIT).astype(float)
    assert np.abs(dusk[:, 0] - shown(SHADOW * np.array(TINT))).max() <= 1
    assert np.abs(dusk[:, -1] - shown((SHADOW + 1) * np.array(TINT))).max() <= 1


def test_the_light_belongs_to_the_place_and_not_to_the_picture() -> None:
    """A wall 4 m off seen from 1 m further right: two pixels of 1 m each to the left."""
    depth_m = np.full((6, 8), 4.0, np.float32)
    moved = Camera(K, Pose((2.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
    first, second = (at_dusk(WHITE, depth_m, c, UNLIT) for c in (CAMERA, moved))
    assert (first[:, 2:] == second[:, :-2]).all()
    assert (first[:, 2:] != first[:, :-2]).any()


def test_lamps_hang_beside_the_way_and_their_light_falls_off_as_said() -> None:
    ahead = Camera(K, Pose((0.0, 0.0, 10.0), (1.0, 0.0, 0.0, 0.0)))
    light = DuskLight.along([CAMERA, ahead])
    assert np.allclose(light.lamps_m[:2], [[3, -0.5, 6], [-3, -0.5, 12]])
    assert light.lamps_m[-1, 2] == 48, "40 m beyond the last camera at most"
    alone = DuskLight(RIGHT, 0.0, np.float32([[0, 0, 4]]))
    points = np.float32([[0, 0, 4], [0, 0, 4 + REACH_M], [0, REACH_M * 3, 4]])
    added = alone.on(points) - UNLIT.on(points)
    assert np.allclose(added, np.outer([1, 1 / 2, 1 / 82], LAMP), atol=1e-6)


def test_black_stays_black() -> None:
    black = np.zeros((6, 8, 3), np.uint8)
    assert not at_dusk(black, np.ones((6, 8), np.float32), CAMERA, UNLIT).any()


def test_a_drive_at_dusk_has_the_poses_and_times_of_the_one_at_noon(
    tiny_sample: Path, tiny_gaussians: Gaussians, tmp_path: Path
) -> None:
    noon = tiny_sample / "transforms_drive_empty.json"
    made = write_dusk(noon, SplatField(tiny_gaussians), tmp_path / "dusk")
    pairs = list(zip(read_dataset(made).pictures, read_dataset(noon).pictures, strict=True))
    assert len(pairs) == 4
    for dusk, day in pairs:
        assert dusk.camera == day.camera
        assert dusk.time_ns == day.time_ns
        assert dusk.read().mean() < day.read().mean() / 1.5


DRIVES = [
    EveningDrive("first", None, 12, 80.0, 33.5, 12.0, 2.0, 0, 4.5),
    EveningDrive("second", "h18", 12, 32.0, 34.0, 28.0, 1.5, 91_234, 6.0),
]
LIGHT = LearntLight("h18", "ab" * 32, 1, 51.0, 91_234, 33.0)
SETTINGS = {"crf": 23.0, "effort": "default", "link_bps": 4e6, "link_delay_ms": 20.0}


def result_of(dusk: str | None) -> dict[str, Any]:
    host = {"cpu": "C", "cores": 2, "isa": "avx2"}
    content = {
        "settings": SETTINGS,
        "dusk": dusk,
        "field": {"id": "cd" * 32, "gaussians": 1234},
        "light": LIGHT,
        "drives": DRIVES,
    }
    made = Provenance("rfedge demo --evening", "abc", False, host, {})
    return make_result("demo-evening", made, content)


@pytest.mark.parametrize("dusk", [None, "out/dusk/transforms_drive_10hz.json"])
def test_the_report_has_the_table_the_pictures_and_where_dusk_is_from(
    dusk: str | None, tmp_path: Path
) -> None:
    pictures = [EveningPictures("000.png", WHITE, WHITE // 2, WHITE - 1)]
    write_evening_report(tmp_path / "report.html", result_of(dusk), pictures)
    page = (tmp_path / "report.html").read_text()
    assert "takes 60 % fewer bits a frame" in page
    rows = re.findall(r"<tr>(?:<td>.*?</td>)+</tr>", page)
    assert [re.findall(r"<td>(.*?)</td>", row)[2:4] for row in rows] == [
        ["80.0", "+0.0"],
        ["32.0", "-60.0"],
    ]
    assert "91,234" in rows[-1]
    assert page.count("data:image/jpeg") == 3
    assert ("made of the drive at noon" in page) == (dusk is None)
    assert dusk is None or dusk in page
    assert re.findall(r"(?:src|href)=.(?!data:|#)[^>]*", page) == [], "the page is self-contained"


def test_the_table_is_printed() -> None:
    said = io.StringIO()
    print_evening(Console(file=said, width=200), result_of(None), Path("out/there"))
    assert "second vehicle" in said.getvalue()
    assert "out/there/report.html" in said.getvalue()


def demo(*options: str) -> subprocess.CompletedProcess[str]:
    code = "import sys; from rfedge.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "demo", *options]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_a_drive_at_dusk_without_an_evening_is_refused(tmp_path: Path) -> None:
    verb = Demo(dusk=Path("dusk.json"), out=tmp_path / "demo")
    with pytest.raises(InvalidInput, match="is driven only with --evening"):
        verb.run()
    assert not (tmp_path / "demo").exists()


@pytest.mark.slow
def test_the_second_vehicle_fetches_what_the_first_one_taught_and_takes_fewer_bits(
    corridor_with_its_field: Path, tmp_path: Path
) -> None:
    """A server that learns, a link, two vehicles: six processes, by the demo's own command."""
    out = tmp_path / "demo"
    sample = ("--sample", str(corridor_with_its_field), "--out", str(out))
    done = demo("--evening", *sample, "--crf", "23", "--threads", "1")
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads((out / "result.json").read_text())
    first, second = (EveningDrive(**drive) for drive in result["drives"])
    light = result["light"]
    assert (first.light, second.light) == (None, light["light"])
    assert first.frames == second.frames == 11
    assert (first.rounds, light["passes"]) == (1.0, 1)
    assert second.kbit_per_frame < 0.9 * first.kbit_per_frame, "which relit its renders"
    assert second.psnr_db > first.psnr_db - 0.2, "fewer bits at no less quality"
    assert second.rf_psnr_db > first.rf_psnr_db + 6
    assert first.fetched_bytes == 0
    fetched = out / "work" / "vehicle-second" / "fields" / f"{light['field_id']}.rff"
    assert second.fetched_bytes == light["size_bytes"] == fetched.stat().st_size
    report = (fetched.parents[1] / "agent.jsonl").read_text().splitlines()
    answered = [row for row in map(json.loads, report) if row["result"] == "acked"]
    assert all(row["server_digest"] == row["reconstruction_digest"] for row in answered)
    assert answered[0]["light_field"] is None, "it starts with the field of noon"
    assert (out / "report.html").stat().st_size > 10_000
