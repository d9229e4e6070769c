"""``rfedge field update`` and ``disagree`` on recordings of two vehicles."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rfcore.dataset.source import SourceCamera
from rfcore.dataset.write import WrittenPicture, write_transforms
from rfcore.errors import InvalidInput
from rfcore.field import load_field, save_field
from rfcore.image import read_rgb, write_png
from rfcore.update.passes import Pass
from rfedge.cli.field_update import FieldDisagree, FieldUpdate
from rfedge.fields.describe import disagreement_picture
from tests.update.conftest import pasted, sometimes


def recorded(folder: Path, drive: Pass) -> Path:
    """Write a pass as a dataset."""
    folder.mkdir()
    written = []
    for picture in drive.pictures:
        write_png(folder / picture.name, picture.read())
        camera = SourceCamera(picture.camera.intrinsics)
        written.append(WrittenPicture(picture.name, camera, picture.camera.world_from_cam))
    write_transforms(folder, written, None)
    return folder


@pytest.mark.parametrize("learn_as", ["all", "delta", "colours"])
def test_what_pays_is_written(noon, dusk, make_pass, tmp_path, learn_as, capsys):
    save_field(noon.compressed(), tmp_path / "noon.rff")
    passes = [make_pass(dusk, "a"), make_pass(dusk, "b", 0.15)]
    folders = tuple(recorded(tmp_path / drive.identity, drive) for drive in passes)
    out = tmp_path / "dusk.rff"
    FieldUpdate(
        tmp_path / "noon.rff",
        folders,
        out,
        learn_as,
        iterations=120,
    ).run()
    said = capsys.readouterr().out
    assert "% fewer bits" in said
    lines = [line for line in said.splitlines() if re.fullmatch(r"[a-z -]+: \d+ of \d+", line)]
    for doing in {line.partition(":")[0] for line in lines}:
        assert sum(line.startswith(f"{doing}:") for line in lines) <= 11, "a line a tenth"
    assert any(line.startswith("trial:") for line in lines)
    assert load_field(out).archive().kind == {"colours": "layer"}.get(
        learn_as, "splats" if learn_as == "all" else learn_as
    )


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_job_on_ray_learns_the_same_bytes(noon, dusk, make_pass, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)  # relative files: workers of Ray run elsewhere
    save_field(noon, Path("noon.rff"))
    passes = [make_pass(dusk, "a"), make_pass(dusk, "b", 0.15)]
    folders = tuple(recorded(Path(drive.identity), drive) for drive in passes)
    update = FieldUpdate(Path("noon.rff"), folders, Path("here.rff"), "colours")
    update.run()
    replace(update, out=Path("job.rff"), ray="local").run()
    assert Path("job.rff").read_bytes() == Path("here.rff").read_bytes()
    said = capsys.readouterr().out
    assert "update-job: done" in said
    assert re.search(r"^update-job\b.*colours: \d+ of 22$", said, flags=re.MULTILINE)
    assert sorted(path.name for path in tmp_path.glob("*.job")) == []


def test_frames_that_agree_with_nobody_are_left_out_and_named(
    noon, dusk, make_pass, tmp_path, capsys
):
    """Two frames of one pass show another place; of another pass all frames do."""

    save_field(noon, tmp_path / "noon.rff")
    a, b, liar = (
        recorded(tmp_path / drive.identity, drive)
        for drive in (
            make_pass(dusk, "a", paint=sometimes),
            make_pass(dusk, "b", 0.15),
            make_pass(dusk, "liar", paint=pasted),
        )
    )
    update = FieldUpdate(tmp_path / "noon.rff", (a, b, liar), tmp_path / "dusk.rff", "colours")
    update.run()
    said = capsys.readouterr().out
    assert f"{a}: 2 frames left out" in said
    assert f"{liar}: 12 frames left out" in said
    assert said.count("frames left out") == 2
    with pytest.raises(InvalidInput, match=r"12 of .*liar.*field disagree"):
        replace(update, recordings=(b, liar)).run()


def test_what_does_not_pay_is_not(noon, make_pass, tmp_path):
    save_field(noon, tmp_path / "noon.rff")
    folders = [recorded(tmp_path / name, make_pass(noon, name)) for name in "ab"]
    out = tmp_path / "again.rff"
    with pytest.raises(InvalidInput, match="nothing is written"):
        FieldUpdate(tmp_path / "noon.rff", tuple(folders), out, iterations=20).run()
    assert not out.exists()


def test_disagreement_is_red_where_something_stands(noon, make_pass, tmp_path):
    """A dark block in a picture that is darker as a whole: the block alone is marked."""

    def block(_: int, rgb: np.ndarray) -> np.ndarray:
        out = (0.6 * rgb).astype(np.uint8)
        out[16:40, 24:48] = 255
        return out

    drive = make_pass(noon, "a", paint=block)
    save_field(noon, tmp_path / "noon.rff")
    out = tmp_path / "out" / "red.png"
    FieldDisagree(tmp_path / "noon.rff", (recorded(tmp_path / "a", drive),), out).run()
    shown = read_rgb(out)
    assert shown.shape == (4 * 64, 3 * 96, 3)
    redness = shown[:64, 192:, 0].astype(int) - shown[:64, 192:, 1]
    assert redness[20:36, 28:44].mean() > 3 * redness[:, 64:].mean()


def test_disagreement_without_pictures_is_refused(noon):
    with pytest.raises(InvalidInput, match="no pictures"):
        disagreement_picture(noon, [])
