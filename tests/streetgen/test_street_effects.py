"""Effects that change the street: vehicles where they belong, light, water; nothing undeclared."""

import hashlib
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.native import _native
from streetgen import load_scene
from streetgen.classes import Label
from streetgen.effects import EFFECTS, EffectKind, load_effect, rng_of
from streetgen.effects.cyclists import Cyclists
from streetgen.effects.dusk import Dusk
from streetgen.effects.evening import Evening, daylight
from streetgen.effects.overcast import Overcast
from streetgen.effects.parked import ParkedVehicles
from streetgen.effects.passing_cloud import PassingCloud
from streetgen.effects.pedestrians import Pedestrians
from streetgen.effects.traffic import Traffic
from streetgen.effects.tunnel import Tunnel
from streetgen.effects.wet_road import WetRoad
from streetgen.effects.works import Works
from streetgen.geometry.cyclist import Cyclist, riding
from streetgen.geometry.layout import FACADE_M, PAVEMENT_UP_M, Geometry, Layout
from streetgen.geometry.mesh import Mesh, placed
from streetgen.geometry.person import Person, walking
from streetgen.geometry.road import road
from streetgen.geometry.sky import DUSK, NOON, Daylight, sunny_sky
from streetgen.geometry.world import Mover, Sky, World
from streetgen.shots import Split, shots_of

ROOT = Path(__file__).parents[2]
ON_STREET = tuple(effect for effect in EFFECTS if not effect.on_frames)


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.fixture(scope="module")
def street() -> World:
    """60 m of road without anything on it, under a plain sky."""
    layout = Layout(Geometry(length_m=60.0))
    sky = Sky(np.full((16, 32, 3), 0.5, np.float32), sun_radiance=(8.0, 8.0, 8.0))
    return World(layout, sky).plus(road(layout, rng()))


@pytest.fixture(autouse=True)
def low_evenings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Evening skies of few rows and without clouds, which are made at once."""

    def sunny(day: Daylight, rng: np.random.Generator) -> Sky:
        return sunny_sky(replace(day, cover=0.0), rng, height=16)

    monkeypatch.setattr("streetgen.effects.evening.sunny_sky", sunny)


def digest(world: World) -> str:
    found = hashlib.sha256(world.sky.radiance.tobytes())
    if world.sky_at is not None:
        later = world.sky_at(2.0)
        found.update(later.radiance.tobytes() + repr(later.sun_radiance).encode())
    moving = [
        placed(m, mover.world_from_mover(0.7)) for mover in world.movers for m in mover.meshes
    ]
    for mesh in (*world.meshes, *moving):
        found.update(mesh.material.encode() + mesh.vertices.tobytes())
    for name, material in sorted(world.materials.items()):
        found.update(name.encode() + np.asarray(material.colour).tobytes())
        found.update(np.asarray(material.roughness).tobytes())
    return found.hexdigest()


@pytest.mark.parametrize("effect", ON_STREET, ids=lambda effect: effect.name)
def test_an_effect_follows_from_its_seed_and_leaves_the_street_as_it_was(effect, street):
    settings = load_effect(effect)()
    before = digest(street)
    one, other = (digest(settings.change(street, rng())) for _ in range(2))
    assert one == other != before
    assert digest(street) == before


def test_parked_vehicles_stand_in_their_bays(street):
    parked = added(ParkedVehicles(occupied=1.0).change(street, rng()), street)
    points = np.concatenate([mesh.vertices for mesh in parked])
    assert np.abs(points[:, 1]).min() > 3.9, "the lanes are free"
    assert np.abs(points[:, 1]).max() < 6.9
    assert abs(points[:, 2].min()) < 1e-3
    painted = [mesh for mesh in parked if mesh.material.startswith("paint")]
    assert len(painted) == len(street.layout.bays)


def test_the_share_of_occupied_bays_is_the_declared_one(street):
    counts = [
        len([m for m in added(ParkedVehicles(share).change(street, rng()), street) if is_paint(m)])
        for share in (0.0, 0.5, 1.0)
    ]
    assert counts[0] == 0
    assert counts[0] < counts[1] < counts[2]


def painted_at(world: World, before: World) -> set[float]:
    """Where along the street vehicles' bodies have been parked."""
    meshes = world.meshes[len(before.meshes) :]
    return {float(mesh.vertices[0, 0]) for mesh in meshes if is_paint(mesh)}


