"""Poses ahead of their frames that are lost, damaged or lie, while another vehicle drives on."""

import random
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from fault.conftest import FAULT_S
from fault.test_packets import SEED, decided, paced
from frames import flipped, message_of
from rfcore.wire.head import FrameWriter
from rfcore.wire.messages import Ack, Frame, Hello, Nack, Welcome

Sent = tuple[list[bytes], bytes, list[bytes]]
"""Messages before a frame, the frame, and messages after it."""


def both(hello: Hello, frame: Frame, said: Frame | None = None) -> tuple[bytes, bytes]:
    """Return a pose ahead and the frame after it; ``said``: the frame that the pose is of."""
    writer = FrameWriter(hello)
    return writer.ahead((said or frame).ahead, None), writer.message(frame, None)


def elsewhere(frame: Frame, frames: list[Frame]) -> Frame:
    """Return the frame at the pose of another one."""
    return replace(frame, pose=next(one.pose for one in frames if one.pose != frame.pose))


def lost(hello: Hello, frame: Frame, frames: list[Frame], rng: random.Random) -> Sent:  # noqa: ARG001
    """no pose, and its frame"""
    return [], both(hello, frame)[1], []


def damaged(hello: Hello, frame: Frame, frames: list[Frame], rng: random.Random) -> Sent:  # noqa: ARG001
    """one bit of each pose flipped"""
    ahead, data = both(hello, frame)
    return [flipped(ahead, rng.randrange(8 * (len(ahead) - 2)))], data, []


def repeated(hello: Hello, frame: Frame, frames: list[Frame], rng: random.Random) -> Sent:  # noqa: ARG001
    """each pose three times, and once more after its frame"""
    ahead, data = both(hello, frame)
    return [ahead] * 3, data, [ahead]


def never_followed(hello: Hello, frame: Frame, frames: list[Frame], rng: random.Random) -> Sent:  # noqa: ARG001
    """after each frame the pose of one that never comes"""
    packet = replace(frame.packet, sequence=frame.packet.sequence + 1)
    never = elsewhere(replace(frame, packet=packet), frames)
    return [], message_of(hello, frame), [both(hello, never)[0]]


def different(hello: Hello, frame: Frame, frames: list[Frame], rng: random.Random) -> Sent:  # noqa: ARG001
    """each pose that of another place than its frame's"""
    ahead, data = both(hello, frame, elsewhere(frame, frames))
    return [ahead], data, []


def late(hello: Hello, frame: Frame, frames: list[Frame], rng: random.Random) -> Sent:  # noqa: ARG001
    """each pose after its frame, which says all"""
    return [], message_of(hello, frame), [both(hello, frame)[0]]


@pytest.mark.parametrize(
    ("trick", "told", "covers"),
    [
        (lost, "unknown_state", "F11"),
        (damaged, "unknown_state", "F9"),
        (repeated, "ack", "F11"),
        (never_followed, "ack", "F23"),
        (different, "ack", "F13"),
        (late, "ack", "F11"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
async def test_poses_ahead(
    trick: Callable[..., Sent],
    told: str,
    covers: str,
    streaming: Any,
    case: Any,
    coded: Any,
    raw_vehicle: Any,
) -> None:
    server, bystander = streaming
    rng = random.Random(SEED)
    name = trick.__name__.replace("_", " ")
    case.about(f"poses ahead: {name}", f"{trick.__doc__}, seed {SEED}", covers)
    answers: Counter[str] = Counter()
    wrong = 0
    async with raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        await case.calm()
        began_s = time.monotonic()
        async for frame in paced(coded.frames, case.lasting(FAULT_S)):
            before, message, after = trick(coded.hello, frame, coded.frames, rng)
            for data in before:
                await vehicle.say(data)
            answer = await vehicle.ask(message)
            while isinstance(answer, Welcome):  # at another rate, as frames take longer here
                answer = await vehicle.hear()
            for data in after:
                await vehicle.say(data)
            answers[str(answer.reason) if isinstance(answer, Nack) else "ack"] += 1
            good = await decided(vehicle, frame) if isinstance(answer, Nack) else answer
            digest = frame.packet.reconstruction_digest
            wrong += not isinstance(good, Ack) or good.reconstruction_digest != digest
        lasted_s = time.monotonic() - began_s
        case.over()
    sent = answers.total()
    case.at_most("silently wrong or lost pictures", wrong, 0, f"of {sent}")
    case.holds(f"each frame told {told}", answers[told] >= 0.9 * sent > 0)
    refused = server.value("rfedge_server_poses_ahead_total", result="refused")
    expected = {"damaged": 1, "repeated": 3, "late": 1}.get(trick.__name__, 0)
    case.holds("metric counts the poses refused", refused >= expected * 0.9 * sent)
    spent = server.value("rfedge_server_spent_total", resource="worker_seconds")
    case.at_most("worker time of all vehicles", spent / lasted_s, 4.0, "workers")
    await case.spares(bystander)
    case.finish()
