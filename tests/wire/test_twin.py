"""Messages of consumers and servers survive the wire, and faults in them are named."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.references import Reference
from rfcore.errors import InvalidInput, ProtocolError
from rfcore.field.quality import FULL, Quality
from rfcore.localise.estimate import LocalisationState
from rfcore.wire.twin import (
    Departure,
    PictureEncoding,
    Subscription,
    TwinPicture,
    subscription_from_wire,
    subscription_to_wire,
    twin_message_from_wire,
    twin_message_to_wire,
)
from rfcore.wire.twin_render import (
    LiveCamera,
    ObjectsRequest,
    ObjectsSeen,
    RenderedView,
    StreetObject,
    ViewRequest,
    objects_from_wire,
    objects_request_from_wire,
    objects_request_to_wire,
    objects_to_wire,
    rendered_view_from_wire,
    rendered_view_to_wire,
    view_request_from_wire,
    view_request_to_wire,
)
from rfcore.wire.v1 import twin_pb2
from rfcore.wire.values import ClockKind

PICTURE = TwinPicture(
    "cav-1", "front", "s-1", 3, 7, 10**18, 5, Pose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0)),
    Intrinsics(4, 2, 1.0, 1.5, 2.0, 1.0), "ab" * 32, b"d" * 16, PictureEncoding.PNG, b"png", 9,
    4321, (Reference.WARP, Reference.RENDER), ClockKind.ARRIVAL, LocalisationState.TRACKING, 12,
)  # fmt: skip


@given(
    st.frozensets(st.from_regex(r"[a-z][a-z0-9._-]{0,20}", fullmatch=True), max_size=5),
    st.sampled_from(PictureEncoding),
)
def test_a_subscription_survives_the_wire(
    vehicles: frozenset[str], encoding: PictureEncoding
) -> None:
    subscription = Subscription(vehicles, encoding)
    assert subscription_from_wire(subscription_to_wire(subscription)) == subscription


@pytest.mark.parametrize("message", [PICTURE, Departure("cav-1", "front")])
def test_a_message_survives_the_wire(message: TwinPicture | Departure) -> None:
    sent = twin_message_to_wire(message).SerializeToString()
    assert twin_message_from_wire(twin_pb2.WatchResponse.FromString(sent)) == message


def test_a_subscription_without_an_encoding_gets_jpeg() -> None:
    assert subscription_from_wire(twin_pb2.WatchRequest()) == Subscription(
        frozenset(), PictureEncoding.JPEG
    )


def test_an_unknown_encoding_is_refused() -> None:
    with pytest.raises(InvalidInput, match="encoding: 99"):
        subscription_from_wire(twin_pb2.WatchRequest(encoding=99))  # type: ignore[arg-type]


def test_an_impossible_picture_is_the_servers_fault() -> None:
    bad = twin_message_to_wire(PICTURE)
    bad.picture.references.append(77)  # type: ignore[arg-type]
    with pytest.raises(ProtocolError, match=r"picture\.references: 77"):
        twin_message_from_wire(bad)
    bad = twin_message_to_wire(PICTURE)
    bad.picture.pose.x_m = float("nan")
    with pytest.raises(ProtocolError, match="impossible picture"):
        twin_message_from_wire(bad)
    with pytest.raises(ProtocolError, match="update it"):
        twin_message_from_wire(twin_pb2.WatchResponse())


VIEW = RenderedView(
    7, 10**18, "ab" * 32, PictureEncoding.NONE, b"", np.full((16, 32), 2.5, np.float32),
    np.full((16, 32), 120, np.uint16), (LiveCamera("cav-1", "front", 0.12, 0.5, False),), 3,
)  # fmt: skip
LENS = Intrinsics(32, 16, 20.0, 20.0, 16.0, 8.0)


@pytest.mark.parametrize("place", [{"tile": "west"}, {"field_id": "ab" * 32}])
@pytest.mark.parametrize("quality", [FULL, Quality(0.5, 1, None, 0.5)])
def test_a_request_for_a_view_survives_the_wire(place: dict[str, str], quality: Quality) -> None:
    camera = Camera(LENS, Pose((1.0, 2.0, 3.0), (0.0, 1.0, 0.0, 0.0)))
    asked = ViewRequest(
        camera, **place, quality=quality, encoding=PictureEncoding.PNG, max_age_s=0.5, number=9
    )
    sent = view_request_to_wire(asked).SerializeToString()
    assert view_request_from_wire(twin_pb2.RenderRequest.FromString(sent)) == asked


def test_a_view_survives_the_wire() -> None:
    sent = rendered_view_to_wire(VIEW).SerializeToString()
    got = rendered_view_from_wire(twin_pb2.RenderResponse.FromString(sent), LENS)
    assert np.array_equal(got.depth, VIEW.depth)
    assert np.array_equal(got.age_ms, VIEW.age_ms)
    assert got.rgb is None
    assert got.live.all()
    for name in ("number", "time_ns", "field_id", "encoding", "cameras"):
        assert getattr(got, name) == getattr(VIEW, name)


@pytest.mark.parametrize("change", [{"depth_m": b"1234"}, {"age_ms": b""}, {"field_id": "x"}])
def test_an_impossible_view_is_the_servers_fault(change: dict[str, object]) -> None:
    bad = rendered_view_to_wire(VIEW)
    for name, value in change.items():
        setattr(bad, name, value)
    with pytest.raises(ProtocolError, match="impossible view"):
        rendered_view_from_wire(bad, LENS)


def test_objects_survive_the_wire() -> None:
    thing = StreetObject(
        7, (1.0, 2.0, 3.0), (0.5, 0.0, -0.25), 1.8, 1.5, 0.75, 2.5, 0.1, (("cav-1", "front"),), True
    )
    seen = ObjectsSeen(10**18, "ab" * 32, (thing,))
    sent = objects_to_wire(seen).SerializeToString()
    assert objects_from_wire(twin_pb2.ObjectsResponse.FromString(sent)) == seen
    for asked in (ObjectsRequest(tile="west"), ObjectsRequest(field_id="ab" * 32)):
        assert objects_request_from_wire(objects_request_to_wire(asked)) == asked
    bad = objects_to_wire(seen)
    bad.objects[0].x_m = float("nan")
    with pytest.raises(ProtocolError, match="impossible object"):
        objects_from_wire(bad)
