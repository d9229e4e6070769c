"""Packet loss x RTT x rate at street size: what a vehicle's pictures look like behind such a link.

The shipped field and drive, 640x360 at 5 Hz, TCP as the kernel has it. One vehicle at a time: on
two processors, three that render and code keep each other waiting for longer than the links do. A
cell of the matrix is a case, so `make test-fault RESUME=1 ONLY="2Mbps and loss5"` measures some of
them and keeps the others' rows of the same revision. A freeze is a gap between pictures of at least
max(3 d, d + 150 ms), d their mean distance (W3C webrtc-stats, ``freezeCount``).
"""

import asyncio
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import pytest

from attack.conftest import ENVIRONMENT, ROOT
from fault.conftest import is_exact
from lab.pages.suites import LinkCell
from namespaces import namespace, within
from rfcore.dataset import read_dataset
from rfcore.dataset.recorded_session import read_recorded_part, recordings_under
from rfcore.field import FieldStore
from rfcore.image import read_rgb
from rfcore.metrics import psnr

RATES_MBPS = (0.5, 2.0, 8.0)
HZ = 5.0
SETTLE_S, MEASURED_S = 3.0, 15.0
OLDEST_S = 5.0
"""``AgentLimits.answer_s``: a stream whose frames take longer is given up."""
DRIVE = ROOT / "samples/street/transforms_drive_vehicles.json"
PICTURES = 12


@contextmanager
def lossy_wire(near: str, far: str, subnet: str, *numbers: float) -> Iterator[None]:
    """Connect two namespaces; ``numbers`` are loss in percent, RTT in ms and Mbit/s."""
    words = [sys.executable, "-m", "lab.tcp.wire", near, far, subnet, *map(str, numbers)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, env=ENVIRONMENT)
    assert process.stdout is not None
    with process:
        try:
            assert process.stdout.readline() == b"ready\n"
            yield
        finally:
            process.kill()


@dataclass(frozen=True)
class Shown:
    """The fates of the pictures that were captured in ``length_s``."""

    lines: Sequence[dict[str, Any]]
    length_s: float
    qualities_db: Sequence[float]

    @property
    def acked(self) -> list[dict[str, Any]]:
        return [x for x in self.lines if x["result"] == "acked"]

    @property
    def freezes_s(self) -> list[float]:
        """Return the gaps between pictures that are freezes."""
        shown = sorted(x["capture_time_ns"] / 1e9 + x["latency_ms"] / 1e3 for x in self.acked)
        gaps = np.diff(shown)
        mean_s = float(gaps.mean()) if len(gaps) else self.length_s
        return [float(gap) for gap in gaps if gap >= max(3 * mean_s, mean_s + 0.15)]

    def of(self, loss_percent: float, rtt_ms: float, rate_mbps: float) -> LinkCell:
        """Return the figures, of that link."""
        ages_ms = np.percentile([x["latency_ms"] for x in self.acked] or [0.0], (50, 99))
        bits = sum(8 * x["packet_bytes"] for x in self.acked)
        return LinkCell(
            loss_percent=loss_percent,
            rtt_ms=rtt_ms,
            rate_mbps=rate_mbps,
            shown_hz=round(len(self.acked) / self.length_s, 2),
            sent_mbps=round(bits / self.length_s / 1e6, 3),
            frozen_percent=round(100 * sum(self.freezes_s) / self.length_s, 1),
            age_p50_ms=round(float(ages_ms[0]), 1),
            age_p99_ms=round(float(ages_ms[1]), 1),
            psnr_db=round(fmean(self.qualities_db or [0.0]), 2),
        )


def qualities_db(folder: Path, report: Sequence[dict[str, Any]]) -> list[float]:
    """Return the PSNR of some pictures at the server against the camera's."""
    truth = {picture.name: picture for picture in read_dataset(DRIVE).pictures}
    shown = {x["capture_time_ns"]: x["name"] for x in report}
    parts = [read_recorded_part(file) for file in recordings_under(folder)]
    there = [
        (part.path(picture), shown[picture.capture_time_ns])
        for part in parts
        for picture in part.pictures
        if picture.capture_time_ns in shown
    ]
    some = there[:: max(1, len(there) // PICTURES)]
    return [psnr(read_rgb(path), truth[name].read()) for path, name in some]


@pytest.mark.timeout(300)
@pytest.mark.usefixtures("as_root")
@pytest.mark.parametrize("rate_mbps", RATES_MBPS, ids="{:g}Mbps".format)
@pytest.mark.parametrize("rtt_ms", [20, 100, 300], ids="rtt{}".format)
@pytest.mark.parametrize("loss_percent", [0, 1, 5], ids="loss{}".format)
async def test_a_lossy_link(
    loss_percent: int, rtt_ms: int, rate_mbps: float, site: Any, case: Any, tmp_path: Path
) -> None:
    case.about(
        f"{loss_percent} % loss, RTT {rtt_ms} ms, {rate_mbps:g} Mbit/s",
        f"IP packets lost and delayed between namespaces, {HZ:g} Hz of 640x360, quality free to "
        "fall for --max-delay-ms 1000. Freezes by W3C webrtc-stats",
        "F6",
    )
    kept = tmp_path / "kept"
    options = ("--allow-insecure", "--decoder", "in-process", "--record", str(kept))
    field_id = FieldStore(tmp_path / "fields").add(ROOT / "samples/fields/street.rff")
    fields = ("--fields", str(tmp_path / "fields"))
    with ExitStack() as stack:
        far = stack.enter_context(namespace("far"))
        near = stack.enter_context(namespace("near"))
        numbers = (loss_percent, rtt_ms, rate_mbps)
        stack.enter_context(lossy_wire(near, far, "10.215.0", *numbers))
        server = await site.server(*options, *fields, listen="0.0.0.0:0", within=within(far))
        agent = await site.vehicle(
            f"10.215.0.2:{server.address.rpartition(':')[2]}",
            "cav",
            *("--drive", str(DRIVE), *fields, "--field", field_id),
            *("--rate", str(HZ), "--max-delay-ms", "1000", "--allow-insecure"),
            "--allow-recording",
            within=within(near),
        )
        await asyncio.sleep(SETTLE_S)
        began_s = time.time()
        await asyncio.sleep(MEASURED_S)
        ended_s = time.time()
        await asyncio.sleep(2 * rtt_ms / 1e3 + 1.0)
    lines = [x for x in agent.lines() if began_s <= x["capture_time_ns"] / 1e9 <= ended_s]
    acked = [x for x in lines if x["result"] == "acked"]
    shown = Shown(lines, ended_s - began_s, qualities_db(kept / "cav" / "front", acked))
    case.cell = shown.of(loss_percent, rtt_ms, rate_mbps)
    case.tells("pictures shown", f"{case.cell['shown_hz']:.1f} Hz of {HZ:g}")
    case.tells("frozen", f"{sum(shown.freezes_s):.1f} s of {shown.length_s:.0f} s")
    case.holds("pictures go on, all exact", acked and all(map(is_exact, agent.acked())))
    case.at_most("oldest", max((x["latency_ms"] for x in acked), default=0.0) / 1e3, OLDEST_S)
    case.holds("quality measured", shown.qualities_db)
    case.finish()
