"""``SensorsimService``: the renderer that AlpaSim and NuRec's clients ask for pictures.

The contract is that of AlpaSim (``proto/rfcore/wire/v1/sensorsim.proto``), under both names that
its package has had. A scene is a field of the twin, named as its tile or by its own name or id;
poses are world_from_camera in the tile's frame, camera axes OpenCV's.

Dynamic objects are drawn where the twin was given fields of them. Others are not, which is said
once, and to the client in the answer's trailing metadata. Lidar, ego masks, windshields and formats
other than PNG and JPEG are refused by name.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import grpc
import structlog

from rfcore.camera import Intrinsics, Pose
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.field import RadianceField, SplatField
from rfcore.image import Rgb, jpeg_bytes, png_bytes
from rfcore.views import PosedPicture
from rfcore.wire.address import Address
from rfcore.wire.conventions import SERVER_OPTIONS
from rfcore.wire.v1 import sensorsim_pb2 as wire
from rfedge.twin.lens_picture import LensModel, render_through
from rfedge.twin.placed_objects import PlacedObject, with_objects
from rfedge.twin.scene import PlacedField, TwinScene
from rfedge.twin.sensorsim_request import SHUTTERS, lens_model, pose_pair
from rfedge.twin.shutter import Motion, MovingBox, Shutter, lines_motion_px, render_rolling

log = structlog.get_logger()

SERVICES = tuple(f"{name}.grpc.protos.sensorsim.SensorsimService" for name in ("nre", "nurec"))
API_VERSION = (0, 54, 0)
"""The version of the contract that was read."""
MOST_WAITING = 16
"""Calls at once, and pictures of a call; more are refused."""
PNG_LEVEL = 1
"""zlib's level: 6, the default, takes five times as long for 12 % fewer bytes."""
NOT_DRAWN = "rfedge-not-drawn"
UNIMPLEMENTED, INVALID = grpc.StatusCode.UNIMPLEMENTED, grpc.StatusCode.INVALID_ARGUMENT
FORMATS = {wire.IMAGE_FORMAT_PNG: "PNG", wire.IMAGE_FORMAT_JPEG: "JPEG"}


class Refused(RfedgeError):
    """A request that is answered with a gRPC status of its own."""

    def __init__(self, code: grpc.StatusCode, text: str) -> None:
        super().__init__(text)
        self.code = code


@dataclass(frozen=True)
class RenderJob:
    """What a request asks for, checked."""

    field: RadianceField
    model: LensModel
    world_from_cam: Motion
    shutter: Shutter | None
    """None: all of the picture is seen at the middle of the exposure."""
    is_jpeg: bool
    quality: float
    objects: tuple[tuple[SplatField, Motion], ...] = ()
    """In a field of splats: shapes, and world_from_object."""

    def run(self) -> bytes:
        """Render and encode."""
        rgb = self.picture()
        return (
            jpeg_bytes(rgb, quantiser(self.quality)) if self.is_jpeg else png_bytes(rgb, PNG_LEVEL)
        )

    def picture(self) -> Rgb:
        """Render, uint8 [H, W, 3]."""
        if self.shutter is None:
            return render_through(self._field_at(0.5), self.model, self.world_from_cam.middle)
        boxes = [MovingBox(shape.bounds, motion) for shape, motion in self.objects]
        motion_px = lines_motion_px(
            self.field, self.model, self.world_from_cam, self.shutter, boxes
        )
        moving = any(motion.moves for _, motion in self.objects)
        still = None if moving else self._field_at(0.5)
        return render_rolling(
            lambda share: self._field_at(share) if still is None else still,
            self.model,
            self.world_from_cam,
            self.shutter,
            motion_px,
        )

    def _field_at(self, share: float) -> RadianceField:
        if not isinstance(self.field, SplatField):
            return self.field
        return with_objects(
            self.field, [PlacedObject(shape, motion.at(share)) for shape, motion in self.objects]
        )


