"""Transforms of a bag: a tree of frames, whose edges are poses over time.

Names of frames are those of REP 105: ``map`` (fixed, may correct itself), ``odom`` (fixed, smooth,
drifts), ``base_link`` (the vehicle: x forward, y left, z up, REP 103). A picture's frame has the
axes of a camera (x right, y down, z forward), as ``sensor_msgs/Image`` defines it. An edge is
parent_from_child; between two times it is interpolated (``rfcore.motion``), never extrapolated.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from rfcore.camera import Pose
from rfcore.dataset.keys import pose_of_quaternion
from rfcore.errors import DatasetError
from rfcore.motion import interpolated

NS = 1_000_000_000
STEP_NS = NS
"""A clock that goes back by more was set; by less, messages of several senders overtook."""
WORLDS = ("map", "odom")


@dataclass
class Edge:
    """The poses of one frame in its parent."""

    parent: str
    topic: str
    is_static: bool
    samples: dict[int, Pose] = field(default_factory=dict)
    times_ns: Sequence[int] = ()
    newest_ns: int = 0

    def at(self, time_ns: int, max_gap_ns: int) -> Pose | None:
        """Return parent_from_child; None outside the samples and in gaps between them."""
        if self.is_static:
            return next(reversed(self.samples.values()))
        if len(self.times_ns) != len(self.samples):
            self.times_ns = sorted(self.samples)
        after = bisect_left(self.times_ns, time_ns)
        if after == len(self.times_ns) or (after == 0 and self.times_ns[0] != time_ns):
            return None
        if self.times_ns[after] == time_ns:
            return self.samples[time_ns]
        first_ns, second_ns = self.times_ns[after - 1], self.times_ns[after]
        if second_ns - first_ns > max_gap_ns:
            return None
        share = (time_ns - first_ns) / (second_ns - first_ns)
        return interpolated(self.samples[first_ns], self.samples[second_ns], share)


class FrameTree:
    """The edges by the child's name."""

    def __init__(self) -> None:
        self.edges: dict[str, Edge] = {}

    def add(self, topic: str, parent: str, child: str, time_ns: int, pose: Sequence[float]) -> None:
        """Add a sample (x, y, z, and w, x, y, z of the rotation).

        Raises ``DatasetError`` by topic and time for a second parent, a clock that goes back, and
        what is no pose.
        """
        where = f"{topic}, {time_ns / NS:.3f} s: {child} in {parent}"
        is_static = topic.rpartition("/")[2] == "tf_static"
        edge = self.edges.setdefault(child, Edge(parent, topic, is_static))
        if edge.parent != parent or parent == child or not child:
            raise DatasetError(
                f"{where}: frame '{child}' has the parent '{edge.parent}' by {edge.topic}; a frame "
                "of a tree has one"
            )
        if not edge.is_static and edge.newest_ns - time_ns > STEP_NS:
            raise DatasetError(
                f"{where}: the clock steps back by {(edge.newest_ns - time_ns) / NS:.3f} s; cut "
                "the bag there"
            )
        edge.newest_ns = max(edge.newest_ns, time_ns)
        edge.samples[time_ns] = pose_of_quaternion(where, pose[:3], pose[3:])

    def above(self, frame: str) -> list[str]:
        """Return a frame and all frames above it, the root last."""
        found = [frame]
        while (edge := self.edges.get(found[-1])) is not None:
            if edge.parent in found:
                raise DatasetError(f"frames {', '.join(found)} are a circle; a tree has none")
            found.append(edge.parent)
        return found

    def moves(self, frames: Iterable[str]) -> bool:
        """Return whether any of the edges above these frames changes over time."""
        return any(frame in self.edges and not self.edges[frame].is_static for frame in frames)

    def world_above(self, frame: str) -> str | None:
        """Return map, else odom, else the root; None if nothing between it and the frame moves."""
        names = self.above(frame)
        for wanted in WORLDS:
            for i, name in enumerate(names[1:], 1):
                if name.rpartition("/")[2] == wanted and self.moves(names[:i]):
                    return name
        return names[-1] if self.moves(names[:-1]) else None

    def pose(self, world: str, frame: str, time_ns: int, max_gap_ns: int) -> Pose | None:
        """Return world_from_frame at a time; None where an edge has no pose then, or none leads."""
        up, down = self.above(frame), self.above(world)
        common = next((name for name in up if name in down), None)
        if common is None:
            return None
        root_from = []
        for names in (down, up):
            pose: Pose | None = Pose.identity()
            for name in names[: names.index(common)]:
                step = self.edges[name].at(time_ns, max_gap_ns)
                if step is None or pose is None:
                    return None
                pose = step.compose(pose)
            root_from.append(pose)
        common_from_world, common_from_frame = root_from
        assert common_from_world is not None
        assert common_from_frame is not None
        return common_from_world.inverse().compose(common_from_frame)
