"""Reads lenses and poses from a simulator's request."""

from __future__ import annotations

import math

from rfcore.camera import Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.lens import BrownLens
from rfcore.wire.v1 import sensorsim_pb2 as wire
from rfedge.twin.lens_picture import LensModel, RadialLens
from rfedge.twin.shutter import Motion, Shutter

NORM_TOLERANCE = 1e-3
SHUTTERS = {
    wire.SHUTTER_TYPE_UNSPECIFIED: None,
    wire.SHUTTER_TYPE_ROLLING_TOP_TO_BOTTOM: Shutter(),
    wire.SHUTTER_TYPE_ROLLING_LEFT_TO_RIGHT: Shutter(columns=True),
    wire.SHUTTER_TYPE_ROLLING_BOTTOM_TO_TOP: Shutter(reverse=True),
    wire.SHUTTER_TYPE_ROLLING_RIGHT_TO_LEFT: Shutter(columns=True, reverse=True),
    wire.SHUTTER_TYPE_GLOBAL: None,
}


def pose_pair(name: str, pair: wire.PosePair) -> Motion:
    """Return the poses at start and end; ``InvalidInput`` for those that are none."""
    return Motion(
        _pose(f"{name}.start_pose", pair.start_pose), _pose(f"{name}.end_pose", pair.end_pose)
    )


def _pose(name: str, pose: wire.SensorPose) -> Pose:
    q, v = pose.quat, pose.vec
    norm = math.sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z)
    if not abs(norm - 1) <= NORM_TOLERANCE:  # NaN as well
        raise InvalidInput(
            f"{name}.quat",
            f"({q.w:g}, {q.x:g}, {q.y:g}, {q.z:g}) is of length {norm:g}, not 1",
        )
    return Pose((v.x, v.y, v.z), (q.w / norm, q.x / norm, q.y / norm, q.z / norm))


def lens_model(spec: wire.CameraSpec, size_px: tuple[int, int]) -> LensModel:
    """Return the lens of a request, for pictures of (width, height); its own resolution is another
    one if it states that.

    Raises ``InvalidInput`` for what is not rendered.
    """
    own_px = (spec.resolution_w or size_px[0], spec.resolution_h or size_px[1])
    kind = spec.WhichOneof("camera_param")
    if kind == "opencv_pinhole_param":
        return _pinhole(spec.opencv_pinhole_param, own_px, size_px)
    if kind == "opencv_fisheye_param":
        return _fisheye(spec.opencv_fisheye_param, own_px, size_px)
    return _ftheta(spec.ftheta_param, own_px, size_px)


def _pinhole(
    p: wire.OpenCVPinholeCameraParam, own_px: tuple[int, int], size_px: tuple[int, int]
) -> LensModel:
    k1, k2, k3, k4, k5, k6 = [*p.radial_coeffs, *[0.0] * 6][:6]
    p1, p2 = [*p.tangential_coeffs, 0.0, 0.0][:2]
    prism = [*p.thin_prism_coeffs, *[0.0] * 4][:4]
    k = Intrinsics(
        *own_px, p.focal_length_x, p.focal_length_y, p.principal_point_x, p.principal_point_y
    ).resized(*size_px)
    coefficients = (k1, k2, p1, p2, k3, k4, k5, k6, *prism)
    return LensModel(k, BrownLens(*coefficients) if any(coefficients) else None)


def _fisheye(
    p: wire.OpenCVFisheyeCameraParam, own_px: tuple[int, int], size_px: tuple[int, int]
) -> LensModel:
    k1, k2, k3, k4 = [*p.radial_coeffs, *[0.0] * 4][:4]
    k = Intrinsics(
        *own_px, p.focal_length_x, p.focal_length_y, p.principal_point_x, p.principal_point_y
    ).resized(*size_px)
    series = (0.0, 1.0, 0.0, k1, 0.0, k2, 0.0, k3, 0.0, k4)
    return LensModel(k, RadialLens(series, max_angle_rad=p.max_angle))


def _ftheta(
    p: wire.FthetaCameraParam, own_px: tuple[int, int], size_px: tuple[int, int]
) -> LensModel:
    backward = p.reference_poly == wire.POLYNOMIAL_TYPE_PIXELDIST_TO_ANGLE
    forward = p.reference_poly == wire.POLYNOMIAL_TYPE_ANGLE_TO_PIXELDIST
    if not (backward or forward):
        raise InvalidInput("ftheta_param.reference_poly", f"{p.reference_poly} is neither 1 nor 2")
    linear = (1.0, 0.0, 0.0)
    if p.HasField("linear_cde"):
        linear = (p.linear_cde.linear_c, p.linear_cde.linear_d, p.linear_cde.linear_e)
    lens = RadialLens(
        () if backward else tuple(p.angle_to_pixeldist_poly),
        tuple(p.pixeldist_to_angle_poly) if backward else (),
        linear,
        p.max_angle,
    )
    centre = (p.principal_point_x + 0.5, p.principal_point_y + 0.5)
    return LensModel(Intrinsics(*own_px, 1.0, 1.0, *centre).resized(*size_px), lens)
