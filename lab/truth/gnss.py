"""GNSS as receivers give it: heights and headings that the product makes of a known position.

Sentences go to the product's ``PoseFeed`` directly, or by a pseudo terminal through the real gpsd.
``run_drive`` follows a minute of motorway: u-blox fixes beside reference poses (comma2k19).
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import shutil
import socket
import subprocess
import time
import tty
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymap3d import ecef2enuv, ecef2geodetic
from pynmea2 import NMEASentence

from cav_agent.pose_feed import FeedPoses, FieldPlacement, PoseFeed
from cav_agent.pose_feed.fix import Fix
from cav_agent.pose_feed.sources import FeedKind, FeedSource, FeedTask
from rfcore.camera import TileOrigin
from rfcore.errors import RfedgeError
from rfcore.geodesy import Anchor

F64 = NDArray[np.float64]
PLACE = "4807.0380000,N,01131.0000000,E"
ALTITUDE_M, SEPARATION_M = 545.4, 46.9
HEADING_DEG, COURSE_DEG = 123.4, 121.4
"""The vehicle drifts: its course over ground is not where it looks."""
EPOCHS, MOST_EPOCHS = 6, 60
"""Epochs that are given to a feed; gpsd takes some until it reports."""
GPSD_EPOCH_S = 0.4
"""gpsd ends an epoch when the line is silent."""
LAST_GPS_DAY_S = 1_483_228_797
"""2016-12-31 23:59:57 UTC, before the last leap second."""
GPS_EPOCH_S, WEEK_S, GPS_AHEAD_S = 315_964_800, 604_800, 18
"""GPS time in Unix time, and its leap seconds since 2017."""
COMMA_SEPARATION_M = -32.2
"""The geoid at the drive of comma2k19 (EGM96), by which altitudes are made of its heights."""


@dataclass(frozen=True)
class GnssCase:
    """Sentences of a receiver in each epoch, ``{clock}``, ``{day}`` and others replaced."""

    name: str
    bodies: tuple[str, ...]
    begins_s: int = 1_700_000_000

    def epochs(self, count: int = EPOCHS) -> list[bytes]:
        """Return the bytes of each epoch, one a second."""
        made = []
        for n in range(count):
            clock, day = _utc(self.begins_s, n)
            texts = [body.format(clock=clock, day=day, place=PLACE) for body in self.bodies]
            made.append("".join(map(sentence, texts)).encode())
        return made


def sentence(body: str) -> str:
    """Return an NMEA sentence with its checksum."""
    return f"${body}*{NMEASentence.checksum(body):02X}\r\n"


def _utc(begins_s: int, n: int) -> tuple[str, str]:
    """Return clock and day of a second of UTC; the last leap second is one of them."""
    second = begins_s + n
    if begins_s == LAST_GPS_DAY_S and n >= 3:
        second -= 1
        if n == 3:
            return "235960.00", "311216"
    at = time.gmtime(second)
    return time.strftime("%H%M%S.00", at), time.strftime("%d%m%y", at)


RMC = f"GNRMC,{{clock}},A,{{place}},022.4,{COURSE_DEG:.1f},{{day}},,,A"
GGA = f"GNGGA,{{clock}},{{place}},1,12,1.0,{ALTITUDE_M},M,{SEPARATION_M},M,,"
GGA_ALONE = f"GNGGA,{{clock}},{{place}},1,12,1.0,{ALTITUDE_M},M,,M,,"
GSA = "GNGSA,A,3,04,05,09,12,24,25,29,31,,,,,2.5,1.3,2.1"
HDT, THS = f"GNHDT,{HEADING_DEG},T", f"GNTHS,{HEADING_DEG},A"
UNKNOWN = ("PXYZ,1,2", "GNQQQ,3")
CASES = (
    GnssCase("NMEA", (RMC, GGA, GSA)),
    GnssCase("NMEA, GGA without separation", (RMC, GGA_ALONE, GSA)),
    GnssCase("NMEA, HDT", (HDT, RMC, GGA, GSA)),
    GnssCase("NMEA, THS", (THS, RMC, GGA, GSA)),
    GnssCase("NMEA, sentences nobody knows", (*UNKNOWN, RMC, GGA, GSA)),
    GnssCase("NMEA, leap second", (RMC, GGA, GSA), LAST_GPS_DAY_S),
)
GPSD_CASES = (
    GnssCase("gpsd", (RMC, GGA, GSA)),
    GnssCase("gpsd, GGA without separation", (RMC, GGA_ALONE, GSA)),
    GnssCase("gpsd, HDT", (HDT, RMC, GGA, GSA)),
    GnssCase("gpsd, THS", (THS, RMC, GGA, GSA)),
)


class Said:
    """Collects the problems of a feed, each once."""

    def __init__(self) -> None:
        self.problems: dict[str, str] = {}

    def __call__(self, problem: str, text: str, begins: bool) -> None:  # noqa: ARG002
        """Note a problem."""
        self.problems.setdefault(str(problem), text)

    def text(self) -> str:
        """Return all of them but those of a recorded drive's clock."""
        return "; ".join(problem for problem in self.problems if problem not in ("clock", "lost"))


