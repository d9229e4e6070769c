"""A user's class renders the field at both ends, on the command line and in Python."""

import hashlib
import sys
from pathlib import Path

import numpy as np
import pytest

from rfcore.dataset import read_dataset
from rfcore.errors import RfedgeError
from rfcore.field import load_field
from rfcore.field.own import OwnField
from rfcore.wire.drive_file import read_drive
from rfedge.cli import parse
from rfedge.offline import CodingSettings, encode_drive
from rfedge.samples import sample_path

CLASSES = """
import hashlib
from dataclasses import replace
from pathlib import Path

from rfcore.field import load_field

STREET = load_field(Path({store!r}) / "street.rff")


class Darker:
    "Forwards to a field of ours, and overrides what is documented."

    field_id = hashlib.sha256(b"darker").hexdigest()
    exact = True

    def __getattr__(self, name):
        return getattr(STREET, name)

    def render(self, camera, quality):
        view = STREET.render(camera, quality)
        return replace(view, colour=view.colour * 0.9)


class Rounding(Darker):
    field_id = hashlib.sha256(b"rounding").hexdigest()
    exact = False
"""


@pytest.fixture
def classes(street, tmp_path, monkeypatch):
    """The name of a module in the working folder with classes that render the small street."""
    name = f"streets_{hashlib.sha256(str(tmp_path).encode()).hexdigest()[:8]}"
    (tmp_path / f"{name}.py").write_text(CLASSES.format(store=str(street.store)))
    monkeypatch.chdir(tmp_path)
    yield name
    sys.modules.pop(name, None)


@pytest.mark.parametrize(("named", "exact"), [("Darker", True), ("Rounding", False)])
async def test_vehicle_and_server_render_by_the_class(
    classes, named, exact, serve, travel, tmp_path
):
    spec = f"{classes}:{named}"
    async with serve(field=(spec,)) as server:
        record = await travel(server.address, field=spec, fields=tmp_path / "none")
        plain = await travel(server.address)
    assert record.counts == {"acked": 6}
    renders = [[line["render_digest"] for line in r.lines] for r in (record, plain)]
    assert not set(renders[0]) & set(renders[1]), "the class's own picture is used"
    alone = all(line["references"] == ["render"] for line in record.lines)
    assert alone is not exact, "inexact sessions predict from the render alone"


async def test_a_server_without_the_class_refuses_its_field(classes, serve, travel):
    async with serve() as server:
        with pytest.raises(RfedgeError, match=hashlib.sha256(b"darker").hexdigest()):
            await travel(server.address, field=f"{classes}:Darker")


@pytest.mark.parametrize(("named", "exact"), [("Darker", True), ("Rounding", False)])
def test_the_commands_take_the_class(classes, named, exact, street, tmp_path):
    spec, coded, out = f"{classes}:{named}", tmp_path / "drive.rfv", tmp_path / "pictures"
    parse(["encode", str(street.drive), "--field", spec, "--out", str(coded)]).run()
    assert read_drive(coded).hello.renderer.exact is exact
    parse(["decode", str(coded), "--field", spec, "--out", str(out)]).run()
    assert len(list(out.glob("*.png"))) == 6
    parse(["render", spec, "--drive", str(street.drive), "--out", str(tmp_path / "seen")]).run()
    assert len(list((tmp_path / "seen").glob("*.png"))) == 6


def test_a_class_that_shows_what_an_archive_shows_codes_the_same_bytes(street):
    class Same:
        field_id = street.field_id
        exact = True
        render = street.field.render

    dataset, settings = read_dataset(street.drive), CodingSettings(effort="fast")
    slices = [
        [frame.packet.payload for frame in encode_drive(dataset, field, settings).frames]
        for field in (OwnField(Same(), "Same"), street.field)
    ]
    assert slices[0] == slices[1]


def test_the_example_draws_the_ground_of_the_sample_street(monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[2])
    from rfcore.field.own import own_field

    camera = read_dataset(sample_path("street/transforms_drive_empty.json")).pictures[0].camera
    drawn, street = (
        field.render(camera)
        for field in (
            own_field("examples.own_field:Plane"),
            load_field(sample_path("fields/street.rff")),
        )
    )
    road = (slice(-40, None), slice(280, 360))
    assert np.median(drawn.depth[road]) == pytest.approx(np.median(street.depth[road]), rel=0.1)
