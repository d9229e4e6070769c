"""Simulators are answered: a real client with the messages of a public package.

carla-driver-interface holds AlpaSim's messages as they were published; it is the oracle of names
and numbers. AlpaSim itself was not run.
"""

import asyncio
import math
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from importlib import import_module
from typing import Any

import cv2
import grpc
import numpy as np
import pytest
import tyro

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.dataset.undistort import pinhole_of, undistorted
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.field import FieldMetadata, SplatField, save_field
from rfcore.image import rgb_from_bytes, rgb_from_colour
from rfcore.lens import BrownLens, FisheyeLens
from rfcore.metrics import psnr
from rfcore.native.backend import available_isas
from rfcore.views import PosedPicture
from rfcore.wire.address import Address
from rfcore.wire.v1 import sensorsim_pb2 as ours
from rfedge.cli.twin import Twin
from rfedge.twin.lens_picture import LensModel, RadialLens, render_through
from rfedge.twin.placed_objects import PlacedObject, with_objects
from rfedge.twin.scene import Board, PlacedField, TwinScene
from rfedge.twin.sensorsim import NOT_DRAWN, SERVICES, Sensorsim
from rfedge.twin.shutter import Motion, Shutter, lines_motion_px, render_rolling

sim = import_module("carla_driver_interface._proto.sensorsim_pb2")
common = import_module("carla_driver_interface._proto.common_pb2")
SIZE = (64, 48)
EYE = Pose((0.1, -0.05, 0.2), (math.cos(0.05), 0.0, math.sin(0.05), 0.0))


@pytest.fixture(scope="module")
def wall(wall: SplatField) -> SplatField:
    """The wall in smooth colours, each place another."""
    x, y = wall.gaussians.means[:, 0], wall.gaussians.means[:, 1]
    colour = np.stack([np.sin(2 * x), np.cos(2 * y), np.sin(x + y)], axis=1).astype(np.float32)
    return SplatField(replace(wall.gaussians, sh=colour[:, None]))


@pytest.fixture(scope="module")
def car(wall: SplatField) -> SplatField:
    """A bright plate of 0.4 m x 0.3 m, in its own axes."""
    means = wall.gaussians.means
    near = (np.abs(means[:, 0]) < 0.2) & (np.abs(means[:, 1]) < 0.15)
    part = {name: np.ascontiguousarray(value[near]) for name, value in vars(wall.gaussians).items()}
    part["means"][:, 2] = 0
    part["sh"][:] = 1.7
    return SplatField(replace(wall.gaussians, **part))


@asynccontextmanager
async def serving(
    field: SplatField, drive: Any = (), shapes: Any = None
) -> AsyncIterator["Client"]:
    scene = TwinScene(Board())
    scene.place(PlacedField(field, "field", b""), 0.0)
    service = Sensorsim(Address("127.0.0.1", 0), scene, drive, shapes)
    address = await service.start()
    try:
        async with grpc.aio.insecure_channel(str(address)) as channel:
            yield Client(channel)
    finally:
        await service.stop()


class Client:
    """Calls methods by name, under the first name of the service unless told."""

    def __init__(self, channel: grpc.aio.Channel) -> None:
        self._channel = channel

    def call(self, method: str, request: Any, service: str = SERVICES[0]) -> Any:
        public = sim.DESCRIPTOR.services_by_name["SensorsimService"].methods_by_name[method]
        answer = public.output_type._concrete_class
        return self._channel.unary_unary(
            f"/{service}/{method}",
            request_serializer=lambda message: message.SerializeToString(),
            response_deserializer=answer.FromString,
        )(request)

    async def picture(self, request: Any) -> np.ndarray:
        return rgb_from_bytes((await self.call("render_rgb", request)).image_bytes, "answer")


def pose_of(pose: Pose) -> Any:
    (x, y, z), (w, a, b, c) = pose.translation_m, pose.rotation
    return common.Pose(vec=common.Vec3(x=x, y=y, z=z), quat=common.Quat(w=w, x=a, y=b, z=c))


def float32(pose: Pose) -> Pose:
    """The pose as the wire holds it."""
    w, x, y, z = np.float32(pose.rotation).astype(float)
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    moved = np.float32(pose.translation_m).astype(float)
    return Pose(tuple(moved.tolist()), (w / norm, x / norm, y / norm, z / norm))


