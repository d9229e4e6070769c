"""Readers of posed pictures on disk."""

from rfcore.dataset.assemble import Dataset, Distortion, ReadOptions
from rfcore.dataset.read import read_dataset
from rfcore.files import verify_manifest, write_manifest

__all__ = [
    "Dataset",
    "Distortion",
    "ReadOptions",
    "read_dataset",
    "verify_manifest",
    "write_manifest",
]
