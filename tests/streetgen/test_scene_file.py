"""Scene files: what is declared is what runs, and a mistake names its line and key."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from streetgen import load_scene
from streetgen.trajectory import drive_pose

ROOT = Path(__file__).parents[2]
READY_MADE = sorted((ROOT / "streetgen" / "scenes").glob("*.toml"))
START = 'name = "x"\nfield = "y"\n'


@pytest.mark.parametrize("path", READY_MADE, ids=lambda path: path.stem)
def test_a_ready_made_scene_is_a_scene(path):
    scene = load_scene(path.stem)
    assert scene.name == path.stem
    assert scene == load_scene(str(path))
    assert (ROOT / "streetgen" / "scenes" / f"{scene.field}.toml").is_file()


def test_effects_run_in_the_registrys_order(tmp_path):
    text = START + "[effects.noise]\n[effects.haze]\n[effects.lens]\n"
    (tmp_path / "s.toml").write_text(text)
    assert list(load_scene(str(tmp_path / "s.toml")).effects) == ["haze", "lens", "noise"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", r"line 1: name: is missing"),
        ('name = 3\nfield = "y"\n', r"line 1: name: is 3, not a string"),
        (START + "colour = 3\n", r"line 3: colour: is none of drive, effects"),
        (START + "drive = 3\n", r"line 3: drive: is 3, not a table"),
        (START + "[geometry]\n\nlength_m = -3\n", r"line 5: geometry.length_m: is -3, outside 20"),
        (START + "[geometry]\nlength_m = nan\n", r"line 4: geometry.length_m: is nan, outside"),
        (START + "[geometry]\ntrees = 1\n", r"line 4: geometry.trees: is 1, not true or false"),
        (START + "[geometry]\nseed = true\n", r"line 4: geometry.seed: is True, not a whole"),
        (START + "[geometry]\ntress = true\n", r"line 4: geometry.tress: is none of floors"),
        (START + '[rig]\ndirections = "up"\n', r"line 4: rig.directions: is 'up', none of both"),
        (
            START + "[drive]\nsize_px = [640]\n",
            r"line 4: drive.size_px: is \[640\], not a list of 2",
        ),
        (START + "[drive]\nsize_px = [640, 9]\n", r"line 4: drive.size_px\[1\]: is 9, outside 16"),
        (START + "[drive]\nthinned_hz = [7]\n", r"line 4: drive.thinned_hz: 7 does not divide"),
        (START + "[effects.nose]\n", r"line 3: effects.nose: is none of auto_exposure, cyclists"),
        (START + "[effects.noise]\nread_e = 'x'\n", r"line 4: effects.noise.read_e: is 'x', not a"),
        (START + "[effects]\nnoise = 3\n", r"line 4: effects.noise: is 3, not a table"),
        (START + "[drive\n", r"s\.toml: .*line 3"),
    ],
)
def test_a_mistake_names_its_line_and_key(tmp_path, text, said):
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(InvalidInput, match=said) as caught:
        load_scene(str(tmp_path / "s.toml"))
    assert "s.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


PASSES = (
    START
    + """
[effects.haze]
[effects.noise]
[[passes]]
[[passes]]
lane_offset_m = 0.6
[passes.effects.haze]
visibility_m = 99
[passes.effects.dusk]
"""
)


def test_each_pass_has_its_own_place_in_the_lane_and_effects(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(PASSES)
    first, one, two = (load_scene(f"{path}{mark}") for mark in ("", ":1", ":2"))
    assert replace(first, name="x:1") == one
    assert (two.name, two.drive.lane_offset_m, one.drive.lane_offset_m) == ("x:2", 0.6, 0.0)
    assert list(one.effects) == ["haze", "noise"]
    assert list(two.effects) == ["dusk", "haze", "noise"]
    assert (one.effects["haze"].visibility_m, two.effects["haze"].visibility_m) == (800, 99)
    assert two.passes == 2


@pytest.mark.parametrize(
    ("mark", "more", "said"),
    [
        (":3", "", r"passes: '3' is none of 2 passes"),
        (":0", "", r"passes: '0' is none of 2 passes"),
        (":x", "", r"passes: 'x' is none of 2 passes"),
        (":2", "[passes.drive]\n", r"passes\[1\]\.drive: is none of effects, lane_offset_m"),
        (":2", "[passes.effects.overcast]\n", r"effects.overcast: is a second light beside dusk"),
    ],
)
def test_a_pass_that_is_not_one_is_refused(tmp_path, mark, more, said):
    path = tmp_path / "s.toml"
    path.write_text(PASSES + more)
    with pytest.raises(InvalidInput, match=said):
        load_scene(f"{path}{mark}")


def test_a_name_that_is_no_scene_lists_those_there_are():
    with pytest.raises(InvalidInput, match=r"'street-moon'.*street-dusk, street-empty"):
        load_scene("street-moon")


@pytest.mark.sample
def test_the_long_drive_of_the_sample_stays_where_its_field_was_trained():
    samples = ROOT / "samples"
    drive = load_scene(str(samples / "localise/drive_30s.toml")).drive
    times_s = np.arange(300) / drive.rate_hz
    assert times_s[-1] == pytest.approx(drive.duration_s - 0.1)
    driven_m = [drive_pose(drive, time_s).translation_m[0] for time_s in times_s]
    trained = read_dataset(samples / "street/transforms_train.json").pictures
    trained_m = [picture.camera.world_from_cam.translation_m[0] for picture in trained]
    assert min(trained_m) < min(driven_m) < -25
    assert 25 < max(driven_m) < max(trained_m)
