"""Follow a camera from one picture to the next: prediction, alignment, render, check.

A picture is aligned with the field as it was rendered for the picture before, moved by the
predicted motion. So alignment needs no render of its own: the field is rendered once, at the pose
found, where the codec needs it. That render is also the better template, since it stands where the
camera stands: aligning with it shows the error of the pose that was just rendered at. Where the
error is more than a fraction of a pixel, and time allows, the field is rendered again there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Pose, Vec3
from rfcore.localise.agreement import agreement_on_track, near_on_the_spot
from rfcore.localise.alignment import Aligned, Expected, Template, align
from rfcore.localise.matching import Pyramid
from rfcore.motion import quaternion_from_vector, rotation_vector
from rfcore.views import FieldView

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
HALF = 1
"""The level of a pyramid at half the resolution."""
LEAST_AGREEMENT = 15.0
"""``agreement_on_track`` that the render at a pose must reach: it is 28 and more at right places, 8
at most at others."""
LEAST_OF_LAST_AGREEMENT = 0.55
"""Share of the last picture's agreement: poses that drift fall below before they are wrong."""
LEAST_ON_THE_SPOT = 0.4
"""Share of the nearer half of the picture that must lie where the render has it, for a track to
begin (``near_on_the_spot``)."""
EXPECTED_OF_DEPTH, EXPECTED_DEG = 0.02, 0.7
"""Error of a prediction, one sigma: a share of the median depth (0.2 m in a street)."""
DRIFT_OF_MOTION = 0.2
"""Share of the motion since the last picture that a prediction may be wrong by."""
UNKNOWN_SPEED_M_S = 10.0
"""While only one pose is known, the next one may be this far."""
SETTLED_OF_DEPTH, SETTLED_DEG = 0.003, 0.05
"""Expected error of a pose that was rendered at, one sigma."""
REDRAW_PX = 0.25
"""A correction that moves the pixels that were aligned by more is worth another render."""
FIRST_STEP_PX, MOST_PX = 0.4, 3.0
"""A pose that is still off by more was not found; the first picture after a track began must lie
nearer."""
FIRST_STEP_RENDERS = 2
"""Renders more for the first picture after a track began, at least: it has not seen yet how the
camera moves, so the pose found may be far from the one to be found."""
FINE_LEVELS = 1
"""Number of the finest levels at which the pose that was rendered at is corrected."""
LONGEST_GAP_S = 1.5
"""Over longer times no motion is predicted."""
UNKNOWN_AHEAD = (0.0, 0.03, 0.06, 0.1, 0.15)
"""Motions to the next picture that are tried while none is known: shares of the median depth."""
NO_TURN = (1.0, 0.0, 0.0, 0.0)
LEAST_MOVED_OF_DEPTH = 0.01
"""Shorter movements, as a share of the median depth, do not show the scale of motions."""
SCALE_GAIN, MOST_SCALED = 0.25, 0.15
"""Weight of the newest movement in that scale, and how far from 1 it may be."""
RenderAt = Callable[[Pose], FieldView]
"""Renders the field at a pose, rounded as it will be sent."""


@dataclass(frozen=True)
class TrackingBudget:
    """Limits of what tracking a frame costs beyond the render at the pose sent."""

    renders: int = 1
    """Largest number of further renders."""
    finest: int = 0
    """The finest level of the pyramids that takes part."""


@dataclass(frozen=True)
class Motion:
    """A steady motion in the camera's axes: metres and a rotation vector, a second."""

    metres: Vec3 = (0.0, 0.0, 0.0)
    radians: Vec3 = (0.0, 0.0, 0.0)

    @staticmethod
    def between(before: Pose, after: Pose, seconds: float) -> Motion:
        """Return the motion that leads from one pose to the other in so many seconds."""
        moved = before.inverse().compose(after)
        x, y, z = (value / seconds for value in moved.translation_m)
        a, b, c = (value / seconds for value in rotation_vector(moved.rotation))
        return Motion((x, y, z), (a, b, c))

    def over(self, seconds: float) -> Pose:
        """Return the later camera's pose in the axes of the earlier, after so many seconds."""
        x, y, z = (value * seconds for value in self.metres)
        a, b, c = (value * seconds for value in self.radians)
        return Pose((x, y, z), quaternion_from_vector((a, b, c)))


@dataclass(frozen=True, eq=False)
class Track:
    """A camera that was found in a picture at ``time_ns``.

    ``view`` shows the field at the pose to send. ``world_from_cam`` is that pose corrected by what
    aligning with the view still showed: better, but never rendered. ``covariance`` [6, 6] is that
    of metres and radians in the camera's axes, by the residuals alone. ``motion`` is ``None`` while
    only one pose is known. ``correction_px`` is how far off the pose sent is, ``renders`` how many
    were made for it. ``motion_scale`` is the factor by which movements are longer than aligning
    with the view before says, since the field's depth is wrong there. ``steps`` counts the pictures
    that it was followed to since it began.
    """

    time_ns: int
    view: FieldView
    template: Template
    world_from_cam: Pose
    covariance: F64
    agreement: float
    motion: Motion | None
    correction_px: float
    renders: int
    motion_scale: float = 1.0
    steps: int = 0

    def predicted(self, time_ns: int) -> Pose:
        """Return where the camera is expected at a later time; without motion, where it was."""
        motion = self.motion or Motion()
        return self.world_from_cam.compose(motion.over((time_ns - self.time_ns) / 1e9))