def pinhole(**other: Any) -> Any:
    numbers = {"radial_coeffs": [0.0] * 6} | other
    return sim.OpenCVPinholeCameraParam(
        principal_point_x=32, principal_point_y=24, focal_length_x=40, focal_length_y=42, **numbers
    )


def request(start: Pose = EYE, end: Pose | None = None, **other: Any) -> Any:
    spec = sim.CameraSpec(
        resolution_w=64,
        resolution_h=48,
        opencv_pinhole_param=pinhole(),
        shutter_type=other.pop("shutter_type", 1),
    )
    fields = {
        "scene_id": "field",
        "resolution_w": 64,
        "resolution_h": 48,
        "camera_intrinsics": spec,
        "frame_start_us": 1_000,
        "frame_end_us": 31_000,
        "sensor_pose": sim.PosePair(start_pose=pose_of(start), end_pose=pose_of(end or start)),
        "image_format": 1,
        "image_quality": 95.0,
    }
    return sim.RGBRenderRequest(**(fields | other))


def with_camera(**camera: Any) -> Any:
    return request(camera_intrinsics=sim.CameraSpec(resolution_w=64, resolution_h=48, **camera))


RENAMED = {"SensorPose": common.Pose, "APIVersion": common.VersionId.APIVersion}


def test_fields_have_the_public_names_numbers_and_types():
    """Of messages and enumerations alike, whose values are numbers on the wire."""
    compared = 0
    waiting = list(ours.DESCRIPTOR.message_types_by_name.values())
    while waiting:
        message = waiting.pop()
        waiting += message.nested_types
        if message.name in RENAMED:
            public = RENAMED[message.name].DESCRIPTOR
        else:
            found = {
                **sim.DESCRIPTOR.message_types_by_name,
                **{
                    m.name: m
                    for each in sim.DESCRIPTOR.message_types_by_name.values()
                    for m in each.nested_types
                },
            }
            public = (
                found.get(message.name) or common.DESCRIPTOR.message_types_by_name[message.name]
            )
        for field in message.fields:
            theirs = public.fields_by_number[field.number]
            assert (theirs.name, theirs.type, theirs.is_repeated) == (
                field.name,
                field.type,
                field.is_repeated,
            ), f"{message.name}.{field.name}"
            compared += 1
    assert compared > 80
    for name in ("ShutterType", "ImageFormat"):
        numbers = {v.number for v in ours.DESCRIPTOR.enum_types_by_name[name].values}
        assert numbers == {v.number for v in sim.DESCRIPTOR.enum_types_by_name[name].values}


REFUSED = {"render_lidar": "a field has colours, no returns", "render_rgb": "image_format: 0"}
"""Methods that say something of their own when they are asked for nothing but a scene."""


@pytest.mark.parametrize("service", SERVICES)
async def test_every_method_of_the_contract_is_served_under_both_names(wall, service):
    methods = sim.DESCRIPTOR.services_by_name["SensorsimService"].methods
    async with serving(wall) as client:
        for method in methods:
            message = method.input_type._concrete_class()
            if "scene_id" in method.input_type.fields_by_name:
                message.scene_id = "field"
            if method.name not in REFUSED:
                await client.call(method.name, message, service)
                continue
            with pytest.raises(grpc.aio.AioRpcError, match=REFUSED[method.name]):
                await client.call(method.name, message, service)
        scenes = await client.call("get_available_scenes", common.Empty(), service)
        assert list(scenes.scene_ids) == ["field"]


K = Intrinsics(64, 48, 40.0, 42.0, 32.0, 24.0)
END = Pose((0.3, 0.0, 0.1), (math.cos(0.1), 0.0, -math.sin(0.1), 0.0))


async def test_a_picture_of_a_global_shutter_is_the_fields_render_at_the_middle(wall):
    async with serving(wall) as client:
        for start, stop, shutter in ((EYE, EYE, 1), (EYE, EYE, 5), (EYE, END, 5), (EYE, END, 0)):
            camera = Camera(K, Motion(float32(start), float32(stop)).middle)
            shown = await client.picture(request(start, stop, shutter_type=shutter))
            np.testing.assert_array_equal(shown, rgb_from_colour(wall.render_colour(camera)))
        jpeg = await client.picture(request(image_format=2))
        assert psnr(jpeg, await client.picture(request())) > 35
        smaller = await client.picture(request(resolution_w=32, resolution_h=24))
        assert smaller.shape == (24, 32, 3)


