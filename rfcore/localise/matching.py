"""Features of a picture, found again in a render, and the pose they imply.

SIFT features (Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", IJCV 2004) are
matched by nearest neighbour and Lowe's ratio test; those of the render are lifted to 3D by the
rendered depth; the pose follows by P3P inside RANSAC, and SQPnP (Terzakis and Lourakis, ECCV 2020)
and a least-squares refinement over its inliers. OpenCV does the work and comes with an extra.

OpenCV counts pixels from the centre of the top-left pixel; positions here, ``uv_px``, do too.

The local structure of a picture is its luma less its blur, divided by the local contrast. What is
coarser than a few pixels is lighting, and contrast depends on exposure. A comparison of a picture
with a render should depend on neither.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Intrinsics, Pose
from rfcore.extras import needs
from rfcore.views import View

with needs("localise"):
    import cv2

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

COARSEST_PX = 45
"""Shortest side of the coarsest level of any pyramid, at the least."""
MEAN_PX = 9
CONTRAST_PX = 17
"""Squares over which mean and contrast are taken: box filters, which cost the same at any size."""
LEAST_CONTRAST = np.float32(2)
"""Levels added to the local contrast, so that noise of flat places has little weight."""


def structure(luma: U8) -> F32:
    """Return the local structure float32 [H, W] of luma uint8 [H, W], about -2..2."""
    plane = luma.astype(np.float32)
    fine = cv2.subtract(plane, cv2.blur(plane, (MEAN_PX, MEAN_PX)))
    contrast = cv2.blur(np.abs(fine), (CONTRAST_PX, CONTRAST_PX)) + LEAST_CONTRAST
    return np.asarray(cv2.divide(fine, contrast), np.float32)


def halved(luma: U8) -> U8:
    """Return luma at half the resolution: means of 2x2 pixels, an odd last row or column left."""
    height, width = (side // 2 for side in luma.shape)
    even = np.ascontiguousarray(luma[: 2 * height, : 2 * width])
    return np.asarray(cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


class Pyramid:
    """The structures of luma [H, W] and of its halves, finest first, to the coarsest.

    Each is made when it is first asked for: the finest takes ten times as long as all the others,
    and need not take part. Half the resolution is always there: poses are checked at it.
    """

    def __init__(self, luma: U8) -> None:
        self._lumas = [luma]
        self._made: dict[int, F32] = {}
        while len(self._lumas) == 1 or min(luma.shape) >= 2 * COARSEST_PX:
            luma = halved(luma)
            self._lumas.append(luma)

    def __len__(self) -> int:
        """Return the number of levels."""
        return len(self._lumas)

    @property
    def made(self) -> set[int]:
        """The levels that were asked for so far."""
        return set(self._made)

    def __getitem__(self, number: int) -> F32:
        """Return the structure of one level; raise ``IndexError`` beyond the coarsest."""
        if number not in self._made:
            self._made[number] = structure(self._lumas[number])
        return self._made[number]


F64 = NDArray[np.float64]

RANSAC_ROUNDS = 1000
"""Samples of three matches: one is all right with certainty 0.99 where a sixth of the matches are,
as in a render 4 m off at dusk."""
FEWEST_FOR_PNP = 6


@dataclass(frozen=True)
class Features:
    """Places ``uv_px`` float64 [N, 2] of features, and ``descriptors`` float32 [N, 128] of them.

    Places are those of the whole picture, which was halved ``halvings`` times before the search.
    """

    uv_px: F64
    descriptors: F32
    halvings: int = 0


@dataclass(frozen=True)
class Matches:
    """Places in the picture, ``uv_px`` [N, 2], and in the axes of the render's camera, [N, 3]."""

    uv_px: F64
    xyz_m: F64


@dataclass(frozen=True)
class PnpSolution:
    """A camera's pose; so many matches agree with it, to ``rms_px`` pixels."""

    world_from_cam: Pose
    inliers: int
    rms_px: float


def use_one_thread() -> None:
    """Have OpenCV work on the calling thread alone, in this whole process, from now on."""
    cv2.setNumThreads(1)


def grey(rgb: U8) -> U8:
    """Return the luma uint8 [H, W] of a picture uint8 [H, W, 3]."""
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY), np.uint8)


def find_features(luma: U8, most: int, halvings: int = 0) -> Features:
    """Return at most ``most`` features of a picture uint8 [H, W], the strongest.

    The picture's resolution is halved ``halvings`` times before; each saves three quarters of the
    time.
    """
    for _ in range(halvings):
        luma = halved(luma)
    places, descriptors = cv2.SIFT.create(most).detectAndCompute(luma, None)
    if descriptors is None:
        return Features(np.empty((0, 2)), np.empty((0, 128), np.float32), halvings)
    step = 2**halvings
    uv_px = step * np.array([place.pt for place in places], np.float64) + (step - 1) / 2
    return Features(uv_px, np.asarray(descriptors, np.float32), halvings)


