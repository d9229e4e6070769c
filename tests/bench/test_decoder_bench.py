"""Each place where packets are decoded has its row."""

from pathlib import Path
from typing import Any

import pytest

from mec_server.config import DecoderKind
from rfedge.bench import codec, run_case
from rfedge.loadtest.prerecorded import PrerecordedDrive, prerecorded_drive

KINDS = (DecoderKind.IN_PROCESS, DecoderKind.CHILD)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The first frames of the sample drive, coded fast."""

    def coded(drive: Path, field: Any, cache: Path) -> Path:
        whole = PrerecordedDrive.read(prerecorded_drive(drive, field, cache, "fast"))
        PrerecordedDrive(whole.hello, whole.chain[:5], whole.alone[:5]).write(tmp_path)
        return tmp_path

    monkeypatch.setattr(codec, "prerecorded_drive", coded)
    monkeypatch.setattr(codec, "LAPS", 1)
    monkeypatch.setattr(codec, "KINDS", KINDS)


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_every_place_has_its_row_and_the_difference_to_here() -> None:
    here, child = run_case("decoders")["rows"]
    assert (here["decoder"], here["frames"], here["more_ms"]) == ("in-process", 5, 0.0)
    assert (child["decoder"], child["frames"]) == ("child", 5)
    assert child["median_ms"] > 0.0
