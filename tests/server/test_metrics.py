"""Vehicles are told apart in the metrics only when asked, and no peer can add label values."""

import ast
from collections.abc import Callable
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import pytest
from prometheus_client import CollectorRegistry

import mec_server
from mec_server import connections
from mec_server.decoding.process import LossCause
from mec_server.ledger.budgets import Limit, Resource
from mec_server.metrics import STAGES, BackgroundTask, OpeningResult, ServerMetrics
from mec_server.twin.metrics import ConsumerEnd, TwinMetrics
from mec_server.twin.state import Twin
from rfcore.codec.h264.config import REFERENCE_FRAMES
from rfcore.codec.references import Reference, references_name
from rfcore.errors import RejectReason
from rfcore.field.interface import KINDS
from rfcore.wire.messages import Ack, Frame, FrameAddress, Nack, StageTimes
from rfcore.wire.notices import NOTICE_KINDS
from rfcore.wire.tiles import Tile, TileLight
from rfcore.wire.twin import PictureEncoding

ADDRESS = FrameAddress("front", 0, 0)


@pytest.fixture
def registry() -> CollectorRegistry:
    return CollectorRegistry()


def vehicles(registry: CollectorRegistry) -> set[str]:
    return {
        sample.labels["vehicle"]
        for family in registry.collect()
        for sample in family.samples
        if "vehicle" in sample.labels
    }


def drive(metrics: ServerMetrics, vehicle_id: str, frame: Frame) -> None:
    stream = metrics.of(vehicle_id)
    stream.received(frame, 500)
    stream.answered([Ack(ADDRESS, StageTimes(10**6, 10**7), b"d" * 16)])
    stream.answered([Nack(ADDRESS, RejectReason.SEQUENCE_GAP, "never arrived", count=3)])
    assert stream.reconstructed(0, 50_000_000, 0.01) == 0.05
    assert stream.reconstructed(0, 61 * 10**9, 0.01) == 0.01, "an implausible clock"


def test_without_the_flag_no_series_names_a_vehicle(
    registry: CollectorRegistry, make_frame: object
) -> None:
    drive(ServerMetrics(registry), "cav-1", make_frame(0))  # type: ignore[operator]
    assert vehicles(registry) == set()
    lost = {"result": "nacked", "reason": "sequence_gap"}
    assert registry.get_sample_value("rfedge_server_frames_total", lost) == 3
    assert registry.get_sample_value("rfedge_server_received_bytes_total") == 500


def test_with_the_flag_a_vehicles_series_leave_with_its_last_stream(
    registry: CollectorRegistry, make_frame: object
) -> None:
    metrics = ServerMetrics(registry, per_vehicle=True)
    for name in ("cav-1", "cav-1", "cav-2"):
        drive(metrics, name, make_frame(0))  # type: ignore[operator]
    assert vehicles(registry) == {"cav-1", "cav-2"}
    metrics.forget("cav-1")
    assert vehicles(registry) == {"cav-1", "cav-2"}, "its other stream lives"
    metrics.forget("cav-1")
    assert vehicles(registry) == {"cav-2"}


def test_pictures_are_counted_for_the_tile_that_publishes_their_field_or_did_before(
    registry: CollectorRegistry,
) -> None:
    def tile(field_id: str, *lights: str) -> Tile:
        of_lights = tuple(TileLight(name, name * 64, 1) for name in lights)
        return Tile("street", field_id * 64, lights=of_lights)

    def counted(name: str) -> tuple[float | None, float | None]:
        families = ("rfedge_server_tile_pictures_total", "rfedge_server_tile_payload_bytes_total")
        payload, pictures = (
            registry.get_sample_value(family, {"tile": name}) for family in families[::-1]
        )
        return pictures, payload

    metrics = ServerMetrics(registry)
    metrics.show_tiles([tile("a", "d")])
    metrics.count_picture("a" * 64, 100)
    metrics.count_picture("d" * 64, 20)
    metrics.count_picture("f" * 64, 3)
    assert counted("street") == (2, 120)
    assert counted("") == (1, 3)
    metrics.show_tiles([tile("b")])
    metrics.count_picture("a" * 64, 100)
    metrics.count_picture("b" * 64, 10)
    assert counted("street") == (4, 230)
    metrics.show_tiles([tile("c")])
    metrics.count_picture("a" * 64, 100)
    assert counted("street") == (4, 230), "two publications ago"
    assert counted("") == (2, 103)


