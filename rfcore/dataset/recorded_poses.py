"""Where a recording's camera is at a time: the section [trajectory] of ``camera.toml``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rfcore.camera import Pose
from rfcore.dataset.keys import POSE_SHAPES, pose_of_rows
from rfcore.dataset.picture_file import inside
from rfcore.dataset.trajectory import NS_PER_S, Trajectory, read_trajectory
from rfcore.tables import Range, Table

__all__ = ["RecordedPoses"]


@dataclass(frozen=True)
class RecordedPoses:
    """Poses over time. Times are the pictures' own, nanoseconds; ``offset_ns`` more is the
    trajectory's."""

    trajectory: Trajectory
    offset_ns: int
    max_gap_ns: int
    drop_outside: bool
    body_from_cam: Pose

    @staticmethod
    def of(file: Path, keys: Table) -> RecordedPoses:
        """Read what the section of ``file`` names; raise ``DatasetError`` naming file and key."""
        where = f"{file}: [trajectory]"
        outside = keys.choice("outside", ("refuse", "drop"), "refuse")
        body_from_cam = Pose.identity()
        if "body_from_cam" in keys:
            rows = keys.matrix("body_from_cam", POSE_SHAPES)
            body_from_cam = pose_of_rows(where, "body_from_cam", rows)
        offset_s = keys.number("time_offset_s", default=0.0)
        max_gap_s = keys.number("max_gap_s", Range(0.0), 1.0)
        return RecordedPoses(
            trajectory=read_trajectory(inside(where, file.parent, keys.text("file"))),
            offset_ns=round(offset_s * NS_PER_S),
            max_gap_ns=round(max_gap_s * NS_PER_S),
            drop_outside=outside == "drop",
            body_from_cam=body_from_cam,
        )

    def wanted(self, time_ns: int) -> bool:
        """Whether a picture of that time is not to be left out."""
        return not self.drop_outside or self.trajectory.covers(time_ns + self.offset_ns)

    def at(self, where: str, time_ns: int) -> Pose:
        """Return world_from_cam; raise ``DatasetError`` naming ``where`` if it is not known."""
        time_ns += self.offset_ns
        world_from_body = self.trajectory.pose_at(where, time_ns, self.max_gap_ns)
        return world_from_body.compose(self.body_from_cam)
