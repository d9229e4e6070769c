"""A consumer of the twin: python examples/twin_consumer.py HOST:PORT

Prints each picture that a server reconstructs, the newest of each camera first.
"""

import sys

import grpc

from rfcore.image import I420
from rfcore.native.yuv import rgb_from_i420
from rfcore.wire.conventions import CONSUMER_OPTIONS
from rfcore.wire.twin import (
    Departure,
    PictureEncoding,
    Subscription,
    subscription_to_wire,
    twin_message_from_wire,
)
from rfcore.wire.v1 import twin_pb2_grpc


def main(address):
    """Print until the server ends the stream."""
    asked = subscription_to_wire(Subscription(encoding=PictureEncoding.I420))
    with grpc.insecure_channel(address, options=CONSUMER_OPTIONS) as channel:
        for response in twin_pb2_grpc.TwinServiceStub(channel).Watch(asked):
            message = twin_message_from_wire(response)
            if isinstance(message, Departure):
                print(f"{message.vehicle_id}/{message.camera_id} left", flush=True)
                continue
            size_px = (message.intrinsics.width_px, message.intrinsics.height_px)
            rgb = rgb_from_i420(I420.unpacked(size_px, message.picture))  # uint8 [H, W, 3]
            where = "lost" if message.pose is None else message.pose.translation_m
            who = f"{message.vehicle_id}/{message.camera_id} {message.sequence}"
            print(f"{who}: at {where}, mean level {rgb.mean():.0f}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