def run_sentences(case: GnssCase) -> dict[str, Any]:
    """Give a case to a feed."""
    said = Said()
    feed = PoseFeed(said, recorded=True)
    feed.receive(b"".join(case.epochs()), case.begins_s * 10**9)
    return _row(case, [fix for fix, _ in feed.since(0)[0]], said)


def run_gpsd(case: GnssCase) -> dict[str, Any]:
    """Give a case to the real gpsd, and what it reports to a feed."""
    return asyncio.run(_through_gpsd(case))


async def _through_gpsd(case: GnssCase) -> dict[str, Any]:
    program = shutil.which("gpsd", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
    if program is None:
        raise RfedgeError("gpsd is missing: apt-get install gpsd")
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    line = os.ttyname(theirs)
    Path(line).chmod(0o666)  # gpsd gives root's rights away
    with closing(socket.create_server(("127.0.0.1", 0))) as probe:
        port = probe.getsockname()[1]
    words = (program, "-N", "-n", "-b", "-S", str(port), line)
    said = Said()
    feed = PoseFeed(said)
    daemon = subprocess.Popen(words, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    task = FeedTask(FeedSource(FeedKind.GPSD, host="127.0.0.1", port=port), feed, time.time_ns)
    running = asyncio.create_task(task.run())
    try:
        await asyncio.wait_for(task.opened.wait(), 30.0)
        for epoch in case.epochs(MOST_EPOCHS):
            os.write(ours, epoch)
            await asyncio.sleep(GPSD_EPOCH_S)
            if feed.count >= EPOCHS:
                break
    finally:
        running.cancel()
        with suppress(asyncio.CancelledError):
            await running
        daemon.terminate()
        daemon.wait(10.0)
        os.close(ours)
        os.close(theirs)
    return _row(case, [fix for fix, _ in feed.since(0)[0]][-2:], said)


def _row(case: GnssCase, fixes: Sequence[Fix], said: Said) -> dict[str, Any]:
    """Return the worst errors of fixes that stand at the known place and look the known way."""
    if not fixes:
        raise RfedgeError(f"{case.name}: no fix came ({said.problems})")
    places = [fix.geodetic for fix in fixes if fix.geodetic is not None]
    due_ns = [(case.begins_s + n) * 10**9 for n in range(MOST_EPOCHS)]
    late_ns = [min(abs(fix.time_ns - due) for due in due_ns) for fix in fixes]
    heights = [
        abs(height - ALTITUDE_M - SEPARATION_M) for *_, height in places if height is not None
    ]
    turns = [abs(fix.heading_deg - HEADING_DEG) for fix in fixes if fix.heading_deg is not None]
    return {
        "fixes": len(fixes),
        "height_error_m": max(heights, default=None),
        "height_std_m": max(fix.position_std_m[2] for fix in fixes),
        "heading_error_deg": max(turns, default=None),
        "time_error_ms": max(late_ns) / 1e6,
        "refused": said.text(),
    }


@dataclass(frozen=True)
class Reference:
    """Where the camera of comma2k19 was: Unix times, and positions and the looking direction in
    east, north, up at the first one."""

    times_ns: list[int]
    positions_m: F64
    ahead: F64
    anchor: Anchor


@dataclass(frozen=True)
class Drive:
    """The way the fixes of comma2k19 are told; ``shifted``: by the offset found before."""

    name: str
    form: str
    shifted: bool = False


DRIVES = (
    Drive("comma2k19, NMEA", "nmea"),
    Drive("comma2k19, NMEA without separation", "alone"),
    Drive("comma2k19, JSON", "json"),
    Drive("comma2k19, JSON, the offset found added", "json", shifted=True),
)


def run_drive(drive: Drive, folder: Path | None) -> dict[str, Any]:
    """Compare the pose that a feed gives at each picture's time with the reference.

    ``folder`` is a segment of comma2k19 without its video, so that no pose is found in a field.
    """
    if folder is None:
        raise RfedgeError("needs --comma, a segment of comma2k19")
    reference, texts = _reference(folder), list[str]()
    for rmc, gga, told in _receiver(folder):
        if drive.form == "alone":
            gga = gga.replace(f"{COMMA_SEPARATION_M},M", ",M")
        texts.append(told if drive.form == "json" else sentence(rmc) + sentence(gga))
    data = "".join(texts).encode()
    row = _priors(data, reference)
    return _priors(data, reference, row["offset_s"]) if drive.shifted else row


def _reference(folder: Path) -> Reference:
    def read(name: str) -> F64:
        values: F64 = np.load(folder / "global_pose" / f"frame_{name}")
        return values

    ecef_m, gps = read("positions"), read("gps_times")
    unix_s = GPS_EPOCH_S + gps[:, 0] * WEEK_S + gps[:, 1] - GPS_AHEAD_S
    w, x, y, z = read("orientations").T
    ahead = (1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w))
    lat, lon, height_m = map(float, ecef2geodetic(*ecef_m[0]))
    anchor = Anchor(lat, lon, height_m)
    moved = ecef_m - ecef_m[0]
    enu, looks = (np.stack(ecef2enuv(*a, lat, lon), 1) for a in (moved.T, ahead))
    return Reference([round(1e9 * s) for s in unix_s], enu, looks, anchor)


def _receiver(folder: Path) -> list[tuple[str, str, str]]:
    """Return RMC, GGA and our own line of each fix of the u-blox receiver."""
    lines = []
    for lat, lon, mps, utc_ms, height_m, course in np.load(
        folder / "processed_log/GNSS/live_gnss_ublox/value"
    ):
        second, ms = divmod(round(utc_ms), 1000)
        clock = f"{time.strftime('%H%M%S', time.gmtime(second))}.{ms:03d}"
        day = time.strftime("%d%m%y", time.gmtime(second))
        place = f"{_minutes(lat, 2, 'NS')},{_minutes(lon, 3, 'EW')}"
        rmc = f"GNRMC,{clock},A,{place},{mps * 3600 / 1852:.2f},{course % 360:.2f},{day},,,A"
        altitude_m = height_m - COMMA_SEPARATION_M
        gga = f"GNGGA,{clock},{place},1,12,1.0,{altitude_m:.3f},M,{COMMA_SEPARATION_M},M,,"
        told = {"time_s": utc_ms / 1e3, "latitude_deg": lat, "longitude_deg": lon}
        told |= {"height_m": height_m, "heading_deg": course}
        lines.append((rmc, gga, json.dumps(told) + "\n"))
    return lines


def _minutes(value_deg: float, digits: int, sides: str) -> str:
    whole, rest = divmod(abs(value_deg), 1.0)
    return f"{int(whole):0{digits}d}{60 * rest:010.7f},{sides[int(value_deg < 0)]}"


def _priors(data: bytes, reference: Reference, offset_s: float = 0.0) -> dict[str, Any]:
    """Compare the pose that a feed gives at each picture's time with the reference."""
    said = Said()
    feed = PoseFeed(said, recorded=True, offset_s=offset_s)
    feed.receive(data, reference.times_ns[0])
    poses = FeedPoses(feed, FieldPlacement(reference.anchor, TileOrigin()))
    ground_m, height_m, turned_deg = list[float](), list[float](), list[float]()
    for at_ns, there, ahead in zip(
        reference.times_ns, reference.positions_m, reference.ahead, strict=True
    ):
        with suppress(RfedgeError):  # no fix yet
            pose = poses.prior(at_ns).world_from_cam
            apart = np.subtract(pose.translation_m, there)
            looks = np.subtract(pose.apply((0.0, 0.0, 1.0)), pose.translation_m)
            turn = math.degrees(math.atan2(*looks[:2]) - math.atan2(*ahead[:2]))
            ground_m.append(math.hypot(*apart[:2]))
            height_m.append(float(abs(apart[2])))
            turned_deg.append(abs((turn + 180.0) % 360.0 - 180.0))
        x, y, z = map(float, there)
        poses.localised(at_ns, (x, y, z))
    found = poses.time_offset()
    return {
        "fixes": feed.count,
        "position_error_m": median(ground_m),
        "height_error_m": median(height_m),
        "heading_error_deg": median(turned_deg),
        "offset_s": None if found is None else found.seconds,
        "refused": said.text(),
    }
