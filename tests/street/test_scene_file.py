"""Scene files: what is declared is what runs, and a mistake names its line and key."""

from pathlib import Path

import pytest

from rfcore.errors import InvalidInput
from rfedge.street import load_scene

ROOT = Path(__file__).parents[2]
READY_MADE = sorted((ROOT / "samples" / "scenes").glob("*.toml"))
START = 'name = "x"\nfield = "y"\n'


@pytest.mark.parametrize("path", READY_MADE, ids=lambda path: path.stem)
def test_a_ready_made_scene_is_a_scene(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    scene = load_scene(path.stem)
    assert scene.name == path.stem
    assert scene == load_scene(str(path))
    assert (ROOT / "samples" / "scenes" / f"{scene.field}.toml").is_file()


def test_the_published_evaluation_is_144_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    scene = load_scene("street-empty")
    assert scene.evaluation.stations * scene.rig.cameras == 144
    assert scene.effects == {}


def test_what_is_left_out_has_its_default(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(START + "[drive]\nduration_s = 1\n[effects.noise]\n")
    scene = load_scene(str(tmp_path / "s.toml"))
    assert (scene.drive.duration_s, scene.drive.frames) == (1.0, 30)
    assert list(scene.effects) == ["noise"]


def test_effects_run_in_the_registrys_order(tmp_path: Path) -> None:
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
        (START + "[geometry]\ntress = true\n", r"line 4: geometry.tress: is none of length_m"),
        (START + '[rig]\ndirections = "up"\n', r"line 4: rig.directions: is 'up', none of both"),
        (
            START + "[drive]\nsize_px = [640]\n",
            r"line 4: drive.size_px: is \[640\], not a list of 2",
        ),
        (START + "[drive]\nsize_px = [640, 9]\n", r"line 4: drive.size_px\[1\]: is 9, outside 16"),
        (START + "[drive]\nthinned_hz = [7]\n", r"line 4: drive.thinned_hz: 7 does not divide"),
        (START + "[effects.nose]\n", r"line 3: effects.nose: is none of dusk, exposure, haze"),
        (START + "[effects.noise]\nread_e = 'x'\n", r"line 4: effects.noise.read_e: is 'x', not a"),
        (START + "[effects]\nnoise = 3\n", r"line 4: effects.noise: is 3, not a table"),
        (START + "[drive\n", r"s\.toml: .*line 3"),
    ],
)
def test_a_mistake_names_its_line_and_key(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(InvalidInput, match=said) as caught:
        load_scene(str(tmp_path / "s.toml"))
    assert "s.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_name_that_is_no_scene_lists_those_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    with pytest.raises(InvalidInput, match=r"'street-moon'.*street-dusk, street-empty"):
        load_scene("street-moon")
