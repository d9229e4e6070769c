"""Following a camera from one picture to the next: prediction, alignment, render, check.

A picture is aligned with the field as it was rendered for the picture before, moved by what is
predicted, so that alignment needs no render of its own: the one at the pose found is the one that
the codec needs. It is also a better template, since it stands where the camera stands; what
aligning with it still corrects is the error of the pose just rendered at. Where that is more than a
fraction of a pixel, and time allows, the field is rendered again there.
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
from rfcore.localise.structure import Pyramid
from rfcore.motion import quaternion_from_vector, rotation_vector
from rfcore.views import FieldView

__all__ = [
    "HALF",
    "Effort",
    "Motion",
    "RenderAt",
    "Track",
    "TrackSettings",
    "begun",
    "followed",
]

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
HALF = 1
"""The level of a pyramid at half the resolution."""
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
class TrackSettings:
    """When a track is believed. Lengths are shares of the median depth of what is seen."""

    least_agreement: float = 15.0
    """``agreement_on_track`` of the render at the pose: between right places, 28 and more, and
    others, 8 at most."""
    least_on_the_spot: float = 0.4
    """Share of the nearer half of the picture that must lie where the render has it, for a track to
    begin (``near_on_the_spot``)."""
    least_of_last_agreement: float = 0.55
    """Share of the last picture's agreement: poses that drift fall below before they are wrong."""
    expected_of_depth: float = 0.02
    """How far a prediction is off, one sigma; 0.2 m in a street."""
    expected_deg: float = 0.7
    drift_of_motion: float = 0.2
    """Share of the motion since the last picture that a prediction may be wrong by."""
    settled_of_depth: float = 0.003
    """How far a pose that was rendered at is expected to be off, one sigma."""
    settled_deg: float = 0.05
    redraw_px: float = 0.25
    """A correction that moves the pixels that were aligned by more is worth another render."""
    first_step_px: float = 0.4
    """The first picture after a track began must lie as near as this."""
    most_px: float = 3.0
    """A pose that is still off by more was not found."""
    first_step_renders: int = 2
    """Renders more for the first picture after a track began, at least: it has not seen yet how the
    camera moves, so the pose found may be far from the one to be found."""
    unknown_speed_m_s: float = 10.0
    """While only one pose is known, the next one may be this far."""
    fine_levels: int = 1
    """At so many of the finest levels that take part the pose that was rendered at is corrected."""
    longest_gap_s: float = 1.5
    """Over longer times no motion is predicted."""

    def expected(self, template: Template) -> Expected:
        """Return how far a prediction is off."""
        metres = self.expected_of_depth * template.median_depth
        return Expected(metres, math.radians(self.expected_deg))


@dataclass(frozen=True)
class Effort:
    """What a frame's tracking may cost beyond the render at the pose sent."""

    renders: int = 1
    """Renders more, at most."""
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

    ``view``: the field at the pose to send. ``world_from_cam``: the same pose corrected by what
    aligning with that view still showed, better but never rendered. ``covariance`` [6, 6]: of
    metres and radians in the camera's axes, by the residuals alone. ``motion``: ``None`` while only
    one pose is known. ``correction_px``: how far off the pose sent is. ``renders``: made for it.
    ``motion_scale``: how much longer movements are than aligning with the view before says: as much
    as the field's depth is wrong there, by which it measures them. ``steps``: pictures that it was
    followed to since it began.
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

    def predicted(self, time_ns: int, odometry: Pose | None = None) -> Pose:
        """Return where the camera is expected at a later time; without motion, where it was."""
        if odometry is not None:
            return self.world_from_cam.compose(odometry)
        motion = self.motion or Motion()
        return self.world_from_cam.compose(motion.over((time_ns - self.time_ns) / 1e9))


def begun(
    time_ns: int,
    near: Pose,
    expected: Expected | None,
    picture: Pyramid,
    render_at: RenderAt,
    settings: TrackSettings,
    alignments: int = 1,
) -> Track | None:
    """Return the track that begins with a picture taken near a pose; None if it is not there.

    ``expected``: how far off the pose is; ``None``: as far as a prediction. Two renders or three
    for each of so many ``alignments``, at most: a pose that alignment still moves is aligned again.

    A track that is followed was right a moment ago, one that begins may have been anywhere: of
    tries 0.5 to 2.5 m off in the sample's street two thirds of what passed the checks of a followed
    one were 0.1 to 2.3 m wrong. So what is near must lie on the spot, too.
    """
    track = None
    for _ in range(alignments):
        made = _aligned_anew(time_ns, near, expected, picture, render_at, settings)
        track = None if made is None else _checked(made, picture, render_at, settings, Effort())
        if track is None:
            return None
        if track.correction_px <= settings.redraw_px:
            break
        near, expected = track.world_from_cam, None
    if track is None or _on_the_spot(track, picture) < settings.least_on_the_spot:
        return None
    return track


def _on_the_spot(track: Track, picture: Pyramid) -> float:
    """Return which share of the near blocks of a track's view lies where the picture has them."""
    return near_on_the_spot(picture[HALF], track.template.structures[HALF], track.view)


