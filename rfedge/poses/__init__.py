"""Poses of pictures by structure from motion (COLMAP), alone or in a dataset's own frame."""

from rfedge.poses.dataset import pose_dataset
from rfedge.poses.settings import PoseSettings

__all__ = ["PoseSettings", "pose_dataset"]