REFERENCES = [
    order for count in range(REFERENCE_FRAMES + 1) for order in permutations(Reference, count)
]
CLOSED = {
    "result": {"acked", "nacked", "taken", "refused", *OpeningResult},
    "reason": {"", "lost", "full", *RejectReason, *ConsumerEnd},
    "references": set(map(references_name, REFERENCES)),
    "stage": set(STAGES),
    "limit": set(Limit),
    "cause": set(LossCause),
    "encoding": set(PictureEncoding),
    "kind": {*KINDS, *NOTICE_KINDS},
    "task": set(BackgroundTask),
    "resource": set(Resource),
}
"""The values that each label can have."""

OWN = {"field", "tile", "version", "renderer_contract", "python", "device", "driver", "build"}
"""Labels whose values the operator decides on, with what is installed and served."""


def both(registry: CollectorRegistry) -> ServerMetrics:
    """Return the server's metrics, with the twin's on the same registry."""
    metrics = ServerMetrics(registry)
    TwinMetrics(metrics.instruments, Twin())
    return metrics


def test_every_label_of_the_server_is_a_closed_set_or_the_operators_own(
    registry: CollectorRegistry,
) -> None:
    families = both(registry).instruments.families
    assert {label for family in families for label in family.labels} <= set(CLOSED) | OWN


def test_whatever_frames_and_answers_hold_label_values_stay_within_their_sets(
    registry: CollectorRegistry, make_frame: Callable[..., Frame]
) -> None:
    metrics = both(registry)
    stream = metrics.of("cav-1")
    for number, references in enumerate(REFERENCES):
        frame = make_frame(number)
        stream.received(replace(frame, packet=_predicted(frame, references)), 500)
    for reason in RejectReason:
        problem = f"no answer to frame {reason} within 1.4 s"
        stream.answered([Nack(ADDRESS, reason, problem)])
    stream.answered([Ack(ADDRESS, StageTimes(), b"d" * 16)])
    seen = {
        (name, value)
        for family in registry.collect()
        for sample in family.samples
        for name, value in sample.labels.items()
        if name not in {"le", *OWN}
    }
    assert seen <= {(name, str(value)) for name, values in CLOSED.items() for value in values}
    assert {value for name, value in seen if name == "references"} == CLOSED["references"]


def _predicted(frame: Frame, references: tuple[Reference, ...]) -> object:
    base = b"" if set(references) <= {Reference.RENDER} else b"b" * 6
    return replace(frame.packet, references=references, base_digest=base)


COUNTED_AGAIN = {"error.limit", "end.error.limit"}
"""Metrics that count the limit of an error that was raised elsewhere."""


def test_every_limit_the_server_raises_is_one_of_the_enumeration() -> None:
    """``limit`` is counted as a label; a text made on the spot would be a new series each time."""
    raised = [
        ast.unparse(call.args[0])
        for path in Path(mec_server.__path__[0]).rglob("*.py")
        for call in ast.walk(ast.parse(path.read_text()))
        if isinstance(call, ast.Call)
        and ast.unparse(call.func).endswith(("LimitExceeded", "count_limited"))
    ]
    composed = "Limit(f'{scope}_{resource}')"
    assert composed in raised, "the ledger makes its limits of two enumerations"
    named = {name.removeprefix("Limit.") for name in raised if name.startswith("Limit.")}
    assert set(raised) - {f"Limit.{name}" for name in named} <= {composed, "limit", *COUNTED_AGAIN}
    cuts = ast.walk(ast.parse(Path(connections.__file__).read_text()))
    of_connections = {
        node.attr
        for node in cuts
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "Limit"
    }
    of_ledger = {
        f"{scope}_{resource}".upper() for scope in ("identity", "server") for resource in Resource
    }
    assert named | of_connections | of_ledger == {limit.name for limit in Limit}
