"""Drive through a street with the vehicles that were recorded there, or that are there now.

python examples/drive_in_the_twin.py samples/fields/street.rff \
    samples/street/transforms_drive_vehicles.json --seconds 60 --out drive.mp4
python examples/drive_in_the_twin.py --server 127.0.0.1:50051 --tile west --start 0,-2,1.6,0

The driver keeps to where the recording's camera went: it steers towards the point ahead.
"""

import argparse
import hashlib
import math
from contextlib import ExitStack
from pathlib import Path

import grpc

from rfcore.camera import Intrinsics
from rfcore.dataset import read_dataset
from rfcore.field import load_field
from rfcore.wire.conventions import CONSUMER_OPTIONS
from rfedge.twin.simulation import (
    Place,
    RecordedStreet,
    ServedStreet,
    TwinDrive,
    place_of,
    steering_towards,
)


def recorded(field_path, datasets):
    """Return the street, where to begin, and the way of its first camera."""
    field = load_field(Path(field_path))
    if Path(datasets[0]).is_dir():
        street = RecordedStreet.of_recording(field, Path(datasets[0]))
    else:
        street = RecordedStreet(field, [read_dataset(Path(path)).pictures for path in datasets])
    poses = [picture.camera.world_from_cam for picture in street.cameras[0]]
    way = [pose.translation_m[:2] for pose in poses]
    return street, place_of(poses[0]), way


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("field", nargs="?", help="field archive (.rff), for a recording")
    parser.add_argument(
        "recording",
        nargs="*",
        help="a dataset for each recorded camera, or the folder of mec-server --record",
    )
    parser.add_argument("--server", help="HOST:PORT of a mec-server, instead of a recording")
    parser.add_argument("--tile", default="", help="tile of the server")
    parser.add_argument("--start", help="x,y,z,heading: metres and degrees")
    parser.add_argument("--size", default="640x360", help="of the picture")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--out", type=Path, help="an MP4 to write")
    asked = parser.parse_args()
    width, height = map(int, asked.size.split("x"))
    intrinsics = Intrinsics(width, height, width / 2, width / 2, width / 2, height / 2)
    with ExitStack() as stack:
        if asked.server:
            channel = grpc.insecure_channel(asked.server, options=CONSUMER_OPTIONS)
            street = stack.enter_context(ServedStreet(stack.enter_context(channel), asked.tile))
            place, way = None, []
        elif asked.recording:
            street, place, way = recorded(asked.field, asked.recording)
        else:
            parser.error("give a field and a recording, or --server")
        if asked.start:
            *at_m, heading_deg = map(float, asked.start.split(","))
            place = Place(*at_m, heading_rad=math.radians(heading_deg))
        if place is None:
            parser.error("--server needs --start")
        drive(TwinDrive(street, intrinsics), place, way, asked)


def drive(car, place, way, asked):
    """Drive on until the time is over or the field ends; begin again there."""
    frames, driven_m, steps = [], 0.0, round(asked.seconds * 10)
    all_seen = hashlib.sha256()
    seen = car.reset(place)
    for step in range(steps):
        before = seen.place
        throttle = 0.5 if before.speed_mps < 5 else 0.0
        seen = car.step(steering_towards(before, way), throttle)
        all_seen.update(seen.digest())
        driven_m += math.dist((before.x_m, before.y_m), (seen.place.x_m, seen.place.y_m))
        if asked.out:
            frames.append(seen.picture)
        if seen.ended:
            seen = car.reset(place)
        if step % 10 == 9:
            print(f"{(step + 1) / 10:5.1f} s  {driven_m:6.1f} m  {seen.live.mean():4.0%} live  "
                  f"{len(seen.objects)} objects", flush=True)  # fmt: skip
    if asked.out:
        from rfedge.video import write_mp4

        write_mp4(asked.out, frames, 10)
    print(f"SHA-256 of pictures, depths and objects: {all_seen.hexdigest()}")
    return driven_m


if __name__ == "__main__":
    main()
