"""``rfedge-lab feed``: a dataset's poses as the feed of a vehicle that drove it, with errors.

Positions are those of the camera, or of an antenna where a lever arm is given, with the errors of
``lab.localisation.pose_errors``. NMEA states GGA, RMC, GST and HDT a fix, as a receiver with two
antennas; it knows no pitch and no roll. Deterministic by seed.
"""

from __future__ import annotations

import json
import math
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import reduce
from itertools import pairwise
from pathlib import Path
from time import monotonic, sleep, time
from typing import Annotated, Literal

import numpy as np
from tyro.conf import Positional, arg

from cav_agent.pose_feed import CameraMount, parse_source
from lab.localisation.pose_errors import PoseErrorModel, observed, parse_error_model
from rfcore.camera import Pose, TileOrigin
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from rfcore.files import write_whole
from rfcore.geodesy import Anchor
from rfcore.views import PosedPicture
from rfedge.arguments import DATASET, FIELD, open_field
from rfedge.located import Observation

FeedForm = Literal["nmea", "geodetic", "xyz"]
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
KNOTS = 3600 / 1852


@dataclass(frozen=True)
class FeedPlan:
    """Settings of a feed. ``start_s``: Unix time of the first picture; ``anchor``: of the tile."""

    form: FeedForm
    errors: PoseErrorModel
    start_s: float
    seed: int = 1
    anchor: Anchor | None = None
    origin: TileOrigin = TileOrigin()
    mount: CameraMount = CameraMount()

    def __post_init__(self) -> None:
        if self.form != "xyz" and self.anchor is None:
            raise InvalidInput("anchor", "latitude and longitude need one; or take --form xyz")
        if not (math.isfinite(self.start_s) and 0 <= self.start_s < 18e9):
            raise InvalidInput("start_s", f"{self.start_s} is outside 0..18e9 s")


def times_of(pictures: Sequence[PosedPicture], rate_hz: float) -> list[float]:
    """Return the pictures' times, s after the first; at ``rate_hz`` where they have none."""
    times_s = [(picture.time_ns - pictures[0].time_ns) / 1e9 for picture in pictures]
    if all(a < b for a, b in pairwise(times_s)) and times_s[1:]:
        return times_s
    return [n / rate_hz for n in range(len(pictures))]


def feed_lines(
    poses: Sequence[Pose], times_s: Sequence[float], plan: FeedPlan
) -> list[tuple[float, str]]:
    """Return the text of each fix, and when it is handed over, s after the first picture."""
    since_s = [time_s - times_s[0] for time_s in times_s]
    observations = observed(since_s, poses, plan.errors, np.random.default_rng(plan.seed))
    write = {"nmea": _nmea, "geodetic": _geodetic, "xyz": _xyz}[plan.form]
    return [(o.known_s, write(o, plan)) for o in observations]


def _vehicle(observation: Observation, plan: FeedPlan) -> Pose:
    """Return the pose of the vehicle that carries the camera observed, in the tile's axes."""
    return observation.world_from_cam.compose(plan.mount.vehicle_from_cam.inverse())


def _enu_from_vehicle(vehicle: Pose, anchor: Anchor) -> Pose:
    turn = Pose((0.0, 0.0, 0.0), anchor.enu_from_world)
    return turn.compose(Pose((0.0, 0.0, 0.0), vehicle.rotation))


def _xyz(observation: Observation, plan: FeedPlan) -> str:
    vehicle = plan.origin.globalise(_vehicle(observation, plan))
    x, y, z = vehicle.translation_m
    place = {"x_m": round(x, 4), "y_m": round(y, 4), "z_m": round(z, 4)}
    return _json(observation, plan, place, vehicle.rotation)


def _geodetic(observation: Observation, plan: FeedPlan) -> str:
    assert plan.anchor is not None
    vehicle = _vehicle(observation, plan)
    latitude, longitude, height = plan.anchor.geodetic_from_world(vehicle.translation_m)
    place = {
        "latitude_deg": round(latitude, 9),
        "longitude_deg": round(longitude, 9),
        "height_m": round(height, 4),
    }
    return _json(observation, plan, place, _enu_from_vehicle(vehicle, plan.anchor).rotation)


def _json(
    observation: Observation,
    plan: FeedPlan,
    place: dict[str, float],
    rotation: tuple[float, float, float, float],
) -> str:
    variance = observation.position_sd_m**2
    values = {
        "time_s": round(plan.start_s + observation.taken_s, 6),
        **place,
        "quaternion": [round(value, 9) for value in rotation],
        "covariance_m2": [round(variance, 6)] * 3,
        "rotation_std_deg": round(observation.rotation_sd_deg, 4),
    }
    return json.dumps(values) + "\n"


