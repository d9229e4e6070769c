"""A real vehicle and a real server in one process, over loopback, with all their real parts."""

import asyncio
import itertools
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from structlog.testing import capture_logs

from cav_agent.config import PaceKind
from forward_isas import OPENCL
from recorded import recorded, recorded_parts
from rfcore.codec.h264.config import CoderSettings, LightChange
from rfcore.codec.h264.qp_map import MaskSettings
from rfcore.dataset import read_dataset
from rfcore.image import I420, read_rgb, write_png
from rfcore.native.backend import available_isas
from rfcore.wire.settings import RenderSettings
from rfedge.link import LinkSettings
from rfedge.link.proxy import LinkProxy


async def test_the_server_ends_up_with_the_pictures_of_the_vehicles_closed_loop(
    street: Any, serve: Any, travel: Any, tmp_path: Path
) -> None:
    async with serve(record=tmp_path) as server:
        record = await travel(server.address)
    assert record.counts == {"acked": 6}
    (part,) = recorded_parts(tmp_path, "cav-1", "front")
    assert [picture.file for picture in part.pictures] == [f"{i:06}.png" for i in range(6)]
    assert [picture.digest[:12] for picture in part.pictures] == [
        line["reconstruction_digest"] for line in record.lines
    ]
    driven = read_dataset(street.drive).pictures
    for shown, picture in zip(read_dataset(tmp_path).pictures, driven, strict=True):
        error = np.abs(shown.read().astype(int) - picture.read()).mean()
        assert error < 12, "CRF 23 of a noisy picture stays within a few levels of it"
        assert shown.camera == picture.camera.rounded(), "to the last bit"


async def test_neither_instruction_set_nor_threads_at_either_end_change_a_byte(
    serve: Any, travel: Any, tmp_path: Path
) -> None:
    pairs = list(itertools.product(available_isas(), repeat=2))
    threads = list(itertools.product((1, 2, 5), repeat=2))
    digests = set()
    for number in range(max(len(pairs), len(threads))):
        agent_isa, server_isa = pairs[number % len(pairs)]
        agent_threads, server_threads = threads[number % len(threads)]
        saved = tmp_path / str(number)
        async with serve(record=saved, render=RenderSettings(server_threads, server_isa)) as server:
            record = await travel(server.address, render=RenderSettings(agent_threads, agent_isa))
        assert record.counts == {"acked": 6}
        closed_loop = [line["reconstruction_digest"] for line in record.lines]
        assert [picture.digest[:12] for picture in recorded(saved)] == closed_loop
        digests.add(tuple(closed_loop))
    assert len(digests) == 1


@pytest.mark.slow
@pytest.mark.parametrize("ends", [("cpu", OPENCL), (OPENCL, "cpu"), (OPENCL, OPENCL)])
async def test_an_opencl_device_at_either_end_changes_no_byte(
    serve: Any, travel: Any, tmp_path: Path, ends: tuple[str, str]
) -> None:
    vehicle, edge = (RenderSettings(renderer=renderer) for renderer in ends)
    async with serve(record=tmp_path / "cpu") as server:
        want = await travel(server.address)
    async with serve(record=tmp_path / "opencl", render=edge) as server:
        record = await travel(server.address, render=vehicle)
    assert record.counts == {"acked": 6}
    for name in ("render_digest", "reconstruction_digest", "server_digest"):
        assert [line[name] for line in record.lines] == [line[name] for line in want.lines]
    shown = [picture.digest[:12] for picture in recorded(tmp_path / "opencl")]
    assert shown == [line["reconstruction_digest"] for line in want.lines]


