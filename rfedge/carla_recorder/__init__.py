"""Recording datasets in a running CARLA server."""

from rfedge.carla_recorder.axes import intrinsics_of_fov, pose_from_carla
from rfedge.carla_recorder.record import Recorder, RecordSettings
from rfedge.carla_recorder.rig import RIG, Mount

__all__ = ["RIG", "Mount", "RecordSettings", "Recorder", "intrinsics_of_fov", "pose_from_carla"]
