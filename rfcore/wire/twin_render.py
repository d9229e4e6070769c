"""Messages of ``TwinService.Render`` and ``Objects``: the street as it is now.

What comes from a peer is checked here, as in ``rfcore.wire.twin``.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, TileOrigin
from rfcore.errors import InvalidInput, ProtocolError
from rfcore.field.quality import FULL, Quality
from rfcore.image import Rgb
from rfcore.perception.objects import CameraKey, StreetObject
from rfcore.wire.twin import (
    PictureEncoding,
    decoded_picture,
    encoding_from_wire,
    encoding_to_wire,
)
from rfcore.wire.v1 import twin_pb2 as pb
from rfcore.wire.values import (
    check_bytes,
    check_field_id,
    check_label,
    check_name,
    check_range,
    intrinsics_from_wire,
    intrinsics_to_wire,
    motion_from_wire,
    motion_to_wire,
    pose_from_wire,
    pose_to_wire,
    quality_from_wire,
    quality_to_wire,
    same_named,
)

MAX_VIEW_PX: Final = 1920 * 1088
LEAST_SIDE_PX: Final = 16
LEAST_FOCAL, MOST_FOCAL = 0.1, 20.0
"""Focal lengths in widths and heights of the picture: 157 degrees to 2.9 degrees."""
DEFAULT_AGE_S: Final = 2.0
MAX_AGE_S: Final = 10.0
"""Longest age of a picture that still confirms pixels."""
NO_AGE: Final = 65535
"""Value of ``RenderResponse.age_ms`` where no live picture confirms the pixel."""
MOST_PLACE_M: Final = 1e8
"""Limit of world coordinates: more than the equator's length."""

Vec3 = tuple[float, float, float]


@dataclass(frozen=True)
class ViewRequest:
    """A viewpoint in a published ``tile``, in a field by its id, or at a ``place`` of the world.

    Exactly one of the three is given. ``camera`` is relative to the origin of the tile, or to the
    place. Pictures older than ``max_age_s`` are not used. ``time_ns`` is the moment to show, by the
    server's clock; 0 stands for now. Raises ``InvalidInput`` for a camera beyond the limits.
    """

    camera: Camera
    tile: str = ""
    field_id: str = ""
    quality: Quality = FULL
    encoding: PictureEncoding = PictureEncoding.JPEG
    max_age_s: float = DEFAULT_AGE_S
    number: int = 0
    place: TileOrigin | None = None
    time_ns: int = 0

    def __post_init__(self) -> None:
        _check_place(self.tile, self.field_id, self.place)
        check_range("time_ns", self.time_ns, 0, 2**63 - 1)
        check_range("max_age_ms", 1e3 * self.max_age_s, 1, 1e3 * MAX_AGE_S)
        _check_camera(self.camera.intrinsics)


@dataclass(frozen=True)
class LiveCamera:
    """A live camera that took part in a view.

    ``share`` is that of the view's pixels that it confirms; an ``outvoted`` camera disagrees with
    the field nearly everywhere.
    """

    vehicle_id: str
    camera_id: str
    age_s: float
    share: float
    outvoted: bool


@dataclass(frozen=True, eq=False)
class RenderedView:
    """A view as it was composed.

    ``rgb`` is uint8 [H, W, 3], None where the picture was not asked for; ``picture`` is the same in
    ``encoding``. ``depth`` of the field is float32 [H, W] in metres, 0 where nothing is hit.
    ``age_ms`` is uint16 [H, W], ``NO_AGE`` where no live picture confirms the pixel.
    """

    number: int
    time_ns: int
    field_id: str
    encoding: PictureEncoding
    picture: bytes
    depth: NDArray[np.float32]
    age_ms: NDArray[np.uint16]
    cameras: tuple[LiveCamera, ...]
    skipped: int = 0

    @property
    def rgb(self) -> Rgb | None:
        """The picture."""
        height, width = self.depth.shape
        if self.encoding is PictureEncoding.NONE:
            return None
        return decoded_picture(self.encoding, (width, height), self.picture)

    @property
    def live(self) -> NDArray[np.bool_]:
        """Pixels that a live picture confirms, [H, W]."""
        return np.asarray(self.age_ms != NO_AGE)


@dataclass(frozen=True)
class ObjectsRequest:
    """A request for the objects of a published ``tile``, of a field, or at a ``place`` of the
    world.

    Exactly one of the three is given; objects are relative to the place if it is.
    """

    tile: str = ""
    field_id: str = ""
    place: TileOrigin | None = None

    def __post_init__(self) -> None:
        _check_place(self.tile, self.field_id, self.place)