def followed(
    track: Track,
    time_ns: int,
    picture: Pyramid,
    render_at: RenderAt,
    settings: TrackSettings,
    effort: Effort,
    odometry: Pose | None = None,
) -> Track | None:
    """Return the track with one picture more, a pyramid, taken at ``time_ns``; None if it is lost.

    ``odometry``: the later camera's pose in the axes of the earlier, where a sensor measured it.
    """
    seconds = (time_ns - track.time_ns) / 1e9
    if track.steps == 0:
        effort = replace(effort, renders=max(effort.renders, settings.first_step_renders))
    predicted = track.predicted(time_ns, odometry)
    expected = _expected(track, predicted, seconds, settings)
    drawn = track.view.camera.world_from_cam
    aligned = _aligned_from(track, predicted, picture, expected, effort.finest)
    if aligned is not None:
        found = _stretched(track, drawn.compose(aligned.motion.inverse()))
        made = _Candidate(time_ns, found, 0, (track, seconds), found)
        better = _checked(made, picture, render_at, settings, effort)
        if better is not None or effort.renders < 1:
            return better
    elif effort.renders < 1:
        return None
    anew = _aligned_anew(time_ns, predicted, expected, picture, render_at, settings, effort.finest)
    if anew is None:
        return None
    made = replace(anew, before=(track, seconds))
    left = effort.renders - 1 if made.is_first_step else 0
    return _checked(made, picture, render_at, settings, replace(effort, renders=left))


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
    settings: TrackSettings,
    finest: int = 0,
) -> _Candidate | None:
    """Return where a picture was taken, by a render near there; None where nothing agrees."""
    view = render_at(near)
    template = Template.of(view)
    expected = expected or settings.expected(template)
    aligned = align(template, picture, Pose.identity(), expected, finest=finest)
    if aligned is None:
        return None
    found = view.camera.world_from_cam.compose(aligned.motion.inverse())
    return _Candidate(time_ns, found, 1)


@dataclass(frozen=True)
class _Candidate:
    """A pose to be rendered at, and believed or not, after so many ``renders``; ``before``: the
    track so far, and the seconds since; ``followed_to``: where aligning with its view led."""

    time_ns: int
    world_from_cam: Pose
    renders: int
    before: tuple[Track, float] | None = None
    followed_to: Pose | None = None

    @property
    def is_first_step(self) -> bool:
        """Whether it was predicted from a track that has just begun, and no motion seen by it."""
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

    def least_agreement(self, settings: TrackSettings) -> float:
        """Return what the render must reach: enough, and not much less than the last one."""
        if self.before is None:
            return settings.least_agreement
        last = settings.least_of_last_agreement * self.before[0].agreement
        return max(settings.least_agreement, last)

    def motion_to(self, pose: Pose) -> Motion | None:
        """Return the motion from the track so far to a pose."""
        if self.before is None:
            return None
        track, seconds = self.before
        return Motion.between(track.world_from_cam, pose, seconds)


def _checked(
    made: _Candidate,
    picture: Pyramid,
    render_at: RenderAt,
    settings: TrackSettings,
    effort: Effort,
) -> Track | None:
    """Return the candidate as a track if the render there resembles the picture.

    The first step of a track is predicted so loosely that alignment may have ended where what is
    far away agrees and what is near was taken for something that the field does not have: it is
    settled from coarse to fine, and must stay where it is. Hypothesis found a pose 0.2 m off, whose
    finest level alone still moved it by 0.6 px; all levels move it by 2.3, to the right one.
    A later picture that is off by enough to be drawn again is aligned from coarse to fine, too: its
    prediction was wrong by more than the finest level reaches (cars that turn, five pictures a
    second: two renders more still left 1.5 px).
    """
    view, renders = render_at(made.world_from_cam), made.renders + 1
    template = Template.of(view)
    agrees = agreement_on_track(picture[HALF], template.structures[HALF], view)
    if agrees < made.least_agreement(settings):
        return None
    aligned = _settled(template, picture, settings, effort.finest, coarsely=made.is_first_step)
    if aligned is None:
        return None
    off_px = template.moved_px(aligned.motion, effort.finest)
    if off_px > settings.redraw_px and effort.renders > 0:
        if not made.is_first_step:
            aligned = _settled(template, picture, settings, effort.finest, coarsely=True)
            if aligned is None:
                return None
        there = view.camera.world_from_cam.compose(aligned.motion.inverse())
        again = replace(made, world_from_cam=there, renders=renders)
        return _checked(
            again, picture, render_at, settings, replace(effort, renders=effort.renders - 1)
        )
    if off_px > (settings.first_step_px if made.is_first_step else settings.most_px):
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
    settings: TrackSettings,
    finest: int,
    *,
    coarsely: bool,
) -> Aligned | None:
    """Return what still moves a picture against the render at its own pose; ``coarsely``: as if
    that were but a prediction."""
    if coarsely:
        return align(template, picture, Pose.identity(), settings.expected(template), None, finest)
    expected = Expected(
        settings.settled_of_depth * template.median_depth, math.radians(settings.settled_deg)
    )
    return align(template, picture, Pose.identity(), expected, settings.fine_levels, finest)


def _expected(track: Track, predicted: Pose, seconds: float, settings: TrackSettings) -> Expected:
    """Return how far the prediction may be off."""
    moved = track.world_from_cam.inverse().compose(predicted)
    metres = settings.expected_of_depth * track.template.median_depth
    metres += settings.drift_of_motion * math.hypot(*moved.translation_m)
    turned = math.hypot(*rotation_vector(moved.rotation))
    if track.motion is None:
        metres += settings.unknown_speed_m_s * seconds
    radians = math.radians(settings.expected_deg) + settings.drift_of_motion * turned
    return Expected(metres, radians)


def _covariance(aligned: Aligned) -> F64:
    """Return the covariance [6, 6] of a motion; infinite where the picture says nothing."""
    try:
        found: F64 = np.linalg.inv(aligned.hessian).astype(np.float64)
    except np.linalg.LinAlgError:
        return np.full((6, 6), np.inf)
    return found