class Sensorsim:
    """Answers simulators from the fields of ``scene``; ``drive`` offers its cameras and poses,
    ``shapes`` are the fields of dynamic objects by their ids."""

    def __init__(
        self,
        address: Address,
        scene: TwinScene,
        drive: Sequence[PosedPicture] = (),
        shapes: Mapping[str, SplatField] | None = None,
    ) -> None:
        if not address.is_loopback:
            raise InvalidInput(
                "sensorsim",
                f"{address} can be reached from other machines, and the contract has no "
                "encryption; give a loopback address, and a tunnel to it (ssh -L) from elsewhere",
            )
        self._address = address
        self._scene = scene
        self._drive = drive
        self._shapes = dict(shapes or {})
        self._executor = ThreadPoolExecutor(1, "sensorsim")
        self._server: grpc.aio.Server | None = None
        self._said: set[str] = set()

    async def start(self) -> Address:
        """Listen; return the address. Raises ``RfedgeError`` where the port is taken."""
        self._address.check_free("--sensorsim")
        self._server = grpc.aio.server(options=SERVER_OPTIONS, maximum_concurrent_rpcs=MOST_WAITING)
        for name in SERVICES:
            handler = grpc.method_handlers_generic_handler(name, self._methods())
            self._server.add_generic_rpc_handlers((handler,))
        port = self._server.add_insecure_port(str(self._address))
        await self._server.start()
        return Address(self._address.host, port)

    async def stop(self) -> None:
        """Close the port; a picture that is being rendered is finished."""
        if self._server is not None:
            await self._server.stop(None)
        self._executor.shutdown()

    def _methods(self) -> dict[str, grpc.RpcMethodHandler[Any, Any]]:
        return {
            "render_rgb": _method(self._render_rgb, wire.RGBRenderRequest),
            "batch_render_rgb": _method(self._batch, wire.BatchRGBRenderRequest),
            "render_aggregated": _method(self._aggregated, wire.AggregatedRenderRequest),
            "render_lidar": _method(self._lidar, wire.LidarRenderRequest),
            "get_version": _method(self._version, wire.Empty),
            "get_available_scenes": _method(self._scenes, wire.Empty),
            "get_loaded_scenes": _method(self._loaded, wire.Empty),
            "get_available_cameras": _method(self._cameras, wire.AvailableCamerasRequest),
            "get_available_trajectories": _method(
                self._trajectories, wire.AvailableTrajectoriesRequest
            ),
            "get_available_ego_masks": _method(self._ego_masks, wire.Empty),
        }

    async def _render_rgb(self, request: wire.RGBRenderRequest, call: Any) -> wire.RGBRenderReturn:
        job = self._job(request)
        self._say(job, len(request.dynamic_objects) - len(job.objects), call)
        loop = asyncio.get_running_loop()
        return wire.RGBRenderReturn(image_bytes=await loop.run_in_executor(self._executor, job.run))

    async def _batch(self, request: wire.BatchRGBRenderRequest, call: Any) -> Any:
        _check_count("items", request.items)
        answer = wire.BatchRGBRenderReturn()
        for item in request.items:
            row = answer.items.add(camera_name=item.camera_name)
            try:
                row.result.CopyFrom(await self._render_rgb(item.request, call))
                row.success = True
            except RfedgeError as error:
                row.error_message = str(error)
        return answer

    async def _aggregated(self, request: wire.AggregatedRenderRequest, call: Any) -> Any:
        _check_count("rgb_requests", request.rgb_requests)
        if request.lidar_requests:
            return await self._lidar(wire.LidarRenderRequest(), call)
        made = [await self._render_rgb(each, call) for each in request.rgb_requests]
        return wire.AggregatedRenderReturn(rgb_returns=made)

    async def _lidar(self, _: wire.LidarRenderRequest, _call: Any) -> Any:
        raise Refused(UNIMPLEMENTED, "lidar: a field has colours, no returns of a lidar")

    async def _version(self, _: Any, _call: Any) -> wire.VersionId:
        api = wire.VersionId.APIVersion(
            major=API_VERSION[0], minor=API_VERSION[1], patch=API_VERSION[2]
        )
        return wire.VersionId(version_id=f"rfedge {version('rfedge')}", grpc_api_version=api)

    async def _scenes(self, _: Any, _call: Any) -> wire.AvailableScenesReturn:
        return wire.AvailableScenesReturn(scene_ids=self._scene_ids())

    async def _loaded(self, _: Any, _call: Any) -> wire.LoadedScenesReturn:
        ids = self._scene_ids()
        entries = [
            wire.LoadedSceneEntry(scene_id=i, loaded_instance_count=1, reusable_instance_count=1)
            for i in ids
        ]
        return wire.LoadedScenesReturn(scenes=entries, loaded_instance_capacity=len(ids))

    async def _cameras(self, request: wire.AvailableCamerasRequest, _call: Any) -> Any:
        self._placed(request.scene_id)
        answer = wire.AvailableCamerasReturn()
        for name, k in self._offered().items():
            spec = wire.CameraSpec(
                logical_id=name,
                resolution_h=k.height_px,
                resolution_w=k.width_px,
                shutter_type=wire.SHUTTER_TYPE_GLOBAL,
                opencv_pinhole_param=wire.OpenCVPinholeCameraParam(
                    principal_point_x=k.cx_px,
                    principal_point_y=k.cy_px,
                    focal_length_x=k.fx_px,
                    focal_length_y=k.fy_px,
                    radial_coeffs=[0.0] * 6,
                    tangential_coeffs=[0.0] * 2,
                    thin_prism_coeffs=[0.0] * 4,
                ),
            )
            answer.available_cameras.add(
                intrinsics=spec, rig_to_camera=_to_wire(Pose.identity()), logical_id=name
            )
        return answer

    async def _trajectories(self, request: wire.AvailableTrajectoriesRequest, _call: Any) -> Any:
        self._placed(request.scene_id)
        answer = wire.AvailableTrajectoriesReturn()
        if self._drive:
            poses = [
                wire.PoseAtTime(
                    pose=_to_wire(picture.camera.world_from_cam),
                    timestamp_us=picture.time_ns // 1000,
                )
                for picture in self._drive
            ]
            answer.available_trajectories.add(trajectory=wire.Trajectory(poses=poses))
        return answer

    async def _ego_masks(self, _: Any, _call: Any) -> wire.Empty:
        return wire.Empty()

    def _offered(self) -> dict[str, Intrinsics]:
        """Return the drive's cameras by the names that requests may give them."""
        distinct = dict.fromkeys(picture.camera.intrinsics for picture in self._drive)
        return {f"camera_{number}" if number else "camera": k for number, k in enumerate(distinct)}

    def _fields(self) -> list[PlacedField]:
        placed = [self._scene.field(field_id) for field_id in self._scene.field_ids]
        return [each for each in placed if each is not None]

    def _scene_ids(self) -> list[str]:
        return [each.field.metadata.name or each.tile for each in self._fields()]

    def _placed(self, scene_id: str) -> PlacedField:
        fields = self._fields()
        if not fields:
            raise Refused(grpc.StatusCode.UNAVAILABLE, "no field is loaded yet; ask again")
        for each in fields:
            if scene_id in (each.tile, each.field.metadata.name, each.field.field_id):
                return each
        raise Refused(
            grpc.StatusCode.NOT_FOUND,
            f"scene_id: '{scene_id[:80]}' is none of {', '.join(self._scene_ids())[:200]}",
        )

    def _job(self, request: wire.RGBRenderRequest) -> RenderJob:
        """Return what is to be rendered; raise ``Refused`` and ``InvalidInput``."""
        placed = self._placed(request.scene_id)
        if request.insert_ego_mask:
            raise Refused(INVALID, "insert_ego_mask: there are no ego masks; ask without one")
        if request.image_format not in FORMATS:
            raise Refused(
                INVALID, f"image_format: {request.image_format}; 1 (PNG) and 2 (JPEG) are"
            )
        world_from_cam = pose_pair("sensor_pose", request.sensor_pose)
        start_us, end_us = request.frame_start_us, request.frame_end_us
        if end_us < start_us or (end_us == start_us and world_from_cam.moves):
            raise InvalidInput(
                "frame_end_us",
                f"{end_us} is not after frame_start_us {start_us}; two poses need an exposure",
            )
        quality = request.image_quality
        is_jpeg = request.image_format == wire.IMAGE_FORMAT_JPEG
        if is_jpeg and not 0 <= quality <= 100:
            raise InvalidInput("image_quality", f"{quality:g} is outside 0..100")
        spec = request.camera_intrinsics
        size_px = (request.resolution_w, request.resolution_h)
        if size_px == (0, 0):
            size_px = (spec.resolution_w, spec.resolution_h)
        if spec.shutter_type not in SHUTTERS:
            raise InvalidInput("shutter_type", f"{spec.shutter_type} is outside 0..5")
        objects = self._objects(placed.field, request.dynamic_objects)
        moves = world_from_cam.moves or any(motion.moves for _, motion in objects)
        return RenderJob(
            placed.field,
            self._model(spec, size_px),
            world_from_cam,
            SHUTTERS[spec.shutter_type] if moves else None,
            is_jpeg,
            quality or 95.0,
            objects,
        )

    def _objects(
        self, field: RadianceField, asked: Iterable[wire.DynamicObject]
    ) -> tuple[tuple[SplatField, Motion], ...]:
        """Return the objects that can be drawn."""
        if not isinstance(field, SplatField):
            return ()
        return tuple(
            (self._shapes[each.track_id], pose_pair(f"'{each.track_id}'.pose_pair", each.pose_pair))
            for each in asked
            if each.track_id in self._shapes
        )

    def _model(self, spec: wire.CameraSpec, size_px: tuple[int, int]) -> LensModel:
        if spec.WhichOneof("external_distortion"):
            raise Refused(INVALID, "bivariate_windshield_model_param: windshields are not rendered")
        if spec.WhichOneof("camera_param") is None:
            offered = self._offered()
            if spec.logical_id not in offered:
                known = ", ".join(offered) or "none (give rfedge twin --drive DATASET)"
                raise Refused(
                    grpc.StatusCode.NOT_FOUND,
                    f"camera_intrinsics: no parameters, and logical_id '{spec.logical_id[:80]}' is "
                    f"no camera here: {known}",
                )
            return LensModel(offered[spec.logical_id].resized(*size_px))
        return lens_model(spec, size_px)

    def _say(self, job: RenderJob, missing: int, call: Any) -> None:
        """Say what the picture lacks: once in the log, in each answer."""
        if missing:
            call.set_trailing_metadata(((NOT_DRAWN, f"{missing} dynamic objects"),))
            self._once(
                "dynamic objects without a shape are not drawn (--object ID=FIELD)"
                if isinstance(job.field, SplatField)
                else f"dynamic objects are not drawn in a field of kind {job.field.metadata.kind}"
            )
        if any(s.metadata.antialiased != job.field.metadata.antialiased for s, _ in job.objects):
            self._once(
                "objects and field were not both trained with --antialiased, or both without: "
                "objects look too thin or too thick from afar"
            )

    def _once(self, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            log.warning(text)


def _method(
    answer: Callable[[Any, Any], Awaitable[Any]], request: type[Any]
) -> grpc.RpcMethodHandler[Any, Any]:
    """Return a handler that answers errors with a status."""

    async def answered(message: Any, call: Any) -> Any:
        try:
            return await answer(message, call)
        except Refused as error:
            await call.abort(error.code, str(error))
        except RfedgeError as error:
            await call.abort(INVALID, str(error))

    return grpc.unary_unary_rpc_method_handler(
        answered,
        request_deserializer=request.FromString,
        response_serializer=lambda message: message.SerializeToString(),
    )


def _check_count(name: str, items: Sequence[Any]) -> None:
    if len(items) > MOST_WAITING:
        raise InvalidInput(name, f"{len(items)} pictures are more than {MOST_WAITING}")


def quantiser(quality: float) -> int:
    """Return FFmpeg's scale for MJPEG, 1 (best) to 31, of a quality of 0 to 100."""
    return round(min(31.0, max(1.0, (100.0 - quality) / 5.0)))


def _to_wire(pose: Pose) -> wire.SensorPose:
    (x, y, z), (w, a, b, c) = pose.translation_m, pose.rotation
    return wire.SensorPose(vec=wire.Vec3(x=x, y=y, z=z), quat=wire.Quat(w=w, x=a, y=b, z=c))