@dataclass(frozen=True)
class ObjectsSeen:
    """The objects of one moment."""

    time_ns: int
    field_id: str
    objects: tuple[StreetObject, ...]


def view_request_to_wire(request: ViewRequest) -> pb.RenderRequest:
    """Return a request as protobuf."""
    return pb.RenderRequest(
        tile=request.tile,
        field_id=request.field_id,
        pose=pose_to_wire(request.camera.world_from_cam),
        intrinsics=intrinsics_to_wire(request.camera.intrinsics),
        quality=quality_to_wire(request.quality),
        encoding=encoding_to_wire(request.encoding),
        max_age_ms=round(1e3 * request.max_age_s),
        number=request.number,
        place=_place_to_wire(request.place),
        time_ns=request.time_ns,
    )


def view_request_from_wire(request: pb.RenderRequest) -> ViewRequest:
    """Return what a consumer asks for; raise ``InvalidInput`` for a value outside its limits."""
    if not (request.HasField("pose") and request.HasField("intrinsics")):
        raise InvalidInput("pose", "a view needs a pose and intrinsics")
    intrinsics = intrinsics_from_wire(request.intrinsics)
    jpeg = request.encoding == pb.PICTURE_ENCODING_UNSPECIFIED
    return ViewRequest(
        Camera(intrinsics, pose_from_wire(request.pose)),
        request.tile,
        request.field_id,
        quality_from_wire(request.quality) if request.HasField("quality") else FULL,
        PictureEncoding.JPEG if jpeg else encoding_from_wire(request.encoding),
        (request.max_age_ms / 1e3) or DEFAULT_AGE_S,
        request.number,
        _place_from_wire(request),
        request.time_ns,
    )


def rendered_view_to_wire(view: RenderedView) -> pb.RenderResponse:
    """Return an answer as protobuf."""
    return pb.RenderResponse(
        number=view.number,
        skipped=view.skipped,
        time_ns=view.time_ns,
        field_id=view.field_id,
        encoding=encoding_to_wire(view.encoding),
        picture=view.picture,
        depth_m=view.depth.astype("<f4").tobytes(),
        age_ms=view.age_ms.astype("<u2").tobytes(),
        cameras=[_live_camera_to_wire(camera) for camera in view.cameras],
    )


def rendered_view_from_wire(response: pb.RenderResponse, intrinsics: Intrinsics) -> RenderedView:
    """Return a server's answer to a request for a view of ``intrinsics``; raise ``ProtocolError``
    for one no server of ours would send."""
    shape = (intrinsics.height_px, intrinsics.width_px)
    pixels = intrinsics.height_px * intrinsics.width_px
    try:
        depth_m = check_bytes("depth_m", response.depth_m, 4 * pixels, 4 * pixels)
        age_ms = check_bytes("age_ms", response.age_ms, 2 * pixels, 2 * pixels)
        return RenderedView(
            response.number,
            response.time_ns,
            check_field_id("field_id", response.field_id),
            encoding_from_wire(response.encoding),
            response.picture,
            np.frombuffer(depth_m, "<f4").reshape(shape),
            np.frombuffer(age_ms, "<u2").reshape(shape),
            tuple(_live_camera(camera) for camera in response.cameras),
            response.skipped,
        )
    except InvalidInput as error:
        raise ProtocolError(f"the server sent an impossible view: {error}") from error


def _live_camera_to_wire(camera: LiveCamera) -> pb.LiveCamera:
    values = vars(camera).copy()
    return pb.LiveCamera(age_ms=round(1e3 * values.pop("age_s")), **values)


def _live_camera(camera: pb.LiveCamera) -> LiveCamera:
    return same_named(
        LiveCamera,
        camera,
        vehicle_id=check_name("camera.vehicle_id", camera.vehicle_id),
        camera_id=check_name("camera.camera_id", camera.camera_id),
        age_s=camera.age_ms / 1e3,
        share=check_range("camera.share", camera.share, 0.0, 1.0),
    )


def objects_request_to_wire(request: ObjectsRequest) -> pb.ObjectsRequest:
    """Return a request as protobuf."""
    place = _place_to_wire(request.place)
    return pb.ObjectsRequest(tile=request.tile, field_id=request.field_id, place=place)