def test_some_parked_vehicles_stay_and_others_change_from_day_to_day(street):
    today, kept, gone = (
        painted_at(ParkedVehicles(0.6, day, turnover).change(street, rng()), street)
        for day, turnover in ((0, 0.5), (4, 0.0), (4, 1.0))
    )
    assert kept == today
    assert gone.isdisjoint(today)
    some = painted_at(ParkedVehicles(0.6, 4, 0.5).change(street, rng()), street)
    assert some & today
    assert some - today


def test_nothing_parks_in_a_building_site_and_the_lanes_stay_free(street):
    """Other bays have the vehicles that they have without the site."""
    site = Works(start_m=-10.0, length_m=20.0).change(street, rng())
    fence = np.concatenate([m.vertices for m in site.meshes[len(street.meshes) :]])
    assert fence[:, 1].min() > 4.0, "the lanes are free"
    assert fence[:, 0].min() > -10.1
    assert fence[:, 0].max() < 10.1
    parked = ParkedVehicles(1.0)
    beside = painted_at(parked.change(site, rng()), site)
    everywhere = painted_at(parked.change(street, rng()), street)
    assert beside < everywhere
    bays = [bay for bay in site.layout.bays if bay.side == 1]
    assert all(abs(bay.x_m) > 12.0 for bay in bays)
    with pytest.raises(InvalidInput, match="side: is 0"):
        Works(side=0)


def test_a_tunnel_hides_the_sky_over_its_stretch(street):
    roofed = Tunnel(start_m=-5.0, length_m=10.0, height_m=5.0).change(street, rng())
    concrete = roofed.meshes[-1].vertices
    assert (concrete[:, 0].min(), concrete[:, 0].max()) == (-5.0, 5.0)
    assert concrete[:, 2].max() == pytest.approx(5.4)
    inside = (np.abs(concrete[:, 1]) < 6.6) & (concrete[:, 2] < 5.0)
    assert not inside.any(), "the road is free"


def test_an_evening_goes_from_noon_to_dusk():
    assert daylight(0.0) == NOON
    assert daylight(1.0) == DUSK
    assert DUSK.elevation_deg < daylight(0.5).elevation_deg < NOON.elevation_deg


def test_the_sun_of_an_evening_sinks_in_every_frame_and_then_stays(street):
    evening = Evening(0.0, 1.0, over_s=10.0)
    heights = [daylight(evening.share_at(t)).elevation_deg for t in np.arange(300) / 30]
    assert (np.diff(heights) < 0).all()
    sinking = evening.change(street, rng())
    assert sinking.sky_at is not None
    assert sinking.sky_at(5.0).sun_towards[2] < sinking.sky.sun_towards[2]
    late = sinking.sky_at(10.0), sinking.sky_at(20.0)
    np.testing.assert_array_equal(late[0].radiance, late[1].radiance)
    assert Evening(0.5, 0.5).change(street, rng()).sky_at is None, "a light that stays is one sky"


def test_a_passing_cloud_dims_the_sun_alone_and_leaves(street):
    cloudy = PassingCloud(1.0, 0.5, 2.0, passed=0.1).change(street, rng())
    assert cloudy.sky_at is not None
    light = [cloudy.sky_at(t) for t in (0.0, 1.0, 1.25, 1.5, 3.5, 3.75, 4.0, 9.0)]
    shares = [sky.sun_radiance[0] / 8.0 for sky in light]
    assert shares == pytest.approx([1.0, 1.0, 0.55, 0.1, 0.1, 0.55, 1.0, 1.0])
    assert all(sky.radiance is street.sky.radiance for sky in light)


def test_a_cloud_passes_over_a_sinking_sun(street):
    evening = Evening().change(street, rng())
    both = PassingCloud(passed=0.5).change(evening, rng())
    assert both.sky_at is not None
    assert evening.sky_at is not None
    shaded, clear = both.sky_at(2.0), evening.sky_at(2.0)
    assert shaded.sun_towards == clear.sun_towards
    assert shaded.sun_radiance[0] == pytest.approx(0.5 * clear.sun_radiance[0])


def test_traffic_keeps_right_and_its_speed(street):
    busy = Traffic(along_m=(-20.0,), oncoming_m=(10.0,), speed_mps=8.0).change(street, rng())
    assert busy.meshes == street.meshes
    along, oncoming = busy.movers
    for mover, direction, start in ((along, 1, -20.0), (oncoming, -1, 10.0)):
        for time_s in (0.0, 1.5):
            pose = mover.world_from_mover(time_s)
            assert pose[0, 3] == pytest.approx(start + direction * 8.0 * time_s)
            assert pose[1, 3] == pytest.approx(-2.1 * direction)
            assert pose[0, 0] == pytest.approx(direction), "it looks where it drives"


