"""Readers of posed pictures on disk."""

from rfcore.dataset.manifest import verify_manifest, write_manifest
from rfcore.dataset.transforms import Dataset, read_transforms

__all__ = ["Dataset", "read_transforms", "verify_manifest", "write_manifest"]
