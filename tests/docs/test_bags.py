"""The commands of docs/how-to/bags.md lead from a bag of the sample to an MCAP and back."""

import re
import shutil
import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

import bags
from docs.pages import Page
from rfcore.dataset import read_dataset
from rfcore.dataset.recording import SECTIONS
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import PosedPicture
from rfedge.cli import parse

ROOT = Path(__file__).parents[2]
PAGE = Page("how-to/bags.md")


def test_the_toml_of_the_page_has_only_keys_that_are_read():
    for section, keys in tomllib.loads("\n".join(PAGE.blocks("toml"))).items():
        assert set(keys) <= set(SECTIONS[section].split())


@pytest.mark.slow
@pytest.mark.sample
def test_three_commands_lead_from_a_bag_to_a_coded_drive_and_back_to_an_mcap(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    sample = read_dataset(ROOT / "samples/street/transforms_drive_empty.json")
    given = sample.pictures[:8]
    written = bags.of_pictures(given, sample.tile_origin).write(Path("bag"))
    shutil.move(next(written.glob("*.mcap")), "drive.mcap")
    shutil.copy(ROOT / "samples/fields/street.rff", "street.rff")
    convert, encode, decode = [words for _, *words in PAGE.commands("sh")][:3]
    parse(convert).run()
    drive = read_dataset(Path("out/drive")).pictures
    for found, true in zip(drive, given, strict=True):
        np.testing.assert_array_equal(found.read(), true.read())
        assert found.camera.world_from_cam.translation_m == pytest.approx(
            true.camera.world_from_cam.translation_m, abs=1e-9
        )
    parse(encode).run()
    capsys.readouterr()
    parse(decode).run()
    coded_db = float(re.search(r"luma PSNR ([\d.]+) dB", capsys.readouterr().out)[1])
    with Path("out/decoded.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        topics = [channel.topic for _, channel, _ in reader.iter_messages()]
    assert topics.count("/offline/front/video") == 8
    parse(["dataset", "convert", "out/decoded.mcap", "--out", "out/back"]).run()
    back = read_dataset(Path("out/back")).pictures
    back_db = luma_psnr_db(back, given)
    print(f"coded drive {coded_db:.2f} dB, MCAP of it {back_db:.2f} dB")
    assert coded_db > 34
    assert back_db > coded_db - 1.5
    for found, true in zip(back, given, strict=True):
        assert found.camera.world_from_cam.translation_m == pytest.approx(
            true.camera.world_from_cam.translation_m, abs=5e-4
        )


def luma_psnr_db(found: Sequence[PosedPicture], given: Sequence[PosedPicture]) -> float:
    planes = [[i420_from_rgb(p.read()).y.astype(float) for p in those] for those in (found, given)]
    return float(10 * np.log10(255**2 / np.mean(np.subtract(*planes) ** 2)))
