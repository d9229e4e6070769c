"""Each coder, and each place where packets are decoded, has its row."""

from pathlib import Path
from typing import Any

import pytest

from lab.bench import codec, run_case
from lab.bench.street import street_gaussians
from mec_server.config import DecoderKind
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


def test_every_coder_has_its_row_at_each_number_of_references(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(codec, "street_gaussians", lambda: street_gaussians(2000))
    monkeypatch.setattr(codec, "SIZES_PX", ((64, 48),))
    monkeypatch.setattr(codec, "THREADS", (2,))
    monkeypatch.setattr(codec, "WARM_UP", 1)
    monkeypatch.setattr(codec, "REPETITIONS", 2)
    rows = codec.codec_rows()
    assert [(row.references, row.effort) for row in rows] == [
        (references, effort) for references in (1, 3) for effort in codec.EFFORTS
    ]
    for row in rows:
        assert (row.threads, row.width, row.height) == (2, 64, 48)
        assert row.payload_bytes > 0
        assert row.psnr_db > 25
        assert row.sender_ms["total"] > row.sender_ms["render"] > 0
        assert row.receiver_ms["total"] > 0
        assert row.sender_ms["relight"] == row.receiver_ms["relight"] > 0
