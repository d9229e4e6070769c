"""A consumer of the twin: python examples/twin_consumer.py HOST:PORT

Prints each picture that a server reconstructs, the newest of each camera first.
"""

import sys

from rfcore.wire.twin import Departure, PictureEncoding, Subscription
from rfcore.wire.twin_client import TwinClient


def main(address):
    """Print until the server ends the stream."""
    with TwinClient(address) as twin:
        for message in twin.watch(Subscription(encoding=PictureEncoding.I420)):
            who = f"{message.vehicle_id}/{message.camera_id}"
            if isinstance(message, Departure):
                print(f"{who} left", flush=True)
                continue
            where = "lost" if message.pose is None else message.pose.translation_m
            level = message.rgb.mean()  # of uint8 [H, W, 3]
            print(f"{who} {message.sequence}: at {where}, mean level {level:.0f}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
