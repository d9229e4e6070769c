"""Recordings of a server, for tests."""

from pathlib import Path

from rfcore.dataset.recorded_session import (
    RecordedPart,
    RecordedPicture,
    read_recorded_part,
    recordings_under,
)


def recorded_parts(folder: Path, vehicle: str = "*", camera: str = "*") -> list[RecordedPart]:
    """Return the parts of a vehicle's camera; of all of them, unless it is named."""
    files = sorted(folder.glob(f"{vehicle}/{camera}/*/recording.jsonl"))
    assert set(files) <= set(recordings_under(folder))
    return [read_recorded_part(file) for file in files]


def recorded(folder: Path, vehicle: str = "*", camera: str = "*") -> list[RecordedPicture]:
    """Return their pictures, in order."""
    return [p for part in recorded_parts(folder, vehicle, camera) for p in part.pictures]