@pytest.mark.parametrize("split", [Split.DRIVE, Split.EVAL])
def test_no_camera_of_the_ready_made_traffic_is_inside_a_vehicle(split):
    scene = load_scene("street-traffic")
    empty = World(Layout(scene.geometry), Sky(np.full((16, 32, 3), 0.5, np.float32)))
    movers = scene.effects["traffic"].change(empty, rng()).movers
    for shot in shots_of(scene, split)[::6]:
        eye = np.append(np.array(shot.camera.world_from_cam.translation_m), 1.0)
        for mover in movers:
            x, y, _, _ = np.linalg.inv(mover.world_from_mover(shot.time_s)) @ eye
            assert abs(x) > 4.0 or abs(y) > 1.6


WALKING_PARTS, RIDING_PARTS = len(walking(Person(), 0.0, 0.0)), len(riding(Cyclist(), 0.0))


def bodies_at(movers: tuple[Mover, ...], time_s: float, parts: int) -> list[np.ndarray]:
    """Return the vertices of each person at a time, world."""
    placed_parts = [
        np.concatenate([placed(m, mover.world_from_mover(time_s)).vertices for m in mover.meshes])
        for mover in movers
    ]
    starts = range(0, len(placed_parts), parts)
    return [np.concatenate(placed_parts[start : start + parts]) for start in starts]


def test_people_walk_on_the_pavements_past_posts_and_trees(street):
    people = Pedestrians((-10.0, 4.0), (7.0, -3.0), crossing_m=()).change(street, rng())
    assert people.meshes == street.meshes
    found = {}
    for time_s in (0.0, 3.1):
        bodies = bodies_at(people.movers, time_s, WALKING_PARTS)
        assert len(bodies) == 4
        for body in bodies:
            assert body[:, 2].min() == pytest.approx(PAVEMENT_UP_M, abs=2e-3)
            across = np.abs(body[:, 1])
            assert across.min() > 8.0, "lamps and trees stand nearer to the road"
            assert across.max() < FACADE_M - 0.2
        found[time_s] = np.array([body.mean(axis=0) for body in bodies])
    assert (found[0.0][:, 1] < 0).tolist() == [True, False] * 2, "on both pavements"
    moved = found[3.1][:, 0] - found[0.0][:, 0]
    np.testing.assert_allclose(moved, 3.1 * 1.4 * np.array([1, 1, -1, -1]), atol=0.12)


def test_who_crosses_goes_from_kerb_to_kerb_and_comes_back(street):
    """At 1 m/s: 6.6 m to the middle of the road, 8.8 m more to where they turn."""
    people = Pedestrians((), (), crossing_m=(3.0, 9.0), speed_mps=1.0).change(street, rng())
    hips = people.movers[0], people.movers[WALKING_PARTS]
    for mover, side, x_m in zip(hips, (-1, 1), (3.0, 9.0), strict=True):
        for time_s, y_m in ((0.0, 6.6), (6.6, 0.0), (15.4, -8.8), (24.2, 0.0), (33.0, 8.8)):
            pose = mover.world_from_mover(time_s)
            assert pose[:2, 3] == pytest.approx([x_m, side * y_m])
        steps = np.linspace(0, 36, 400)
        poses = [mover.world_from_mover(t) for t in steps]
        y_m = np.array([pose[1, 3] for pose in poses])
        ahead = np.array([pose[1, 0] for pose in poses])[:-1]
        assert (np.sign(np.diff(y_m)) == np.sign(ahead)).mean() > 0.98, "they look where they go"
    for time_s in np.linspace(0.0, 20.0, 41):
        for body in bodies_at(people.movers, time_s, WALKING_PARTS):
            assert body[:, 2].min() > -1e-3
            assert body[:, 2].min() < PAVEMENT_UP_M + 2e-3


def test_cyclists_keep_between_the_lane_and_the_bays(street):
    riders = Cyclists((-10.0,), (10.0,), speed_mps=4.0).change(street, rng())
    for time_s in (0.0, 1.3):
        along, oncoming = bodies_at(riders.movers, time_s, RIDING_PARTS)
        for body, direction, start in ((along, 1, -10.0), (oncoming, -1, 10.0)):
            assert body[:, 2].min() == pytest.approx(0.0, abs=1.5e-3), "a tyre has 36 sides"
            across = -direction * body[:, 1]
            assert across.min() > 3.1
            assert across.max() < 4.1
            middle_m = 0.5 * (body[:, 0].min() + body[:, 0].max())
            assert middle_m == pytest.approx(start + direction * 4.0 * time_s, abs=0.2)


