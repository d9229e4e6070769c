"""Poses from where vehicles have them: GNSS receivers, gpsd, a line of JSON a pose.

``sources`` reads bytes, ``nmea`` and ``json_lines`` make a ``Fix`` of a line, ``feed`` checks the
fixes as they come, ``placement`` transforms one into the camera's pose in a field, ``feed_poses``
has the poses at the times of pictures. All but ``sources`` are state machines without sockets or
clock. Other packages import the names below.
"""

from cav_agent.pose_feed.feed import PoseFeed
from cav_agent.pose_feed.feed_poses import FeedPoses, recorded_time_ns
from cav_agent.pose_feed.fix import CameraMount, FeedProblem, FieldPlacement
from cav_agent.pose_feed.sources import parse_source

__all__ = [
    "CameraMount",
    "FeedPoses",
    "FeedProblem",
    "FieldPlacement",
    "PoseFeed",
    "parse_source",
    "recorded_time_ns",
]
