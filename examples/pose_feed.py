"""A vehicle's own poses as a feed: python examples/pose_feed.py TRAJECTORY.txt feed.jsonl

TRAJECTORY is TUM's form, a line ``time_s x y z qx qy qz qw`` a pose: the vehicle's axes (x forward,
y left, z up) in the drives' metric frame. With udp:HOST:PORT instead of a file the lines are sent
at their own pace. Then: cav-agent ... --pose-feed file:feed.jsonl
"""

import json
import socket
import sys
import time
from pathlib import Path


def feed_lines(trajectory):
    """Yield (time_s, line): our own schema of JSON lines (docs/how-to/localise.md)."""
    for text in trajectory.read_text().splitlines():
        if text.strip() and not text.startswith("#"):
            time_s, x, y, z, qx, qy, qz, qw = map(float, text.split())
            fix = {
                "time_s": time_s,
                "x_m": x,
                "y_m": y,
                "z_m": z,
                "quaternion": [qw, qx, qy, qz],
                "covariance_m2": [0.01, 0.01, 0.04],  # 10 cm, 10 cm and 20 cm, squared
                "rotation_std_deg": 0.5,
            }
            yield time_s, json.dumps(fix) + "\n"


def send(lines, host, port, sleep=time.sleep):
    """Send each line as a datagram, stamped with the time it is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        before_s = None
        for time_s, line in lines:
            sleep(0.0 if before_s is None else time_s - before_s)
            before_s = time_s
            now = json.loads(line) | {"time_s": time.time()}
            sender.sendto((json.dumps(now) + "\n").encode(), (host, port))


def main(trajectory, out):
    """Write the feed to a file, or send it."""
    lines = feed_lines(Path(trajectory))
    if out.startswith("udp:"):
        host, port = out.removeprefix("udp:").rsplit(":", 1)
        send(lines, host, int(port))
    else:
        Path(out).write_text("".join(line for _, line in lines))


if __name__ == "__main__":
    main(*sys.argv[1:])