def test_in_a_wider_street_nothing_of_the_effects_is_where_it_would_be_in_a_narrow_one():
    """The site, the tunnel, parked vehicles and people are as much farther out as the kerbs."""
    layout = Layout(Geometry(length_m=60.0, wider_m=2.5))
    wide = World(layout, Sky(np.full((16, 32, 3), 0.5, np.float32)))
    for effect, nearest_m in (
        (Works(), 4.1),
        (Tunnel(height_m=5.0), 6.6),
        (ParkedVehicles(1.0), 3.9),
    ):
        made = effect.change(wide, rng())
        points = np.concatenate([mesh.vertices for mesh in made.meshes])
        low = points[points[:, 2] < 4.0]
        assert np.abs(low[:, 1]).min() >= nearest_m + 2.5 - 1e-5
    people = Pedestrians((-10.0, 4.0), (7.0,), (3.0,)).change(wide, rng())
    *along, across = bodies_at(people.movers, 0.0, WALKING_PARTS)
    for body in along:
        assert np.abs(body[:, 1]).min() > 8.0 + 2.5
        assert np.abs(body[:, 1]).max() < layout.facade_m - 0.2
    assert across[:, 1].mean() == pytest.approx(-6.6 - 2.5, abs=0.2)


def test_people_change_nothing_else_in_the_street(street):
    """Other objects stay the same, and vehicles are those of the street without people."""
    for effect in (Pedestrians(), Cyclists()):
        with_people = effect.change(street, rng())
        assert with_people.meshes is street.meshes or with_people.meshes == street.meshes
        assert with_people.sky is street.sky
        assert all(with_people.materials[name] is m for name, m in street.materials.items())
        one, other = (ParkedVehicles().change(world, rng()) for world in (street, with_people))
        assert [m.vertices.tobytes() for m in one.meshes] == [
            m.vertices.tobytes() for m in other.meshes
        ]


@pytest.mark.parametrize("name", ["street-people", "avenue-people", "samples/street/people.toml"])
def test_nobody_of_the_ready_made_people_is_inside_a_vehicle_or_at_the_camera(name, monkeypatch):
    """The middle of a body against vehicles of 5 by 2.2 m, cyclists and the camera."""
    monkeypatch.chdir(ROOT)
    scene = load_scene(name)
    sky = Sky(np.full((16, 32, 3), 0.5, np.float32))
    world = World(Layout(scene.geometry), sky)
    movers, parked = {}, []
    for effect in EFFECTS:
        if effect.name in scene.effects:
            made = scene.effects[effect.name].change(world, rng_of(effect, scene.geometry.seed, 0))
            movers[effect.name] = made.movers
            parked += [mesh.vertices for mesh in made.meshes]
    walkers = movers["pedestrians"][::WALKING_PARTS]
    riders = movers["cyclists"][::RIDING_PARTS]
    standing = np.unique(np.concatenate(parked)[:, :2].round(1), axis=0)
    for shot in shots_of(scene, Split.DRIVE)[::6]:
        now = shot.time_s
        people = np.array([m.world_from_mover(now)[:2, 3] for m in (*walkers, *riders)])
        for mover in movers["traffic"]:
            pose = mover.world_from_mover(now)
            apart = np.abs((people - pose[:2, 3]) @ pose[:2, :2])
            assert ((apart[:, 0] > 2.8) | (apart[:, 1] > 1.2)).all()
        on_foot, riding_m = people[: len(walkers)], people[len(walkers) :]
        for place in riding_m:
            apart = np.abs(on_foot - place)
            assert ((apart[:, 0] > 1.2) | (apart[:, 1] > 0.6)).all()
        near = np.linalg.norm(standing[:, None] - people[None], axis=2)
        assert near.min() > 0.3
        eye = np.array(shot.camera.world_from_cam.translation_m)[:2]
        assert np.linalg.norm(people - eye, axis=1).min() > 1.3


def test_dusk_and_overcast_change_only_the_light(street):
    for effect in (Dusk(cover=0.0), Overcast()):
        changed = effect.change(street, rng())
        assert changed.meshes is street.meshes
        assert changed.materials is street.materials
        assert changed.sky is not street.sky
    assert Dusk(elevation_deg=7.0, cover=0.0).change(street, rng()).sky.sun_towards[
        2
    ] == pytest.approx(np.sin(np.radians(7.0)))


