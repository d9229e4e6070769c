"""``rfedge encode`` and ``decode``: what they say of a drive is what it costs and how it looks."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.field import SplatField, save_field
from rfcore.wire.drive_file import read_drive
from rfedge.cli import parse
from rfedge.cli.codec import Decode
from rfedge.cli.render import Render
from rfedge.evaluate.clips import DriveOfField
from tests.demo.conftest import tiny_street, write_views

DRIVE = "transforms_drive_vehicles.json"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with drives of four pictures at 10 Hz, and the field of their street."""
    for name in ("drive_empty", "drive_vehicles"):
        write_views(tmp_path, name, [i / 10 for i in range(4)], boxes=name != "drive_empty")
    save_field(SplatField(tiny_street()), tmp_path / "street.rff")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def save_street_moved(file: str, x_m: float, y_m: float, z_m: float) -> None:
    street = tiny_street()
    means = street.means + np.float32([x_m, y_m, z_m])
    save_field(SplatField(replace(street, means=means)), Path(file))


def encoded(*options: str, field: str = "street.rff", drive: str = DRIVE) -> None:
    command = ["encode", drive, "--field", field, "--out", "a.rfv", *options]
    parse(command).run()


def number(pattern: str, text: str) -> float:
    return float(re.search(pattern, text)[1].replace(",", ""))


def test_encode_says_rate_and_quality_and_decode_finds_the_same_quality(here, capsys):
    encoded("--crf", "30")
    said = capsys.readouterr()
    kbps = 8 * (here / "a.rfv").stat().st_size / 4 * 10 / 1000
    assert number(r"([\d,]+) kbit/s at 10 Hz", said.out) == round(kbps)
    assert said.err == ""
    parse(["decode", "a.rfv", "--field", "street.rff", "--out", "p", "--originals", DRIVE]).run()
    found = capsys.readouterr().out
    assert number(r"luma PSNR ([\d.]+) dB", found) == number(r"luma PSNR ([\d.]+) dB", said.out)
    assert len(list((here / "p").iterdir())) == 4


@pytest.mark.usefixtures("here")
def test_a_drive_that_is_not_there_is_named_with_the_command_that_makes_it(capsys):
    decode = ["decode", "a.rfv", "--field", "street.rff", "--out", "p"]
    with pytest.raises(InvalidInput, match=r"there is no a\.rfv") as caught:
        parse(decode).run()
    words = re.search("rfedge (encode .*) makes it", str(caught.value))[1].split()
    parse([DRIVE if word == "DRIVE" else word for word in words]).run()
    parse(["doctor", "a.rfv"]).run()
    said = capsys.readouterr().out
    assert "a.rfv: a coded drive of 4 frames of " in said
    words = re.search(r"^next: rfedge (.*)$", said, re.MULTILINE)[1].split()
    parse([{"FIELD.rff": "street.rff", "FOLDER": "p"}.get(word, word) for word in words]).run()
    assert len(list(Path("p").iterdir())) == 4


@pytest.mark.usefixtures("here")
def test_a_rate_is_stated_or_taken_from_times_and_said_where_it_is_assumed(capsys):
    content = json.loads(Path(DRIVE).read_text())
    untimed = [{k: v for k, v in frame.items() if k != "time"} for frame in content["frames"]]
    Path("untimed.json").write_text(json.dumps({**content, "frames": untimed}))

    def said(*options: str, drive: str = DRIVE) -> tuple[str, str, bool]:
        encoded(*options, drive=drive)
        parse(["decode", "a.rfv", "--field", "street.rff", "--out", "a.mp4"]).run()
        told = capsys.readouterr()
        rate, film = re.search(r"bit/s at ([\d.]+) Hz[^ß]*frames at ([\d.]+) Hz", told.out).groups()
        return rate, film, told.err.count("10 Hz is assumed (--rate HZ)") == 2

    assert said() == ("10", "10", False)
    assert said("--rate", "4") == ("4", "4", False)
    assert said("--rate", "4", drive="untimed.json") == ("4", "4", False)
    assert said(drive="untimed.json") == ("10", "10", True)
    with pytest.raises(InvalidInput, match=r"rate: 0 Hz is outside 0.01..1000"):
        encoded("--rate", "0")


