"""Prerecorded vehicles against real servers: packets are decoded, and every picture counted."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from mec_server.config import AdmissionLimits
from rfcore.codec.decoder import DeltaDecoder
from rfcore.errors import InvalidInput
from rfcore.field import render_field_view
from rfcore.field.quality import FULL
from rfcore.wire.settings import RenderSettings
from rfedge.loadtest.fleet import Departure, FleetSpec, run_fleet
from rfedge.loadtest.plan import Bounds, Load, Mode, Vehicles
from rfedge.loadtest.prerecorded import PrerecordedDrive, payload_drive, prerecorded_drive
from rfedge.loadtest.run import TestBed, run_loads, write_load_result
from rfedge.loadtest.server import KeptRenders, passing, with_kept_renders

PATIENT = Bounds(deadline_ms=60_000.0, on_time_percent=0.0, fairness=0.0, settling_mb=1e6)
"""Bounds without speed: this machine may be busy with other work."""


@pytest.fixture(scope="session")
def recorded(street: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prerecorded_drive(
        street.drive, street.field, tmp_path_factory.mktemp("recorded"), "fast"
    )


def test_prerecorded_frames_decode_in_a_chain_and_alone(street: Any, recorded: Path) -> None:
    drive = PrerecordedDrive.read(recorded)
    for frames in (drive.chain, drive.alone):
        decoder = DeltaDecoder(drive.hello.cameras[0].codec)
        state = decoder.start(frames[0].packet.epoch)
        for frame in frames:
            camera = frame.camera(drive.intrinsics)
            if frame.packet.epoch != state.epoch:
                state = decoder.start(frame.packet.epoch)
            view = render_field_view(street.field, camera)
            done = decoder.decode(state, frame.packet, view)
            assert done.exact
            state = done.state
    assert any(len(frame.packet.references) > 1 for frame in drive.chain)


def test_a_coded_drive_is_coded_once(street: Any, recorded: Path) -> None:
    before = (recorded / "chain.rfv").stat().st_mtime_ns
    again = prerecorded_drive(street.drive, street.field, recorded.parent, "fast")
    assert (again, (again / "chain.rfv").stat().st_mtime_ns) == (recorded, before)


def spec_of(address: object, drive: Path, **changes: Any) -> FleetSpec:
    values: dict[str, Any] = {
        "addresses": (str(address),) * 3,
        "hz": 10.0,
        "cameras": 2,
        "warm_up_s": 0.2,
        "duration_s": 0.5,
        "ready_s": 0.0,
        "drive": str(drive),
    }
    return FleetSpec(**{**values, **changes})


@pytest.mark.parametrize("mode", list(Mode))
async def test_a_fleet_counts_every_picture_and_the_server_refuses_none(
    serve: Callable[..., Any], street: Any, recorded: Path, tmp_path: Path, mode: Mode
) -> None:
    drive, opened = recorded, None
    if mode is Mode.TRANSPORT:
        payload_drive(street.field_id, 2000).write(tmp_path)
        drive, opened = tmp_path, passing
    elif mode is Mode.RECEIVER:
        opened = with_kept_renders()
    started: list[bool] = []
    everybody = AdmissionLimits(load=0.0)
    async with serve(admission=everybody, **({"opened": opened} if opened else {})) as server:
        spec = spec_of(server.address, drive)
        result = await run_fleet(spec, lambda: started.append(True))
    assert started == [True]
    for vehicle in result["vehicles"]:
        assert (vehicle["refused"], vehicle["failed"], vehicle["nacked"]) == ("", "", 0)
        assert vehicle["due"] == 2 * 5
        assert vehicle["latency_ms"], "the newest picture always gets through"


def test_pictures_are_due_together_while_the_server_warms_up_then_spread_over_a_period(
    tmp_path: Path,
) -> None:
    departure = Departure(5.0, 4, spec_of("127.0.0.1:1", tmp_path, warm_up_s=0.5))
    schedules = [departure.schedule(i) for i in range(4)]
    assert [{each.due_s(index) for each in schedules} for index in (0, 2)] == [{5.0}, {5.2}]
    assert [each.due_s(3) for each in schedules] == pytest.approx([5.3, 5.325, 5.35, 5.375])
    assert [each.end_s for each in schedules] == pytest.approx([6.0, 6.025, 6.05, 6.075])


async def test_vehicles_that_reach_nobody_are_counted_as_failed(
    recorded: Path, monkeypatch: pytest.MonkeyPatch, free_port: int
) -> None:
    monkeypatch.setattr("rfedge.loadtest.fleet.CONNECT_S", 0.2)
    result = await run_fleet(spec_of(f"127.0.0.1:{free_port}", recorded), lambda: None)
    assert all(vehicle["failed"] for vehicle in result["vehicles"])
    assert all(vehicle["due"] == 10 for vehicle in result["vehicles"])


def test_kept_renders_are_rendered_once(street: Any) -> None:
    asked: list[object] = []

    class Counting:
        def render(self, camera: Any, quality: Any) -> Any:
            asked.append(camera)
            return street.field.render(camera, quality)

    kept = KeptRenders(Counting())
    frame = payload_drive("ab" * 32, 10).chain[0]
    camera = frame.camera(payload_drive("ab" * 32, 10).intrinsics)
    assert kept.render(camera, FULL) is kept.render(camera, FULL)
    assert len(asked) == 1


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"admission": True}, "admission: needs mode full, not receiver"),
        ({"kind": Vehicles.LIVE}, "live vehicles need mode full, not receiver"),
        ({"render": RenderSettings(threads=2)}, "render: threads and renderer need mode full"),
    ],
)
def test_a_server_that_does_not_render_refuses_what_asks_for_it(
    changes: dict[str, Any], problem: str
) -> None:
    with pytest.raises(InvalidInput, match=problem):
        Load(Mode.RECEIVER, 1, 10.0, **changes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "kind", "link"),
    [
        (Mode.TRANSPORT, Vehicles.PRERECORDED, None),
        (Mode.RECEIVER, Vehicles.PRERECORDED, "samples/links/steady.toml"),
        (Mode.FULL, Vehicles.PRERECORDED, None),
        (Mode.FULL, Vehicles.LIVE, "samples/links/steady.toml"),
    ],
)
def test_the_command_leaves_a_page_and_rows(
    street: Any, tmp_path: Path, mode: Mode, kind: Vehicles, link: str | None
) -> None:
    root = Path(__file__).parents[2]
    render = RenderSettings(threads=2 if mode is Mode.FULL else 1)
    profile = root / link if link else None
    load = Load(mode, 2, 5.0, 2.0, 0.5, link=profile, kind=kind, render=render, bounds=PATIENT)
    field = next(street.store.glob("*.rff"))
    bed = TestBed(field, street.drive, 2, tmp_path / "cache", tmp_path / "work", "fast")
    result = run_loads(load, bed, Console())
    write_load_result(result, tmp_path)
    assert result.most_held == 2, result.runs[0].verdict.broken
    (row,) = json.loads((tmp_path / "result.json").read_text())["rows"]
    assert (row["mode"], row["nacked"], row["refused"], row["held"]) == (mode, 0, 0, True)
    assert (row["renderer"], row["threads"]) == ("cpu", render.threads)
    assert row["server_cores"] > 0.0
    assert (row["links_cores"] > 0.0) == (link is not None)
    assert "2 vehicles held" in (tmp_path / "report.html").read_text()