def begin_track(
    time_ns: int,
    near: Pose,
    expected: Expected | None,
    picture: Pyramid,
    render_at: RenderAt,
    alignments: int = 1,
    least_on_the_spot: float = LEAST_ON_THE_SPOT,
) -> Track | None:
    """Return the track that begins with a picture taken near a pose; None if it is not there.

    ``expected`` says how far off the pose is; ``None`` stands for the error of a prediction. A pose
    that alignment still moves is aligned again, at most ``alignments`` times, with two renders or
    three each.

    A track that begins may be anywhere: of tries 0.5 to 2.5 m off, two thirds of those that passed
    the checks of a followed track were wrong. So near surfaces must lie where the picture has them.
    """
    track = None
    for _ in range(alignments):
        made = _aligned_anew(time_ns, near, expected, picture, render_at)
        track = None if made is None else _checked(made, picture, render_at, TrackingBudget())
        if track is None:
            return None
        if track.correction_px <= REDRAW_PX:
            break
        near, expected = track.world_from_cam, None
    if track is None or _on_the_spot(track, picture) < least_on_the_spot:
        return None
    return track


def _on_the_spot(track: Track, picture: Pyramid) -> float:
    """Return which share of the near blocks of a track's view lies where the picture has them."""
    return near_on_the_spot(picture[HALF], track.template.structures[HALF], track.view)


def follow_track(
    track: Track,
    time_ns: int,
    picture: Pyramid,
    render_at: RenderAt,
    budget: TrackingBudget,
) -> Track | None:
    """Return the track with one more picture, taken at ``time_ns``; None if it is lost."""
    seconds = (time_ns - track.time_ns) / 1e9
    if track.steps == 0:
        budget = replace(budget, renders=max(budget.renders, FIRST_STEP_RENDERS))
    predicted = track.predicted(time_ns)
    expected = _expected(track, predicted, seconds)
    drawn = track.view.camera.world_from_cam
    aligned = _aligned_from(track, predicted, picture, expected, budget.finest)
    if aligned is not None:
        found = _stretched(track, drawn.compose(aligned.motion.inverse()))
        made = _PoseCandidate(time_ns, found, 0, (track, seconds), found)
        better = _checked(made, picture, render_at, budget)
        if better is not None or budget.renders < 1:
            return better
    elif budget.renders < 1:
        return None
    anew = _aligned_anew(time_ns, predicted, expected, picture, render_at, budget.finest)
    if anew is None:
        return None
    made = replace(anew, before=(track, seconds))
    left = budget.renders - 1 if made.is_first_step else 0
    return _checked(made, picture, render_at, replace(budget, renders=left))


def _aligned_from(
    track: Track, predicted: Pose, picture: Pyramid, expected: Expected, finest: int
) -> Aligned | None:
    """Return the motion from the track's view to a picture, from where it is predicted.

    While no motion is known, several speeds ahead are tried; the one that leaves least is taken.
    """
    drawn = track.view.camera.world_from_cam
    ahead = (0.0,) if track.motion is not None else UNKNOWN_AHEAD
    found = [
        align(
            track.template,
            picture,
            predicted.compose(Pose((0.0, 0.0, share * track.template.median_depth), NO_TURN))
            .inverse()
            .compose(drawn),
            expected,
            finest=finest,
        )
        for share in ahead
    ]
    return min((f for f in found if f is not None), key=lambda f: f.spread, default=None)


def _moved(before: Pose, after: Pose) -> F64:
    """Return by how much a camera moved, in its axes before."""
    return np.array(before.inverse().compose(after).translation_m)


def _stretched(track: Track, found: Pose) -> Pose:
    """Return a pose to which the track was followed, its movement scaled as was learnt."""
    more = (track.motion_scale - 1) * _moved(track.world_from_cam, found)
    x, y, z = (float(value) for value in more)
    by = Pose((x, y, z), NO_TURN)
    return track.world_from_cam.compose(by).compose(track.world_from_cam.inverse()).compose(found)


def _aligned_anew(
    time_ns: int,
    near: Pose,
    expected: Expected | None,
    picture: Pyramid,
    render_at: RenderAt,
    finest: int = 0,
) -> _PoseCandidate | None:
    """Return where a picture was taken, by a render near there; None where nothing agrees."""
    view = render_at(near)
    template = Template.of(view)
    expected = expected or _expected_of_prediction(template)
    aligned = align(template, picture, Pose.identity(), expected, finest=finest)
    if aligned is None:
        return None
    found = view.camera.world_from_cam.compose(aligned.motion.inverse())
    return _PoseCandidate(time_ns, found, 1)