@pytest.mark.usefixtures("here")
def test_encode_compares_with_x264_when_asked(capsys):
    encoded()
    assert "x264" not in capsys.readouterr().out
    encoded("--against-x264")
    percent = number(r"(\d+) % (?:fewer|more) bits than x264-our-tools", capsys.readouterr().out)
    assert percent > 0


@pytest.mark.parametrize("options", [("--coder", "x264"), ("--coder", "x264", "--light", "off")])
def test_x264_codes_with_the_references_that_it_takes(here, capsys, options):
    encoded(*options)
    assert "3 of 4 are used" in capsys.readouterr().out
    assert all(len(f.packet.references) <= 3 for f in read_drive(here / "a.rfv").frames)


def test_a_field_far_from_every_camera_is_refused_before_anything_is_coded(here):
    save_street_moved("far.rff", 500.0, 0.0, 0.0)
    with pytest.raises(InvalidInput, match=r"another place.* 499.8 m from.*rfedge field check"):
        encoded(field="far.rff")
    assert not (here / "a.rfv").exists()


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    "meet",
    [
        lambda: encoded(field="other.rff"),
        lambda: Render(Path("other.rff"), Path("r"), drive=Path(DRIVE)).run(),
        lambda: parse(["localise", DRIVE, "--field", "other.rff", "--tries", "1"]).run(),
        lambda: DriveOfField.parse(f"a@10={DRIVE},other.rff", Path("street.rff")).read(None),
    ],
    ids=["encode", "render", "localise", "eval"],
)
def test_a_field_of_another_place_around_the_same_origin_is_warned_of(capsys, meet):
    save_street_moved("other.rff", 0.0, 0.0, -13.0)
    meet()
    assert re.search(r"warning: .* 1?\d\.\d dB .*rfedge field check other", capsys.readouterr().err)


def test_a_drive_through_a_lens_is_undistorted_and_said_so(here, capsys):
    content = json.loads((here / DRIVE).read_text())
    (here / "bent.json").write_text(json.dumps({**content, "k1": 0.02}))
    encoded(drive="bent.json")
    Render(Path("street.rff"), Path("r"), drive=Path("bent.json"), psnr=True).run()
    said = capsys.readouterr()
    assert said.err.count("bent.json: 4 of 4 pictures are undistorted") == 2
    values = [float(db) for db in re.findall(r"png  ([\d.]+) dB", said.out)]
    assert number(r"mean of 4 pictures: ([\d.]+) dB", said.out) == pytest.approx(
        np.mean(values), abs=0.01
    )


def test_a_comparison_without_pictures_or_with_others_is_refused(here):
    with pytest.raises(InvalidInput, match=r"psnr.*--drive"):
        Render(Path("street.rff"), Path("r"), psnr=True).run()
    encoded()
    write_views(here, "other", [0.0, 0.1])
    others = Path("transforms_other.json")
    with pytest.raises(InvalidInput, match="originals: are 2 pictures, 4 were encoded"):
        Decode(Path("a.rfv"), Path("street.rff"), Path("p"), originals=others).run()
    assert not (here / "p").exists()


@pytest.mark.usefixtures("here")
def test_without_bubblewrap_decode_says_so_in_one_line(monkeypatch, capfd):
    encoded()
    capfd.readouterr()
    monkeypatch.setattr("rfcore.confinement.start.shutil.which", lambda _: None)
    Decode(Path("a.rfv"), Path("street.rff"), Path("film/a.mp4")).run()
    said = capfd.readouterr()
    sandbox, film = said.out.splitlines()
    assert sandbox.startswith("note: decoded in a landlock sandbox (")
    assert "install bubblewrap" in sandbox
    assert film == "film/a.mp4: 4 frames at 10 Hz"
    assert said.err == ""
