"""The pose of a camera from one picture: a search around what is known, and checks before belief.

For each hypothesis around the prior, nearest first: render there, match features of the picture and
the render, solve for the pose (``rfcore.localise.matching``); then once more from a render at the
pose found, which resembles the picture more. A pose is accepted if it passes three checks:

* inliers: enough matches agree with it;
* prior: it is not implausibly far from what was known;
* agreement: the render at the pose resembles the picture, pixel on pixel, far better than chance.

Otherwise the next hypothesis is tried, and after the last one the camera is lost: no pose is given.
No clock and no chance: the same picture, field and prior give the same answer.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.extras import needs
from rfcore.field import FULL, Quality, Renderer
from rfcore.localise.matching import Features, Solution, features, grey, lifted, matched, solved
from rfcore.localise.prior import PosePrior, hypotheses
from rfcore.views import View

with needs("localise"):
    import cv2

__all__ = [
    "Localised",
    "Localiser",
    "LocaliserSettings",
    "Lost",
    "Obstacle",
    "agreement",
    "median_depth",
]

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

BLUR_PX = 3.0
"""Standard deviation of the blur that is taken away: what is coarser is lighting, not structure."""
NEAR_PX = 8
"""Displacements up to this are not chance: a picture resembles its own neighbourhood."""
ON_THE_SPOT_PX = 1
"""How far from zero displacement a picture may resemble the render at its own pose best."""
LEAST_SHOWN = 0.2
"""Share of the picture that the field must show for the comparison to mean anything."""


@dataclass(frozen=True)
class LocaliserSettings:
    """When a match counts and when a pose is believed.

    Raises ``InvalidInput`` for a value that is not above 0.
    """

    features: int = 2000
    """At most so many features of the picture, and as many of a render."""
    ratio: float = 0.8
    """A match is kept if its distance is below this share of the second nearest's."""
    least_confidence: float = 0.5
    """Features of a render need a depth that its renderer trusts this far, 0..1."""
    inlier_px: float = 2.0
    """Matches that reproject this near agree with a pose."""
    least_inliers: int = 20
    """So many matches must agree with a pose."""
    least_agreement: float = 10.0
    """Standard deviations of chance by which the render at a pose must resemble the picture."""
    rounds: int = 2
    """Renders and solutions of a hypothesis."""
    most_hypotheses: int = 37
    """Give up after so many, whatever the prior."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise InvalidInput(f"localiser.{name}", f"{value} must be above 0")


class Obstacle(IntEnum):
    """What kept a hypothesis from leading to a pose, in the order of the checks."""

    FEW_FEATURES = 1
    """The picture has too few features: dark, or out of focus."""
    FEW_INLIERS = 2
    """No pose explains enough of the matches between picture and render."""
    IMPLAUSIBLE = 3
    """The pose found is too far from the prior."""
    UNLIKE = 4
    """The render at the pose found does not resemble the picture."""


@dataclass(frozen=True)
class Localised:
    """A pose that passed every check.

    ``agreement`` is that of the render at the pose, in standard deviations of chance; so many
    ``hypotheses`` were tried.
    """

    solution: Solution
    agreement: float
    hypotheses: int

    @property
    def world_from_cam(self) -> Pose:
        """The pose found."""
        return self.solution.world_from_cam


@dataclass(frozen=True)
class Lost:
    """No pose: what stopped the hypothesis that got furthest, and how many were tried."""

    obstacle: Obstacle
    hypotheses: int


class Localiser:
    """Finds the poses of pictures of one camera in one field, drawn at ``quality``."""

    def __init__(
        self,
        renderer: Renderer,
        intrinsics: Intrinsics,
        settings: LocaliserSettings | None = None,
        quality: Quality = FULL,
    ) -> None:
        self._renderer, self._quality = renderer, quality
        self._intrinsics = intrinsics
        self._settings = settings if settings is not None else LocaliserSettings()

    def localise(self, rgb: U8, prior: PosePrior) -> Localised | Lost:
        """Return the pose of the camera that took ``rgb``, uint8 [H, W, 3], or that it is lost.

        Raises ``InvalidInput`` for a picture that is not of the camera's size.
        """
        expected = (self._intrinsics.height_px, self._intrinsics.width_px, 3)
        if rgb.shape != expected or rgb.dtype != np.uint8:
            raise InvalidInput("picture", f"{rgb.dtype} {rgb.shape} must be uint8 {expected}")
        luma = grey(rgb)
        seen = features(luma, self._settings.features)
        if len(seen.uv_px) < self._settings.least_inliers:
            return Lost(Obstacle.FEW_FEATURES, 0)
        furthest, tried = Obstacle.FEW_INLIERS, 0
        for start, view in islice(self._starts(prior), self._settings.most_hypotheses):
            tried += 1
            solution = self._solution(seen, start, view)
            if solution is None:
                continue
            if not prior.allows(solution.world_from_cam):
                furthest = max(furthest, Obstacle.IMPLAUSIBLE)
                continue
            alike = agreement(luma, self._render(solution.world_from_cam))
            if alike >= self._settings.least_agreement:
                return Localised(solution, alike, tried)
            furthest = Obstacle.UNLIKE
        return Lost(furthest, tried)

    def _starts(self, prior: PosePrior) -> Iterator[tuple[Pose, View]]:
        """Yield hypotheses with their renders; the first one tells how far apart the others are."""
        first = self._render(prior.world_from_cam)
        poses = hypotheses(prior, median_depth(first))
        yield next(poses), first
        for pose in poses:
            yield pose, self._render(pose)

    def _solution(self, seen: Features, start: Pose, view: View) -> Solution | None:
        """Return the pose that enough matches agree with, after all rounds, or None."""
        s, k = self._settings, self._intrinsics
        solution = None
        for number in range(s.rounds):
            if solution is not None and number:
                start, view = solution.world_from_cam, self._render(solution.world_from_cam)
            drawn = features(grey(_eight_bits(view.colour)), s.features)
            found = lifted(matched(seen, drawn, s.ratio), view, k, s.least_confidence)
            solution = solved(found, k, start, s.inlier_px)
            if solution is None:
                return None
        assert solution is not None
        return solution if solution.inliers >= s.least_inliers else None

    def _render(self, world_from_cam: Pose) -> View:
        return self._renderer.render(Camera(self._intrinsics, world_from_cam), self._quality)


def agreement(luma: U8, view: View) -> float:
    """Return how much better than chance a picture uint8 [H, W] resembles a render on the spot.

    Both are reduced to local structure (blur taken away, divided by local contrast), so that
    exposure and slow changes of light do not count. Of their cross-correlation at all cyclic
    displacements, the value at zero is compared with those further away than ``NEAR_PX``: in
    standard deviations above their mean. 0 where the best place is not zero displacement, to
    ``ON_THE_SPOT_PX``, or where the field shows too little of the picture.
    """
    shown = view.opacity > 0.5
    if shown.mean() < LEAST_SHOWN:
        return 0.0
    picture = _structure(luma.astype(np.float32), shown)
    drawn = _structure(grey(_eight_bits(view.colour)).astype(np.float32), shown)
    spectrum = np.fft.rfft2(picture) * np.conj(np.fft.rfft2(drawn))
    likeness = np.fft.irfft2(spectrum, s=luma.shape)
    rows, columns = (np.minimum(np.arange(n), n - np.arange(n)) for n in luma.shape)
    distance_px = np.maximum(rows[:, None], columns[None, :])
    chance = likeness[distance_px > NEAR_PX]
    spread = float(chance.std()) if chance.size else 0.0
    best = np.unravel_index(int(likeness.argmax()), likeness.shape)
    if spread == 0.0 or distance_px[best] > ON_THE_SPOT_PX:
        return 0.0
    return float((likeness[0, 0] - chance.mean()) / spread)


def _structure(luma: F32, shown: NDArray[np.bool_]) -> F32:
    """Return luma [H, W] less its blur, by local contrast, 0 where the field shows nothing."""
    fine = luma - cv2.GaussianBlur(luma, (0, 0), BLUR_PX)
    contrast = np.sqrt(cv2.GaussianBlur(fine * fine, (0, 0), 2 * BLUR_PX))
    flat: F32 = np.where(shown, fine / (contrast + np.float32(4)), np.float32(0))
    return flat


def _eight_bits(colour: F32) -> U8:
    """Return colour float32 [H, W, 3], nominally 0..1, as uint8."""
    eight_bits: U8 = np.clip(colour * 255 + 0.5, 0, 255).astype(np.uint8)
    return eight_bits


def median_depth(view: View) -> float:
    """Return the median depth of what a view shows, 0 if it shows nothing."""
    depth_m = view.depth[view.depth > 0]
    return float(np.median(depth_m)) if depth_m.size else 0.0
