"""A server without NATS does without; with one that is away it keeps little and goes on."""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from prometheus_client import CollectorRegistry

from mec_server.config import NatsSettings, ServerConfig
from mec_server.metrics import ServerMetrics
from mec_server.nats import NatsLink
from mec_server.twin.metrics import TwinMetrics
from mec_server.twin.nats import TwinPublisher
from mec_server.twin.service import PictureEncoder
from mec_server.twin.state import ReceivedPicture, Twin
from rfcore.camera import Intrinsics
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.wire.messages import Frame
from rfcore.wire.nats import NatsServers

NOWHERE = NatsServers(("nats://127.0.0.1:1",))
PICTURE = I420(*(np.zeros(size, np.uint8) for size in ((2, 2), (1, 1), (1, 1))))
DROPPED = "rfedge_twin_nats_dropped_total"


def test_without_nats_its_package_is_not_imported() -> None:
    modules = "mec_server.__main__, rfedge.cli, rfedge.twin.server_source, rfedge.watch"
    code = f"import sys, {modules}; print('nats' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


async def test_while_nats_is_away_one_picture_a_camera_waits_and_the_others_are_counted(
    make_frame: Callable[..., Frame],
) -> None:
    registry, twin, pictures = CollectorRegistry(), Twin(), PictureEncoder()
    metrics = TwinMetrics(ServerMetrics(registry).instruments, Twin())
    TwinPublisher(NatsLink(NOWHERE, "test"), "east", twin, pictures, tuple, metrics)
    for sequence in range(100):
        for vehicle in ("cav-1", "cav-2"):
            frame = replace(make_frame(sequence), capture_time_ns=sequence)
            k = Intrinsics(2, 2, 1.0, 1.0, 1.0, 1.0)
            twin.show(
                ReceivedPicture(vehicle, "s", frame, k, "ab" * 32, PICTURE, b"d" * 16, 10.0, 0.2)
            )
    twin.leave("s")
    pictures.close()
    (mailbox,) = twin._mailboxes
    assert len(mailbox) == 4, "the newest picture and the departure of each"
    assert registry.get_sample_value(DROPPED) == 2 * 99
    assert twin.missed == 0, "no consumer of the server's own missed anything"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (NatsSettings("http://here"), "nats: 'http://here' must be nats://HOST:PORT"),
        (NatsSettings("nats://nats.example"), "give --allow-insecure"),
        (NatsSettings("nats://127.0.0.1", login=Path("/nonexistent")), "nats-login: /nonexistent"),
    ],
)
def test_a_servers_bad_nats_is_refused_before_it_starts(
    given: NatsSettings, said: str, tmp_path: Path
) -> None:
    with pytest.raises(InvalidInput, match=said):
        ServerConfig(tmp_path, nats=given)


@pytest.mark.parametrize(
    ("options", "said"),
    [({"name": "east"}, "for nothing without it"), ({"urls": "x", "name": "a b"}, "nats-name")],
)
def test_options_that_mean_nothing_are_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(InvalidInput, match=said):
        NatsSettings(**options)
