"""Render declared streets into datasets.

``load_scene`` reads a scene file; the command ``streetgen build`` renders it."""

from streetgen.scene_file import Scene, load_scene

__all__ = ["Scene", "load_scene"]