async def test_rolling_shutters_read_the_lines_in_the_order_of_their_names(wall):
    motion, model = Motion(float32(EYE), float32(END)), LensModel(K)
    start, end = (
        render_through(wall, model, pose).astype(int) for pose in (motion.start, motion.end)
    )
    first_and_last = {
        "ROLLING_TOP_TO_BOTTOM": (np.s_[0], np.s_[-1]),
        "ROLLING_LEFT_TO_RIGHT": (np.s_[:, 0], np.s_[:, -1]),
        "ROLLING_BOTTOM_TO_TOP": (np.s_[-1], np.s_[0]),
        "ROLLING_RIGHT_TO_LEFT": (np.s_[:, -1], np.s_[:, 0]),
    }
    async with serving(wall) as client:
        for name, (first, last) in first_and_last.items():
            (number,) = (
                v.number
                for v in sim.DESCRIPTOR.enum_types_by_name["ShutterType"].values
                if v.name.endswith(name)
            )
            shown = (await client.picture(request(EYE, END, shutter_type=number))).astype(int)
            for line, there, elsewhere in ((first, start, end), (last, end, start)):
                near, far = (np.abs(shown[line] - each[line]).mean() for each in (there, elsewhere))
                assert 4 * near < far, name


async def test_a_rolling_picture_is_that_of_its_shutter(wall):
    motion, model, shutter = Motion(float32(EYE), float32(END)), LensModel(K), Shutter(reverse=True)
    moves = lines_motion_px(wall, model, motion, shutter)
    want = render_rolling(lambda _: wall, model, motion, shutter, moves)
    async with serving(wall) as client:
        shown = await client.picture(request(EYE, END, shutter_type=3))
    np.testing.assert_array_equal(shown, want)


def sensor_points() -> np.ndarray:
    rng = np.random.default_rng(3)
    angle, way = rng.uniform(0, 1.2, 500), rng.uniform(0, 2 * math.pi, 500)
    return np.stack([angle * np.cos(way), angle * np.sin(way)], axis=1)


def test_a_fisheye_is_that_of_the_house_and_a_polynomial_of_angles_or_of_radii():
    points = sensor_points()
    house = FisheyeLens(0.02, -0.003).undistort(points)
    found, angle = RadialLens((0, 1, 0, 0.02, 0, -0.003)).undistort(points)
    np.testing.assert_allclose(found, house, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.tan(angle), np.hypot(*house.T), rtol=1e-9)
    equidistant = FisheyeLens().undistort(points)
    for lens in (RadialLens((0.0, 1.0)), RadialLens((), (0.0, 1.0))):
        np.testing.assert_allclose(lens.undistort(points)[0], equidistant, rtol=1e-9, atol=1e-12)


def test_the_linear_term_is_taken_off_and_what_no_direction_reaches_is_infinite():
    ideal, (c, d, e) = 0.5 * sensor_points(), (1.01, 0.002, -0.003)
    offset = ideal @ np.array([[c, d], [e, 1.0]]).T
    lens = RadialLens((0.0, 1.0), linear=(c, d, e))
    found = lens.undistort(offset)[0]
    np.testing.assert_allclose(found, RadialLens((0.0, 1.0)).undistort(ideal)[0], atol=1e-12)
    turning = RadialLens((0.0, 1.0, 0.0, -0.3))  # greatest at 1.05 rad
    _, angle = turning.undistort(np.array([[0.5, 0.0], [0.8, 0.0]]))
    assert angle[0] < 0.6
    assert angle[1] == math.inf