@dataclass(frozen=True)
class _PoseCandidate:
    """A pose to be rendered at and checked, after so many ``renders``.

    ``before`` is the track so far and the seconds since; ``followed_to`` is where aligning with its
    view led.
    """

    time_ns: int
    world_from_cam: Pose
    renders: int
    before: tuple[Track, float] | None = None
    followed_to: Pose | None = None

    @property
    def is_first_step(self) -> bool:
        """Whether it was predicted from a track that has just begun and has seen no motion."""
        return self.before is not None and self.before[0].steps == 0

    def motion_scale(self, pose: Pose) -> float:
        """Return the scale of motions, once the camera was found to be at a pose."""
        if self.before is None:
            return 1.0
        track = self.before[0]
        if self.followed_to is None:
            return track.motion_scale
        taken, made = (_moved(track.world_from_cam, to) for to in (self.followed_to, pose))
        squared = float(taken @ taken)
        if squared < (LEAST_MOVED_OF_DEPTH * track.template.median_depth) ** 2:
            return track.motion_scale
        seen = track.motion_scale * float(taken @ made) / squared
        learnt = track.motion_scale + SCALE_GAIN * (seen - track.motion_scale)
        return min(max(learnt, 1 - MOST_SCALED), 1 + MOST_SCALED)

    def least_agreement(self) -> float:
        """Return what the render must reach: enough, and not much less than the last one."""
        if self.before is None:
            return LEAST_AGREEMENT
        last = LEAST_OF_LAST_AGREEMENT * self.before[0].agreement
        return max(LEAST_AGREEMENT, last)

    def motion_to(self, pose: Pose) -> Motion | None:
        """Return the motion from the track so far to a pose."""
        if self.before is None:
            return None
        track, seconds = self.before
        return Motion.between(track.world_from_cam, pose, seconds)


def _checked(
    made: _PoseCandidate,
    picture: Pyramid,
    render_at: RenderAt,
    budget: TrackingBudget,
) -> Track | None:
    """Return the candidate as a track if the render there resembles the picture.

    The first step of a track is predicted so loosely that alignment may have ended where only
    distant surfaces agree. It is therefore aligned again from coarse to fine, and must stay where
    it is; so is a later picture that is off by more than the finest level reaches.
    """
    view, renders = render_at(made.world_from_cam), made.renders + 1
    template = Template.of(view)
    agrees = agreement_on_track(picture[HALF], template.structures[HALF], view)
    if agrees < made.least_agreement():
        return None
    aligned = _settled(template, picture, budget.finest, coarsely=made.is_first_step)
    if aligned is None:
        return None
    off_px = template.moved_px(aligned.motion, budget.finest)
    if off_px > REDRAW_PX and budget.renders > 0:
        if not made.is_first_step:
            aligned = _settled(template, picture, budget.finest, coarsely=True)
            if aligned is None:
                return None
        there = view.camera.world_from_cam.compose(aligned.motion.inverse())
        again = replace(made, world_from_cam=there, renders=renders)
        return _checked(again, picture, render_at, replace(budget, renders=budget.renders - 1))
    if off_px > (FIRST_STEP_PX if made.is_first_step else MOST_PX):
        return None
    pose = view.camera.world_from_cam.compose(aligned.motion.inverse())
    return Track(
        made.time_ns,
        view,
        template,
        pose,
        _covariance(aligned),
        agrees,
        made.motion_to(pose),
        off_px,
        renders,
        made.motion_scale(pose),
        0 if made.before is None else made.before[0].steps + 1,
    )


def _settled(
    template: Template,
    picture: Pyramid,
    finest: int,
    *,
    coarsely: bool,
) -> Aligned | None:
    """Return the remaining motion of a picture against the render at its own pose.

    ``coarsely`` aligns all levels, as if the pose were a prediction.
    """
    if coarsely:
        return align(
            template, picture, Pose.identity(), _expected_of_prediction(template), None, finest
        )
    expected = Expected(SETTLED_OF_DEPTH * template.median_depth, math.radians(SETTLED_DEG))
    return align(template, picture, Pose.identity(), expected, FINE_LEVELS, finest)


def _expected_of_prediction(template: Template) -> Expected:
    return Expected(EXPECTED_OF_DEPTH * template.median_depth, math.radians(EXPECTED_DEG))


def _expected(track: Track, predicted: Pose, seconds: float) -> Expected:
    """Return how far the prediction may be off."""
    moved = track.world_from_cam.inverse().compose(predicted)
    metres = EXPECTED_OF_DEPTH * track.template.median_depth
    metres += DRIFT_OF_MOTION * math.hypot(*moved.translation_m)
    turned = math.hypot(*rotation_vector(moved.rotation))
    if track.motion is None:
        metres += UNKNOWN_SPEED_M_S * seconds
    radians = math.radians(EXPECTED_DEG) + DRIFT_OF_MOTION * turned
    return Expected(metres, radians)


def _covariance(aligned: Aligned) -> F64:
    """Return the covariance [6, 6] of a motion; infinite where the picture says nothing."""
    try:
        found: F64 = np.linalg.inv(aligned.hessian).astype(np.float64)
    except np.linalg.LinAlgError:
        return np.full((6, 6), np.inf)
    return found