def match_features(seen: Features, drawn: Features, ratio: float) -> tuple[F64, F64]:
    """Return places [N, 2] in the picture and those in the render that look the same.

    A match is kept if its distance is below ``ratio`` of that to the second nearest feature.
    """
    if min(len(seen.uv_px), len(drawn.uv_px)) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    pairs = cv2.BFMatcher().knnMatch(seen.descriptors, drawn.descriptors, k=2)
    kept = [best for best, second in pairs if best.distance < ratio * second.distance]
    return (
        seen.uv_px[[match.queryIdx for match in kept]],
        drawn.uv_px[[match.trainIdx for match in kept]],
    )


def lift_matches(
    pairs: tuple[F64, F64], view: View, intrinsics: Intrinsics, least_confidence: float
) -> Matches:
    """Return matches with the points of the render in its camera's axes, by the rendered depth.

    Inverse depth is interpolated: it is affine in the picture on any plane. Matches at pixels with
    less confidence than asked, such as the edges of objects, are left out.
    """
    uv_px, drawn_px = pairs
    limit = np.array([intrinsics.width_px - 1, intrinsics.height_px - 1])
    column, row = np.clip(np.round(drawn_px).astype(np.int64), 0, limit).T
    kept = (view.confidence[row, column] >= least_confidence) & (view.depth[row, column] > 0)
    uv_px, drawn_px = uv_px[kept], drawn_px[kept]
    z = _depth_at(view.depth, drawn_px)
    x = (drawn_px[:, 0] + 0.5 - intrinsics.cx_px) / intrinsics.fx_px * z
    y = (drawn_px[:, 1] + 0.5 - intrinsics.cy_px) / intrinsics.fy_px * z
    usable = z > 0
    return Matches(uv_px[usable], np.stack([x, y, z], axis=1)[usable])


def _depth_at(depth_m: F32, uv_px: F64) -> F64:
    """Return depths [N] at places [N, 2] by bilinear inverse depth, 0 beside what hit nothing."""
    height, width = depth_m.shape
    low = np.clip(np.floor(uv_px).astype(np.int64), 0, [max(width - 2, 0), max(height - 2, 0)])
    (column, row), (right, below) = low.T, np.clip(uv_px - low, 0.0, 1.0).T
    inverse, hit = np.zeros(len(uv_px)), np.ones(len(uv_px), bool)
    for down, across, weight in (
        (0, 0, (1 - below) * (1 - right)),
        (0, 1, (1 - below) * right),
        (1, 0, below * (1 - right)),
        (1, 1, below * right),
    ):
        corner = depth_m[np.minimum(row + down, height - 1), np.minimum(column + across, width - 1)]
        hit &= corner > 0
        inverse += weight / np.where(corner > 0, corner, 1.0)
    return np.where(hit, 1.0 / inverse, 0.0)


def solve_pose(
    matches: Matches, intrinsics: Intrinsics, drawn_at: Pose, inlier_px: float
) -> PnpSolution | None:
    """Return the pose that most matches agree with to ``inlier_px``, or None if there is none.

    ``drawn_at`` is world_from_cam of the render. OpenCV's RANSAC starts from a fixed seed: the same
    matches give the same pose.
    """
    if len(matches.uv_px) < FEWEST_FOR_PNP:
        return None
    k = _camera_matrix(intrinsics)
    try:
        found, turn, shift, inliers = cv2.solvePnPRansac(
            matches.xyz_m,
            matches.uv_px,
            k,
            None,
            iterationsCount=RANSAC_ROUNDS,
            reprojectionError=inlier_px,
            flags=cv2.SOLVEPNP_P3P,
        )
        if not found or inliers is None or len(inliers) < FEWEST_FOR_PNP:
            return None
        xyz_m, uv_px = matches.xyz_m[inliers[:, 0]], matches.uv_px[inliers[:, 0]]
        found, turn, shift = cv2.solvePnP(xyz_m, uv_px, k, None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:  # SQPnP raises where points that agree do not determine a pose
        return None
    if not found:
        return None
    turn, shift = cv2.solvePnPRefineLM(xyz_m, uv_px, k, None, turn, shift)
    if not (np.isfinite(turn).all() and np.isfinite(shift).all()):
        return None
    again_px = cv2.projectPoints(xyz_m, turn, shift, k, None)[0][:, 0]
    rms_px = float(np.sqrt(np.mean(np.sum((again_px - uv_px) ** 2, axis=1))))
    cam_from_drawn = Pose.from_matrix(np.hstack([cv2.Rodrigues(turn)[0], shift]).tolist())
    return PnpSolution(drawn_at.compose(cam_from_drawn.inverse()), len(inliers), rms_px)


def _camera_matrix(intrinsics: Intrinsics) -> F64:
    """Return the pinhole matrix [3, 3] with the principal point as OpenCV counts pixels."""
    k = intrinsics
    return np.array([[k.fx_px, 0, k.cx_px - 0.5], [0, k.fy_px, k.cy_px - 0.5], [0, 0, 1.0]])