async def test_the_rational_lens_with_thin_prisms_is_opencvs(wall):
    """One splat is where cv2.projectPoints puts it, to a quarter of a pixel."""
    radial, (p1, p2), prism = (
        [0.1, 0.1, 0.02, 0.6, 0.15, 0.03],
        (0.01, -0.02),
        [0.03, 0.01, -0.04, 0],
    )
    opencv = np.array([*radial[:2], p1, p2, *radial[2:], *prism])
    matrix = np.array([[40.0, 0, 32], [0, 42, 24], [0, 0, 1]])
    one = {name: np.ascontiguousarray(value[:1]) for name, value in vars(wall.gaussians).items()}
    one["sh"] = np.full((1, 1, 3), 1.7, np.float32)
    lens = pinhole(radial_coeffs=radial, tangential_coeffs=[p1, p2], thin_prism_coeffs=prism)
    still = pose_of(Pose.identity())
    message = with_camera(opencv_pinhole_param=lens)
    message.sensor_pose.CopyFrom(sim.PosePair(start_pose=still, end_pose=still))
    for at in ((-1.4, -1.0), (1.4, 0.9), (1.6, -1.1)):
        centre = np.array([*at, 4.0])
        one["means"] = centre[None].astype(np.float32)
        projected, _ = cv2.projectPoints(centre[None], np.zeros(3), np.zeros(3), matrix, opencv)
        async with serving(SplatField(replace(wall.gaussians, **one))) as client:
            level = (await client.picture(message))[..., 0].astype(float)
        v, u = np.mgrid[:48, :64] + 0.5
        found = np.array([(level * u).sum(), (level * v).sum()]) / level.sum()
        straight = matrix[:2, 2] + matrix.diagonal()[:2] * centre[:2] / centre[2]
        assert np.hypot(*(found - projected[0, 0])) < 0.25
        assert np.hypot(*(straight - projected[0, 0])) > 0.5


@pytest.mark.parametrize(
    "lens",
    [
        BrownLens(-0.1, 0.02, 0.002, -0.001),
        BrownLens(0.4, 0.1, 0.001, -0.002, 0.02, 0.6, 0.15, 0.03, 0.003, 0.001, -0.004),
        FisheyeLens(0.01, -0.002),
    ],
)
def test_a_picture_through_a_lens_undistorts_to_the_pinholes(wall, lens):
    k = Intrinsics(160, 120, 90.0, 92.0, 80.5, 59.0)
    model = lens
    if isinstance(lens, FisheyeLens):
        model = RadialLens((0, 1, 0, lens.k1, 0, lens.k2, 0, lens.k3, 0, lens.k4))
    through = render_through(wall, LensModel(k, model), EYE)
    flat = rgb_from_colour(wall.render_colour(Camera(pinhole_of(k, lens), EYE)))
    assert psnr(undistorted(through, k, lens), flat) > 34


def test_pixels_beyond_the_greatest_angle_are_black(wall):
    k = Intrinsics(64, 48, 40.0, 40.0, 32.0, 24.0)
    picture = render_through(wall, LensModel(k, RadialLens((0.0, 1.0), max_angle_rad=0.5)), EYE)
    v, u = np.mgrid[:48, :64] + 0.5
    beyond = np.hypot(u - 32, v - 24) > 40 * 0.5 + 0.01
    assert not picture[beyond].any()
    assert picture[~beyond].any()


def test_the_bytes_are_the_same_on_every_instruction_set_and_number_of_threads(wall):
    k = Intrinsics(160, 120, 80.0, 80.0, 80.0, 60.0)
    models = [
        LensModel(k),
        LensModel(k, BrownLens(-0.05)),
        LensModel(k, RadialLens((0, 1, 0, 0.01))),
    ]
    first = [render_through(wall, model, EYE).tobytes() for model in models]
    for isa in available_isas():
        for threads in (1, 3):
            field = SplatField(wall.gaussians, wall.metadata, threads=threads, isa=isa)
            assert [render_through(field, m, EYE).tobytes() for m in models] == first


NAN = float("nan")
FTHETA = {"reference_poly": 2, "angle_to_pixeldist_poly": [0, 30.0]}


def posed(**quat: float) -> Any:
    pose = common.Pose(vec=common.Vec3(), quat=common.Quat(**quat))
    return request(sensor_pose=sim.PosePair(start_pose=pose, end_pose=pose))


