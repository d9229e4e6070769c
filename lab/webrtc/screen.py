"""Our screen, a process: ``python -m lab.webrtc.screen ADDRESS OUT`` reads a server's twin.

It takes pictures as planes, notes when it has each, and ends with the next line of its input.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from lab.twin_reader import TwinReader
from lab.webrtc.measure import ShownPictures
from rfcore.wire.twin import PictureEncoding, Subscription, TwinPicture


def main(address: str, out: str) -> None:
    shown = ShownPictures()

    def take(picture: TwinPicture) -> None:
        shown.take(time.time_ns(), picture.capture_time_ns, picture.planes.y)

    with TwinReader(address, take, Subscription(encoding=PictureEncoding.I420)) as reader:
        print("ready", flush=True)
        sys.stdin.readline()
    if reader.problem is not None:
        raise reader.problem
    shown.write(Path(out))


if __name__ == "__main__":
    main(*sys.argv[1:])
