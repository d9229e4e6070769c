"""The procedural street: scene files, and the effects a scene declares."""

from streetgen.scene_file import Scene, load_scene

__all__ = ["Scene", "load_scene"]