@pytest.mark.parametrize(
    ("message", "code", "said"),
    [
        (request(scene_id="mars"), "NOT_FOUND", "scene_id: 'mars' is none of field"),
        (request(resolution_w=100_000), "INVALID_ARGUMENT", r"100000 px is outside 1\.\.8192"),
        (request(resolution_w=0), "INVALID_ARGUMENT", r"0 px is outside 1\.\.8192"),
        (
            request(resolution_w=8192, resolution_h=8192),
            "INVALID_ARGUMENT",
            "8192x8192 px are above 16777216 pixels",
        ),
        (request(Pose((1e30, 0, 0), (1, 0, 0, 0))), "OK", ""),
        (
            posed(w=NAN),
            "INVALID_ARGUMENT",
            r"start_pose\.quat: \(nan, 0, 0, 0\) is of length nan, not 1",
        ),
        (posed(), "INVALID_ARGUMENT", "is of length 0, not 1"),
        (
            request(
                sensor_pose=sim.PosePair(
                    start_pose=common.Pose(vec=common.Vec3(x=NAN), quat=common.Quat(w=1))
                )
            ),
            "INVALID_ARGUMENT",
            r"translation_m.*\(nan, 0\.0, 0\.0\) must be three finite metres",
        ),
        (
            request(EYE, Pose.identity(), frame_end_us=1_000),
            "INVALID_ARGUMENT",
            "frame_end_us.* 1000 is not after frame_start_us 1000",
        ),
        (request(frame_end_us=999), "INVALID_ARGUMENT", "999 is not after frame_start_us 1000"),
        (request(frame_end_us=1_000), "OK", ""),
        (request(image_format=5), "INVALID_ARGUMENT", "image_format: 5; 1 .PNG. and 2"),
        (request(image_format=0), "INVALID_ARGUMENT", "image_format: 0"),
        (request(image_format=2, image_quality=101), "INVALID_ARGUMENT", "101 is outside 0..100"),
        (request(insert_ego_mask=True), "INVALID_ARGUMENT", "there are no ego masks"),
        (with_camera(logical_id="rear"), "NOT_FOUND", "logical_id 'rear' is no camera here"),
        (request(shutter_type=9), "INVALID_ARGUMENT", r"shutter_type: 9 is outside 0\.\.5"),
        (
            with_camera(opencv_pinhole_param=pinhole(radial_coeffs=[0, 0, 0, 9, 0, 0])),
            "INVALID_ARGUMENT",
            "no direction reaches|not one-to-one",
        ),
        (
            with_camera(opencv_pinhole_param=pinhole(thin_prism_coeffs=[0, NAN, 0, 0])),
            "INVALID_ARGUMENT",
            "s2=nan.* not finite",
        ),
        (
            with_camera(opencv_pinhole_param=sim.OpenCVPinholeCameraParam()),
            "INVALID_ARGUMENT",
            r"fx_px.* 0\.0 must be a finite number of pixels above 0",
        ),
        (
            with_camera(
                opencv_pinhole_param=pinhole(),
                bivariate_windshield_model_param=sim.BivariateWindshieldModelParameters(),
            ),
            "INVALID_ARGUMENT",
            "windshields are not rendered",
        ),
        (
            with_camera(ftheta_param=sim.FthetaCameraParam(**FTHETA, principal_point_x=900)),
            "INVALID_ARGUMENT",
            "sees .* degrees from its axis; at most 75 are rendered",
        ),
        (
            with_camera(ftheta_param=sim.FthetaCameraParam(reference_poly=0)),
            "INVALID_ARGUMENT",
            "reference_poly.* 0 is neither 1 nor 2",
        ),
        (
            with_camera(
                ftheta_param=sim.FthetaCameraParam(
                    reference_poly=2, angle_to_pixeldist_poly=[0, -3]
                )
            ),
            "INVALID_ARGUMENT",
            "does not rise from 0",
        ),
        (
            with_camera(
                ftheta_param=sim.FthetaCameraParam(
                    reference_poly=2, angle_to_pixeldist_poly=[0, NAN]
                )
            ),
            "INVALID_ARGUMENT",
            "not finite|does not rise",
        ),
    ],
)
async def test_bad_input_is_one_status_that_names_it(wall, message, code, said):
    async with serving(wall) as client:
        if code == "OK":
            assert (await client.picture(message)).shape == (48, 64, 3)
            return
        with pytest.raises(grpc.aio.AioRpcError, match=said) as refused:
            await client.picture(message)
        assert refused.value.code().name == code