def objects_request_from_wire(request: pb.ObjectsRequest) -> ObjectsRequest:
    """Return what a consumer asks for; raise ``InvalidInput``."""
    return ObjectsRequest(request.tile, request.field_id, _place_from_wire(request))


def objects_to_wire(seen: ObjectsSeen) -> pb.ObjectsResponse:
    """Return the objects of one moment as protobuf."""
    return pb.ObjectsResponse(
        time_ns=seen.time_ns,
        field_id=seen.field_id,
        objects=[_object_to_wire(each) for each in seen.objects],
    )


def objects_from_wire(response: pb.ObjectsResponse) -> ObjectsSeen:
    """Return a server's answer; raise ``ProtocolError`` for one no server of ours would send."""
    try:
        return ObjectsSeen(
            response.time_ns,
            check_field_id("field_id", response.field_id),
            tuple(_object_from_wire(each) for each in response.objects),
        )
    except InvalidInput as error:
        raise ProtocolError(f"the server sent an impossible object: {error}") from error


def _object_to_wire(each: StreetObject) -> pb.StreetObject:
    return pb.StreetObject(
        object_id=each.object_id,
        **motion_to_wire(each.at_m, each.velocity_mps),
        width_m=each.width_m,
        height_m=each.height_m,
        confidence=each.confidence,
        age_ms=round(1e3 * each.age_s),
        unseen_ms=round(1e3 * each.unseen_s),
        seen_by=[pb.Sighting(vehicle_id=v, camera_id=c) for v, c in each.seen_by],
        doubtful=each.is_doubtful,
        label=each.label,
    )


def _object_from_wire(each: pb.StreetObject) -> StreetObject:
    at_m, velocity_mps = motion_from_wire(each)
    for size_m in (each.width_m, each.height_m):
        check_range("object", size_m, -1e9, 1e9)
    return same_named(
        StreetObject,
        each,
        at_m=at_m,
        velocity_mps=velocity_mps,
        confidence=check_range("object.confidence", each.confidence, 0.0, 1.0),
        age_s=each.age_ms / 1e3,
        unseen_s=each.unseen_ms / 1e3,
        seen_by=tuple(_camera_key(sighting) for sighting in each.seen_by),
        is_doubtful=each.doubtful,
        label=check_label("object.label", each.label),
    )


def _camera_key(sighting: pb.Sighting) -> CameraKey:
    return (
        check_name("seen_by.vehicle_id", sighting.vehicle_id),
        check_name("seen_by.camera_id", sighting.camera_id),
    )


def _place_to_wire(place: TileOrigin | None) -> pb.WorldPlace | None:
    if place is None:
        return None
    return pb.WorldPlace(east_m=place.east_m, north_m=place.north_m, up_m=place.up_m)


def _place_from_wire(request: pb.RenderRequest | pb.ObjectsRequest) -> TileOrigin | None:
    if not request.HasField("place"):
        return None
    return TileOrigin(request.place.east_m, request.place.north_m, request.place.up_m)


def _check_place(tile: str, field_id: str, place: TileOrigin | None) -> None:
    if bool(tile) + bool(field_id) + (place is not None) != 1:
        raise InvalidInput("tile", "name either a published tile, a field_id or a place")
    if tile:
        check_name("tile", tile)
    elif field_id:
        check_field_id("field_id", field_id)
    elif place is not None:
        for name, value in asdict(place).items():
            check_range(f"place.{name}", value, -MOST_PLACE_M, MOST_PLACE_M)


def _check_camera(k: Intrinsics) -> None:
    for name, side in (("width_px", k.width_px), ("height_px", k.height_px)):
        if side < LEAST_SIDE_PX:
            raise InvalidInput(f"intrinsics.{name}", f"{side} px is below {LEAST_SIDE_PX} px")
    if k.width_px * k.height_px > MAX_VIEW_PX:
        raise InvalidInput(
            "intrinsics",
            f"{k.width_px} x {k.height_px} are more than {MAX_VIEW_PX} pixels; ask for fewer",
        )
    for name, focal_px, side in (("fx_px", k.fx_px, k.width_px), ("fy_px", k.fy_px, k.height_px)):
        check_range(f"intrinsics.{name}", focal_px, LEAST_FOCAL * side, MOST_FOCAL * side)
    for name, centre_px, side in (("cx_px", k.cx_px, k.width_px), ("cy_px", k.cy_px, k.height_px)):
        check_range(f"intrinsics.{name}", centre_px, -1.0 * side, 2.0 * side)
