"""The pose of a camera from one picture: a search around what is known, and checks before belief.

For each hypothesis around the prior, nearest first: render there, match features of the picture and
the render, solve for the pose (``rfcore.localise.matching``); then once more from a render at the
pose found, which resembles the picture more. A pose is accepted if it passes four checks:

* inliers: enough matches agree with it;
* prior: it is not implausibly far from what was known;
* alignment: aligned photometrically, the pose is where the picture and its render agree;
* agreement: the render at the pose resembles the picture, pixel on pixel, far better than chance;
* nearness: what is near lies where the picture has it, or far matches alone made the pose.

The first hypothesis is tried with pictures of half the resolution first, whose features take a
quarter of the time: where that passes every check, as it mostly does, nothing else is looked at.

Otherwise the next hypothesis is tried, and after the last one the camera is lost: no pose is given.
No clock and no chance: the same picture, field and prior give the same answer.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field import FULL, Quality, Renderer, render_field_view
from rfcore.image import rgb_from_colour
from rfcore.localise.agreement import agreement
from rfcore.localise.estimate import PosePrior, hypotheses
from rfcore.localise.matching import (
    Features,
    PnpSolution,
    Pyramid,
    find_features,
    grey,
    lift_matches,
    match_features,
    solve_pose,
)
from rfcore.localise.track import Track, begin_track
from rfcore.views import FieldView, View

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

MOST_ALIGNMENTS = 3
"""A pose that alignment still moves is aligned again, so often at most: of few matches, all far
away, features make poses that are decimetres off, and one alignment goes half the way.
"""
LEAST_HALVED_PX = 90
"""Shorter side of a halved picture that is looked at for features."""


@dataclass(frozen=True)
class LocaliserSettings:
    """Thresholds of the search: which matches count, and which poses are believed.

    Raises ``InvalidInput`` for a value that is not above 0.
    """

    features: int = 2000
    """Largest number of features of the picture, and of a render."""
    ratio: float = 0.8
    """A match is kept if its distance is below this share of the second nearest's."""
    least_confidence: float = 0.5
    """Features of a render need a depth that its renderer trusts this far, 0..1."""
    inlier_px: float = 2.0
    """Matches that reproject this near agree with a pose."""
    first_inlier_px: float = 3.0
    """And this near in the first round, in which picture and render were taken metres apart."""
    least_inliers: int = 20
    """So many matches must agree with a pose."""
    least_first_inliers: int = 8
    """And so many after the first round; chance alone makes 6."""
    least_agreement: float = 10.0
    """Standard deviations of chance by which the render at a pose must resemble the picture."""
    least_on_the_spot: float = 0.4
    """Share of the nearer half of the picture that must lie where the render has it."""
    rounds: int = 2
    """Renders and solutions of a hypothesis."""
    most_hypotheses: int = 37
    """Give up after so many, whatever the prior."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise InvalidInput(f"localiser.{name}", f"{value} must be above 0")


class Obstacle(IntEnum):
    """The check that a hypothesis failed, in the order of the checks."""

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

    solution: PnpSolution
    agreement: float
    hypotheses: int

    @property
    def world_from_cam(self) -> Pose:
        """The pose found."""
        return self.solution.world_from_cam


@dataclass(frozen=True)
class Lost:
    """No pose was found: the check that the best hypothesis failed, and how many were tried."""

    obstacle: Obstacle
    hypotheses: int


class Localiser:
    """Finds the poses of pictures of one camera in one field, drawn at ``quality``.

    A search that starts 1 m beside the right pose ends within a centimetre of it:

    >>> import math
    >>> from pathlib import Path
    >>> from rfcore.dataset import read_dataset
    >>> from rfcore.field import load_field
    >>> from rfcore.localise.localiser import Localiser
    >>> from rfcore.localise.estimate import PosePrior, moved
    >>> picture = read_dataset(Path("samples/street/transforms_drive_empty.json")).pictures[0]
    >>> right = picture.camera.world_from_cam
    >>> localiser = Localiser(
    ...     load_field(Path("samples/fields/street.rff")), picture.camera.intrinsics
    ... )
    >>> prior = PosePrior(moved(right, (1.0, 0.0, 0.0)), position_m=1.0, rotation_deg=3.0)
    >>> found = localiser.localise(picture.read(), prior).world_from_cam
    >>> math.dist(found.translation_m, right.translation_m) < 0.01
    True
    """

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
        return self.localise_luma(grey(rgb), prior)

    def localise_luma(self, luma: U8, prior: PosePrior) -> Localised | Lost:
        """Return the pose of the camera that took a picture of full-range luma, uint8 [H, W]."""
        starts: Iterator[tuple[Pose, View]]
        starts = islice(self._starts(prior), self._settings.most_hypotheses)
        coarse = self._features(luma, 1)
        if coarse is not None:
            first = next(starts)
            answer = self._tried(luma, prior, coarse, *first)
            if not isinstance(answer, Obstacle):
                return Localised(*answer, 1)
            starts = chain([first], starts)
        seen = self._features(luma, 0)
        if seen is None:
            return Lost(Obstacle.FEW_FEATURES, 0)
        furthest, tried = Obstacle.FEW_INLIERS, 0
        for tried, start in enumerate(starts, 1):
            answer = self._tried(luma, prior, seen, *start)
            if not isinstance(answer, Obstacle):
                return Localised(*answer, tried)
            furthest = max(furthest, answer)
        return Lost(furthest, tried)

    def again(self, luma: U8, prior: PosePrior) -> Pose | None:
        """Return where a picture was taken shortly after one whose pose, the prior's, was found.

        By the features of half the resolution and one render, a quarter of a search's time. Only
        inliers and the prior speak for it: it says where to begin a track, which checks it.
        """
        seen = self._features(luma, 1) or self._features(luma, 0)
        if seen is None:
            return None
        view = self._render(prior.world_from_cam)
        solution = self._solution(seen, prior.world_from_cam, view, 1)
        if solution is None or solution.inliers < self._settings.least_inliers:
            return None
        return solution.world_from_cam if prior.allows(solution.world_from_cam) else None

    def _features(self, luma: U8, halvings: int) -> Features | None:
        """Return a picture's features; None where they, or the halved picture, are too few."""
        if halvings and min(luma.shape) < 2 * LEAST_HALVED_PX:
            return None
        seen = find_features(luma, self._settings.features, halvings)
        return seen if len(seen.uv_px) >= self._settings.least_inliers else None

    def _tried(
        self, luma: U8, prior: PosePrior, seen: Features, start: Pose, view: View
    ) -> tuple[PnpSolution, float] | Obstacle:
        """Return the pose that a hypothesis leads to and its agreement, or what kept it from it."""
        solution = self._solution(seen, start, view, self._settings.rounds)
        if solution is None:
            return Obstacle.FEW_INLIERS
        if not prior.allows(solution.world_from_cam):
            return Obstacle.IMPLAUSIBLE
        return self._agreement(luma, solution) or Obstacle.UNLIKE

    def _starts(self, prior: PosePrior) -> Iterator[tuple[Pose, View]]:
        """Yield hypotheses with their renders; the first one tells how far apart the others are."""
        first = self._render(prior.world_from_cam)
        poses = hypotheses(prior, median_depth(first))
        yield next(poses), first
        for pose in poses:
            yield pose, self._render(pose)

    def _solution(self, seen: Features, start: Pose, view: View, rounds: int) -> PnpSolution | None:
        """Return the pose that enough matches agree with, after so many rounds, or None."""
        s, k = self._settings, self._intrinsics
        solution = None
        for number in range(rounds):
            if solution is not None:
                start, view = solution.world_from_cam, self._render(solution.world_from_cam)
            drawn = find_features(grey(rgb_from_colour(view.colour)), s.features, seen.halvings)
            found = lift_matches(match_features(seen, drawn, s.ratio), view, k, s.least_confidence)
            solution = solve_pose(found, k, start, s.inlier_px if number else s.first_inlier_px)
            least = s.least_inliers if number else s.least_first_inliers
            if solution is None or solution.inliers < least:
                return None
        return solution

    def _agreement(self, luma: U8, solution: PnpSolution) -> tuple[PnpSolution, float] | None:
        """Return the solution aligned photometrically, and its agreement; None if refuted."""
        track = self._settled(Pyramid(luma), solution.world_from_cam)
        if track is None:
            return None
        alike = agreement(luma, self._render(track.world_from_cam))
        if alike < self._settings.least_agreement:
            return None
        return replace(solution, world_from_cam=track.world_from_cam), alike

    def _settled(self, levels: Pyramid, near: Pose) -> Track | None:
        """Return a pose aligned with a picture's pyramid; None where that refutes it."""

        def render_at(pose: Pose) -> FieldView:
            return render_field_view(
                self._renderer, Camera(self._intrinsics, pose).rounded(), self._quality
            )

        share = self._settings.least_on_the_spot
        return begin_track(0, near, None, levels, render_at, MOST_ALIGNMENTS, share)

    def _render(self, world_from_cam: Pose) -> View:
        return self._renderer.render(Camera(self._intrinsics, world_from_cam), self._quality)


def median_depth(view: View) -> float:
    """Return the median depth of what a view shows, 0 if it shows nothing."""
    depth_m = view.depth[view.depth > 0]
    return float(np.median(depth_m)) if depth_m.size else 0.0