async def test_a_batch_says_which_picture_failed(wall):
    batch = sim.BatchRGBRenderRequest()
    batch.items.add(camera_name="front", request=request())
    batch.items.add(camera_name="lost", request=request(scene_id="mars"))
    async with serving(wall) as client:
        front, lost = (await client.call("batch_render_rgb", batch)).items
        alone = await client.call("render_rgb", request())
        both = sim.AggregatedRenderRequest(rgb_requests=[request(), request()])
        made = (await client.call("render_aggregated", both)).rgb_returns
        many = sim.BatchRGBRenderRequest(items=[sim.BatchRGBRenderRequestItem()] * 17)
        with pytest.raises(grpc.aio.AioRpcError, match="17 pictures are more than 16"):
            await client.call("batch_render_rgb", many)
    assert (front.camera_name, front.success) == ("front", True)
    assert front.result.image_bytes == alone.image_bytes
    assert (lost.camera_name, lost.success) == ("lost", False)
    assert "'mars'" in lost.error_message
    assert [one.image_bytes for one in made] == [alone.image_bytes] * 2


def an_object(track_id: str, start: Pose, end: Pose | None = None) -> Any:
    pair = sim.PosePair(start_pose=pose_of(start), end_pose=pose_of(end or start))
    return sim.DynamicObject(track_id=track_id, pose_pair=pair)


async def test_objects_with_a_shape_are_drawn_and_the_others_counted(wall, car):
    there = Pose((0.2, 0.0, 2.0), (math.cos(0.4), 0.0, math.sin(0.4), 0.0))
    objects = [an_object("car", there), an_object("dog", there), an_object("cat", there)]
    async with serving(wall, shapes={"car": car}) as client:
        call = client.call("render_rgb", request(dynamic_objects=objects))
        shown = rgb_from_bytes((await call).image_bytes, "answer")
        said = dict(iter(await call.trailing_metadata()))
        bare = client.call("render_rgb", request(dynamic_objects=objects[:1]))
        np.testing.assert_array_equal(rgb_from_bytes((await bare).image_bytes, "answer"), shown)
        assert NOT_DRAWN not in dict(iter(await bare.trailing_metadata()))
    assert said[NOT_DRAWN] == "2 dynamic objects"
    placed = with_objects(wall, [PlacedObject(car, Motion(*[float32(there)] * 2).at(0.5))])
    camera = Camera(K, Motion(float32(EYE), float32(EYE)).middle)
    np.testing.assert_array_equal(shown, rgb_from_colour(placed.render_colour(camera)))
    assert psnr(shown, rgb_from_colour(wall.render_colour(camera))) < 30


async def test_an_object_that_moves_is_in_the_middle_or_leans(wall, car):
    """By a shutter that is global, or rolling with the camera still."""
    left, right = (Pose((x, 0.0, 2.0), (1.0, 0.0, 0.0, 0.0)) for x in (-0.5, 0.5))
    objects = [an_object("car", left, right)]
    camera = Camera(K, Motion(float32(EYE), float32(EYE)).middle)
    placed = with_objects(wall, [PlacedObject(car, Motion(left, right).middle)])
    middle = rgb_from_colour(placed.render_colour(camera))
    async with serving(wall, shapes={"car": car}) as client:
        shown = await client.picture(request(dynamic_objects=objects, shutter_type=5))
        np.testing.assert_array_equal(shown, middle)
        leaning = await client.picture(request(dynamic_objects=objects))
    differs = np.flatnonzero((leaning.astype(int) - middle).__abs__().max(axis=(1, 2)) > 9)
    assert len(differs) > 5
    assert differs.max() - differs.min() < 20, "only the object's rows"


async def test_an_object_without_a_pose_is_refused_by_its_id(wall, car):
    lost = request(dynamic_objects=[sim.DynamicObject(track_id="car")])
    async with serving(wall, shapes={"car": car}) as client:
        with pytest.raises(grpc.aio.AioRpcError, match=r"'car'\.pose_pair\.start_pose\.quat"):
            await client.picture(lost)


