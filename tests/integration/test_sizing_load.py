"""``rfedge size`` agrees with a load that is measured at the link shaper."""

import asyncio
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rfcore.codec.h264.config import CoderSettings
from rfcore.dataset import read_dataset
from rfcore.native.yuv import i420_from_rgb
from rfedge.link import LinkSettings
from rfedge.link.proxy import LinkProxy
from rfedge.samples import sample_path
from rfedge.sizing.estimate import Demand, estimate
from rfedge.sizing.tables import shipped_tables

CAMERAS, HZ, LINK_BPS, CRF = 4, 10.0, 8e6, 26.0
WITHIN = 0.1


def luma_psnr_db(shown: Any, driven: Any) -> float:
    """Return the PSNR of the mean squared error over the pictures of a recording."""
    errors = []
    for got, given in zip(shown, driven, strict=True):
        difference = i420_from_rgb(got.read()).y.astype(float) - i420_from_rgb(given.read()).y
        errors.append(np.mean(difference * difference))
    return 10 * math.log10(255**2 / np.mean(errors))


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.timeout(600)
async def test_four_cameras_take_of_a_shaped_link_what_is_told(
    serve: Any, travel: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every picture is coded and sent, so that a busy machine changes no byte; the rate is of as
    many pictures at ``HZ``."""
    monkeypatch.setattr("mec_server.recorder.MAX_WAITING", 1000)  # a slow disk loses none
    fields = tmp_path / "fields"
    fields.mkdir()
    (fields / "street.rff").symlink_to(Path(sample_path("fields/street.rff")).resolve())
    drive = sample_path("street/transforms_drive_vehicles.json")
    async with serve(fields=fields, record=tmp_path / "recorded") as server:
        field_id = server._index.ids()[0]
        proxy = LinkProxy(LinkSettings(str(server.address), uplink_bps=LINK_BPS, delay_ms=20.0))
        await proxy.start()
        records = await asyncio.gather(
            *(
                travel(
                    proxy.address,
                    drive=drive,
                    fields=fields,
                    field=field_id,
                    vehicle=f"cav-{number}",
                    coding=CoderSettings(),
                    crf=CRF,
                )
                for number in range(CAMERAS)
            )
        )
        await proxy.stop()
    driven = read_dataset(drive).pictures
    assert [record.counts for record in records] == [{"acked": len(driven)}] * CAMERAS
    measured_mbps = proxy.report()["uplink"]["bytes"] * 8e-6 * HZ / len(driven)
    psnr_db = luma_psnr_db(read_dataset(tmp_path / "recorded/cav-0").pictures, driven)
    told = estimate(Demand(CAMERAS, 640, 360, HZ, psnr_db), shipped_tables()).estimates[0]
    print(
        f"CRF {CRF:g}, {psnr_db:.2f} dB: {measured_mbps:.3f} Mbit/s measured at the link, "
        f"{told.mbps:.3f} ({told.low_mbps:.3f}..{told.high_mbps:.3f}) told"
    )
    assert told.codec == "rfedge"
    assert told.mbps == pytest.approx(measured_mbps, rel=WITHIN)