@pytest.mark.slow
async def test_colours_stay_on_the_device_at_both_ends(
    serve: Any, travel: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fetched(*_: Any, **__: Any) -> None:
        raise AssertionError("colours, depth and opacity of a whole picture came to the CPU")

    monkeypatch.setattr("rfcore.raster.native.Rasterizer.render", fetched)
    device = RenderSettings(renderer=OPENCL)
    async with serve(render=device) as server:
        record = await travel(server.address, render=device)
    assert record.counts == {"acked": 6}


@pytest.mark.slow
async def test_a_device_removed_under_a_server_costs_no_frame(
    serve: Any, travel: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The device draws two of six pictures and fails in the third."""
    from rfcore.raster.opencl.device import DeviceLost
    from rfcore.raster.opencl.renderer import DeviceRasterizer

    draw, left = DeviceRasterizer.draw_codec_picture, iter(range(2))

    def removed(self: DeviceRasterizer, camera: Any, degree: int, picture: I420) -> Any:
        for plane in picture.planes:
            plane.fill(7)  # what a dying device may have left
        if next(left, None) is None:
            raise DeviceLost("DEVICE_NOT_AVAILABLE")
        return draw(self, camera, degree, picture)

    async with serve(record=tmp_path, render=RenderSettings(renderer=OPENCL)) as server:
        monkeypatch.setattr(DeviceRasterizer, "draw_codec_picture", removed)
        with capture_logs() as logs:
            record = await travel(server.address)
    assert record.counts == {"acked": 6}
    assert [line["event"] for line in logs].count("opencl device lost") == 1
    assert [picture.digest[:12] for picture in recorded(tmp_path)] == [
        line["reconstruction_digest"] for line in record.lines
    ]


async def test_two_vehicles_share_a_server_and_a_field(
    serve: Any, travel: Any, tmp_path: Path
) -> None:
    async with serve(record=tmp_path) as server:
        records = await asyncio.gather(
            *(travel(server.address, vehicle=name) for name in ("cav-1", "cav-2"))
        )
    for name, record in zip(("cav-1", "cav-2"), records, strict=True):
        assert record.counts == {"acked": 6}
        digests = [line["reconstruction_digest"] for line in record.lines]
        assert [picture.digest[:12] for picture in recorded(tmp_path, name)] == digests


async def test_in_realtime_what_the_link_cannot_take_is_dropped_before_it_is_encoded(
    serve: Any, travel: Any
) -> None:
    async with serve() as server:
        proxy = LinkProxy(LinkSettings(str(server.address), uplink_bps=60e3, delay_ms=1.0))
        await proxy.start()
        record = await travel(proxy.address, pace=PaceKind.REALTIME, rate=200.0)
        await proxy.stop()
    assert record.counts["acked"] + record.counts["dropped"] == 6
    assert record.counts["dropped"] > 0
    for line in record.lines:
        if line["result"] == "dropped":
            assert (line["reason"], line["packet_bytes"]) == ("superseded", None)


async def test_over_a_narrow_link_a_bound_on_delay_costs_quality(serve: Any, travel: Any) -> None:
    """20 kbit/s carry 0.5 kB in the 190 ms that 0.25 s leave at most; free frames here have 0.9.

    A drive that stalls goes on after a minute, when the server ends its idle stream: a bound of
    20 s tells the two apart.
    """
    async with asyncio.timeout(20), serve() as server:
        proxy = LinkProxy(LinkSettings(str(server.address), uplink_bps=20e3, delay_ms=1.0))
        await proxy.start()
        free, bound = [
            (await travel(proxy.address, crf=10.0, max_delay_ms=max_delay_ms)).lines
            for max_delay_ms in (None, 250.0)
        ]
        await proxy.stop()
    assert [line["crf"] for line in free] == [10.0] * 6
    assert [line["target_bytes"] for line in free] == [None] * 6
    bound = [line for line in bound if line["result"] == "acked"]
    assert len(bound) == 6, "one that waited too long is captured again"
    assert all(line["crf"] > 10 for line in bound[1:])
    before, after = (sum(line["payload_bytes"] for line in lines[1:]) for lines in (free, bound))
    assert after < 0.6 * before, "one frame may have more where the machine was late"


async def test_a_drive_with_a_mask_is_reconstructed(
    serve: Any, travel: Any, tmp_path: Path
) -> None:
    write_png(tmp_path / "mask.png", np.full((52, 76, 3), 255, np.uint8))
    masking = MaskSettings(tmp_path / "mask.png", -3)
    async with serve() as server:
        record = await travel(server.address, masking=masking)
    assert record.counts == {"acked": 6}


async def test_the_server_counts_frames_bytes_and_seconds(
    street: Any, serve: Any, travel: Any
) -> None:
    async with serve() as server:
        await travel(server.address)
        value = server.registry.get_sample_value
        acked = {"result": "acked", "reason": ""}
        assert value("rfedge_server_frames_total", acked) == 6
        payload_bytes = value("rfedge_server_payload_bytes_total", {"references": "render"})
        assert 0 < payload_bytes < value("rfedge_server_received_bytes_total")
        for stage in ("queue", "render", "splice", "decode"):
            assert value("rfedge_server_stage_seconds_count", {"stage": stage}) == 6
        for whole in ("frame", "capture_to_picture"):
            assert value(f"rfedge_server_{whole}_seconds_count") == 6
        prefix = street.field_id[:16]
        assert value("rfedge_server_field_info", {"field": prefix, "kind": "splats"}) == 1


def after_sunset(drive: Path, folder: Path) -> Path:
    """Copy a drive, darker from left to right: what no matrix of colours says."""
    shutil.copytree(drive, folder)
    for path in folder.rglob("*.png"):
        rgb = read_rgb(path)
        lit = np.linspace(1.0, 0.3, rgb.shape[1])[None, :, None]
        write_png(path, np.rint(rgb * lit).astype(np.uint8))
    return folder


@pytest.mark.parametrize("light", LightChange)
async def test_under_another_light_both_ends_relight_what_they_render(
    street: Any, serve: Any, travel: Any, tmp_path: Path, light: LightChange
) -> None:
    drive = after_sunset(street.drive, tmp_path / "drive")
    coding = CoderSettings(effort="fast", check_decode=True, light=light)
    async with serve(record=tmp_path / "seen") as server:
        record = await travel(server.address, drive=drive, coding=coding)
    assert record.counts == {"acked": 6}
    relit = [line["relit"] for line in record.lines]
    assert relit == [False] + [light is LightChange.AUTO] * 5
    assert [picture.digest[:12] for picture in recorded(tmp_path / "seen")] == [
        line["reconstruction_digest"] for line in record.lines
    ]