async def test_a_drive_offers_its_cameras_and_poses(wall):
    k = Intrinsics(64, 48, 40.0, 42.0, 32.0, 24.0)
    cameras = [Camera(k, EYE), Camera(replace(k, fx_px=50.0), Pose.identity())]
    drive = [PosedPicture("a", camera, lambda: None, 5_000 * i) for i, camera in enumerate(cameras)]
    async with serving(wall, drive) as client:
        query = sim.AvailableCamerasRequest(scene_id="field")
        offered = (await client.call("get_available_cameras", query)).available_cameras
        assert [each.logical_id for each in offered] == ["camera", "camera_1"]
        assert offered[1].intrinsics.opencv_pinhole_param.focal_length_x == 50
        query = sim.AvailableTrajectoriesRequest(scene_id="field")
        (way,) = (await client.call("get_available_trajectories", query)).available_trajectories
        assert [pose.timestamp_us for pose in way.trajectory.poses] == [0, 5]
        named = await client.picture(with_camera(logical_id="camera"))
        given = await client.picture(request())
        np.testing.assert_array_equal(named, given)
        whole = await client.picture(request(camera_intrinsics=offered[0].intrinsics))
        np.testing.assert_array_equal(whole, given)


async def test_a_scene_goes_by_its_fields_name_and_none_is_there_before_it_is_loaded(wall):
    named = SplatField(wall.gaussians, FieldMetadata("street"))
    async with serving(named) as client:
        scenes = await client.call("get_loaded_scenes", common.Empty())
        assert [scene.scene_id for scene in scenes.scenes] == ["street"]
        for scene_id in ("street", named.field_id):
            await client.picture(request(scene_id=scene_id))
    service = Sensorsim(Address("127.0.0.1", 0), TwinScene(Board()))
    async with grpc.aio.insecure_channel(str(await service.start())) as channel:
        with pytest.raises(grpc.aio.AioRpcError, match="no field is loaded yet") as refused:
            await Client(channel).picture(request())
    await service.stop()
    assert refused.value.code() is grpc.StatusCode.UNAVAILABLE


async def test_the_command_serves_simulators_beside_the_page(wall, car, tmp_path):
    save_field(wall, tmp_path / "painted.rff")
    save_field(car, tmp_path / "car.rff")
    words = ["--http", "127.0.0.1:0", "--sensorsim", "127.0.0.1:0"]
    words += ["--object", f"7={tmp_path / 'car.rff'}"]
    there = Pose((0.0, 0.0, 2.0), (1.0, 0.0, 0.0, 0.0))
    command = [sys.executable, "-m", "rfedge", "twin", str(tmp_path / "painted.rff"), *words]
    process = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
    try:
        name, _, address = (await process.stdout.readline()).decode().strip().partition(": ")
        assert name == "simulators"
        async with grpc.aio.insecure_channel(address) as channel:
            client = Client(channel)
            async with asyncio.timeout(60):
                while not (await client.call("get_available_scenes", common.Empty())).scene_ids:
                    pass  # the field is being read
            shown = await client.picture(request(dynamic_objects=[an_object("7", there)]))
        camera = Camera(K, Motion(float32(EYE), float32(EYE)).middle)
        street = with_objects(wall, [PlacedObject(car, there)])
        np.testing.assert_array_equal(shown, rgb_from_colour(street.render_colour(camera)))
    finally:
        process.terminate()
        assert await process.wait() == 0


def test_the_port_is_this_machines_alone():
    with pytest.raises(InvalidInput, match=r"0\.0\.0\.0:1 can be reached .*\(ssh -L\)"):
        Sensorsim(Address("0.0.0.0", 1), TwinScene(Board()))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--object", "car=car.rff"], "object: belongs to --sensorsim HOST:PORT"),
        (["--sensorsim", "127.0.0.1:0", "--object", "car.rff"], "object: 'car.rff' is not ID="),
        (["--sensorsim", "127.0.0.1:0", "--object", "car=missing.rff"], "missing.rff"),
    ],
)
def test_an_object_that_is_none_is_refused(words, said):
    with pytest.raises(RfedgeError, match=said):
        tyro.cli(Twin, args=["street", "--http", "127.0.0.1:0", *words]).run()