def _nmea(observation: Observation, plan: FeedPlan) -> str:
    assert plan.anchor is not None
    vehicle = _vehicle(observation, plan)
    latitude, longitude, height_m = plan.anchor.geodetic_from_world(vehicle.translation_m)
    ahead = _enu_from_vehicle(vehicle, plan.anchor).apply((1.0, 0.0, 0.0))
    heading = math.degrees(math.atan2(ahead[0], ahead[1])) % 360.0
    moment = EPOCH + timedelta(seconds=round(plan.start_s + observation.taken_s, 3))
    clock = f"{moment:%H%M%S}.{moment.microsecond // 1000:03d}"
    place = f"{_degrees(latitude, 2, 'NS')},{_degrees(longitude, 3, 'EW')}"
    spread = f"{observation.position_sd_m:.3f}"
    return "".join(
        sentence(body)
        for body in (
            f"GNGST,{clock},,,,,{spread},{spread},{spread}",
            f"GNHDT,{heading:.3f},T",
            f"GNRMC,{clock},A,{place},0.0,{heading:.2f},{moment:%d%m%y},,",
            f"GNGGA,{clock},{place},1,12,1.0,{height_m:.4f},M,0.0,M,,",
        )
    )


def _degrees(value: float, digits: int, sides: str) -> str:
    """Return an angle as NMEA writes it, degrees and minutes in one number."""
    units = round(abs(value) * 60 * 10**7)
    whole, minutes = divmod(units, 60 * 10**7)
    return f"{whole:0{digits}d}{minutes / 10**7:010.7f},{sides[value < 0]}"


def sentence(body: str) -> str:
    """Return an NMEA sentence with its checksum, the exclusive or of its characters."""
    checksum = reduce(lambda sum_, character: sum_ ^ ord(character), body, 0)
    return f"${body}*{checksum:02X}\r\n"


@dataclass(frozen=True)
class MakeFeed:
    """Write a drive's poses as a vehicle's sensors would state them: NMEA or JSON, with errors."""

    drive: Annotated[Path, Positional, DATASET]
    """Posed pictures; their poses are the truth."""
    out: Annotated[str, arg(metavar="FILE|udp:HOST:PORT")]
    """The file to write, or where to send it to, line by line at its own pace."""
    field: Annotated[Path | None, FIELD] = None
    """The field whose anchor says where on the Earth the drive is; default: the dataset's own."""
    form: FeedForm = "nmea"
    """NMEA sentences, or JSON lines in WGS 84 or in the drive's own axes
    (docs/how-to/localise.md)."""
    errors: Annotated[str, arg(metavar="NAME,KEY=VALUE,...")] = "gnss"
    """exact, white-small, white-large, offset or gnss, and what to change of it:
    noise_m, noise_deg, offset_m, offset_deg, walk_m, walk_s, rate_hz, latency_s, silent_from_s,
    silent_s."""
    camera_at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The camera seen from the antenna: metres forward, left, up (cav-agent --camera-at)."""
    start_s: float | None = None
    """Unix time of the first picture; default: its time in the dataset, or now for udp."""
    rate: float = 10.0
    """Pictures a second, where the dataset has no times."""
    seed: int = 1
    """Seed of the errors."""

    def run(self) -> None:
        """Write the file, or send it."""
        errors = parse_error_model(self.errors)
        anchor, origin = None, TileOrigin()
        if self.field is not None:
            metadata = open_field(self.field, threads=1).metadata
            anchor, origin = metadata.anchor, metadata.tile_origin
        dataset = read_dataset(self.drive, tile_origin=origin if self.field else None)
        live = self.out.startswith("udp:")
        stated_s = dataset.pictures[0].time_ns / 1e9
        plan = FeedPlan(
            form=self.form,
            errors=errors,
            start_s=self.start_s if self.start_s is not None else time() if live else stated_s,
            seed=self.seed,
            anchor=anchor or dataset.anchor,
            origin=dataset.tile_origin,
            mount=CameraMount(self.camera_at),
        )
        poses = [picture.camera.world_from_cam for picture in dataset.pictures]
        lines = feed_lines(poses, times_of(dataset.pictures, self.rate), plan)
        if live:
            _send(lines, self.out)
        else:
            write_whole(Path(self.out), "".join(text for _, text in lines))
        print(f"{self.out}: {len(lines)} fixes")


def _send(lines: list[tuple[float, str]], target: str) -> None:
    """Send each text in a datagram when it is due."""
    source, begun_s = parse_source(target), monotonic()
    address = (source.host, source.port)
    family = socket.getaddrinfo(*address, type=socket.SOCK_DGRAM)[0][0]
    with socket.socket(family, socket.SOCK_DGRAM) as sender:
        for due_s, text in lines:
            sleep(max(0.0, begun_s + due_s - monotonic()))
            sender.sendto(text.encode("ascii"), address)