def test_water_darkens_the_ground_to_half_and_makes_it_smooth(street):
    """A texture is darkened on its sRGB curve, of which 1 / 2.2 is close: within 5 %."""
    wet = WetRoad(water=0.6).change(street, rng())
    dry_kerb, wet_kerb = street.materials["kerb"].colour, wet.materials["kerb"].colour
    np.testing.assert_allclose(np.array(wet_kerb), 0.5 * np.array(dry_kerb))
    for name in ("asphalt", "slabs"):
        dry, after = linear(street.materials[name].colour), linear(wet.materials[name].colour)
        assert after.mean() / dry.mean() == pytest.approx(0.5, rel=0.08)
    rough = np.asarray(wet.materials["asphalt"].roughness)
    assert rough.min() < 0.08
    assert rough.max() > 0.4


def test_the_stages_follow_one_another():
    stages = [list(EffectKind).index(effect.kind) for effect in EFFECTS]
    assert stages == sorted(stages)


BUILD = """
import hashlib, sys
from pathlib import Path
sys.meta_path[:] = [f for f in sys.meta_path if not type(f).__module__.startswith("_editable")]
import streetgen
from streetgen import load_scene
from streetgen.build.scene_renderer import RenderJob, SceneRenderer
from streetgen.render.backend import chosen_backend
from streetgen.render.renderer import Sampling
from streetgen.shots import Split, shots_of
scene = load_scene(sys.argv[1])
renderer = SceneRenderer(RenderJob(scene, Path(sys.argv[2]), Sampling(1), chosen_backend(), 2))
renderer.take(shots_of(scene, Split.DRIVE, (64, 36))[0])
files = sorted(path for path in Path(sys.argv[2]).rglob("*") if path.is_file())
print(*(hashlib.sha256(path.read_bytes()).hexdigest() for path in files))
print(*sorted(n for n in sys.modules if n.startswith("streetgen.effects.")))
print(Path(streetgen.__file__).parents[1])
"""
SMALL = 'name = "x"\nfield = "x"\n[geometry]\nlength_m = 40\ntrees = false\n'
PEOPLE = {"pedestrians": "person", "cyclists": "cyclist"}
"""Effects and the modules of geometry that they alone need."""
PARTS = (
    ("parked", "works", "overcast", "haze", "lens", "exposure"),
    ("traffic", "dusk", "wet_road", "rain", "rolling_shutter", "noise"),
    ("pedestrians", "cyclists", "tunnel", "evening", "passing_cloud", "auto_exposure"),
)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("declared", PARTS, ids="-".join)
def test_a_build_neither_imports_nor_needs_what_is_not_declared(tmp_path, declared):
    """Each effect is undeclared in two parts; there its file is deleted, and no byte changes.

    Both run without an editable install's finder, which would lead them to the checkout.
    """
    assert sorted(name for part in PARTS for name in part) == sorted(
        effect.name for effect in EFFECTS
    )
    text = SMALL + "".join(f"[effects.{name}]\n" for name in declared)
    (tmp_path / "s.toml").write_text(text)
    for package in ("streetgen", "rfedge", "rfcore"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("csrc"))
    shutil.copy(str(_native.__file__), tmp_path / "rfcore" / "native")
    street = tmp_path / "streetgen"
    whole = built(tmp_path, tmp_path / "s.toml", tmp_path / "whole")
    for effect in EFFECTS:
        if effect.name not in declared:
            (street / "effects" / f"{effect.name}.py").unlink()
            if effect.name in PEOPLE:
                (street / "geometry" / f"{PEOPLE[effect.name]}.py").unlink()
    assert built(tmp_path, tmp_path / "s.toml", tmp_path / "cut") == whole
    assert Path(whole[2]) == tmp_path
    assert whole[1].split() == sorted(f"streetgen.effects.{name}" for name in declared)


def built(root: Path, scene_file: Path, out: Path) -> list[str]:
    """Return the digests of a picture's files, and the effects that were imported."""
    done = subprocess.run(
        [sys.executable, "-c", BUILD, str(scene_file), str(out)],
        capture_output=True,
        text=True,
        cwd=root,
        env={"PYTHONPATH": str(root), "PATH": "/usr/bin:/bin"},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def added(changed: World, before: World) -> list[Mesh]:
    meshes = list(changed.meshes[len(before.meshes) :])
    assert {mesh.label for mesh in meshes} <= {Label.VEHICLE}
    return meshes


def is_paint(mesh: Mesh) -> bool:
    return mesh.material.startswith("paint")


def linear(colour: object) -> np.ndarray:
    return (np.asarray(colour, float) / 255) ** 2.2
