"""Renders are drawn in advance, so that the first pictures of a server are not late."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from mec_server.fields.service import FieldShelf
from rfcore.camera import Camera
from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.field import Bounds, FieldMetadata
from rfcore.field.interface import NGP, SPLATS
from rfcore.field.quality import FULL, Quality
from rfcore.views import View

LONG_EAST = Bounds((-10.0, 2.0, 0.0), (30.0, 6.0, 8.0))
LONG_NORTH = Bounds((2.0, -10.0, 0.0), (6.0, 30.0, 8.0))


@dataclass
class DrawnField:
    """A field that notes from where it was drawn."""

    primitives: int
    kind: str = SPLATS
    bounds: Bounds = LONG_EAST
    problem: Exception | None = None
    drawn: list[Camera] = field(default_factory=list)

    @property
    def metadata(self) -> FieldMetadata:
        return FieldMetadata(kind=self.kind)

    def render(self, camera: Camera, quality: Quality = FULL) -> View:  # noqa: ARG002
        self.drawn.append(camera)
        if self.problem is not None:
            raise self.problem
        size = (camera.intrinsics.height_px, camera.intrinsics.width_px)
        zero = np.zeros(size, np.float32)
        return View(np.zeros((*size, 3), np.float32), zero, zero)


class Fields(dict[str, DrawnField]):
    """A store of such fields."""

    def ids(self) -> list[str]:
        return list(self)

    def path(self, field_id: str) -> Path:
        raise AssertionError(field_id)


def warm_shelf(**fields: DrawnField) -> FieldShelf:
    shelf = FieldShelf(Fields(fields), fields.__getitem__)  # type: ignore[arg-type]
    assert shelf.warm_up() == len(fields)
    return shelf


def test_a_field_that_cannot_be_opened_harms_no_other() -> None:
    fields = Fields(good=DrawnField(100), bad=DrawnField(100))

    def load(field_id: str) -> DrawnField:
        if field_id == "bad":
            raise FieldFormatError("bad: damaged")
        return fields[field_id]

    shelf = FieldShelf(fields, load)  # type: ignore[arg-type]
    assert shelf.warm_up() == 1
    del fields["good"]
    with pytest.raises(FieldFormatError, match="bad: damaged"):
        FieldShelf(fields, load).warm_up()  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("bounds", "forward", "middle"),
    [
        (LONG_EAST, (1.0, 0.0, 0.0), (10.0, 4.0, 4.0)),
        (LONG_NORTH, (0.0, 1.0, 0.0), (4.0, 10.0, 4.0)),
    ],
)
def test_a_field_is_drawn_from_its_middle_along_its_longer_side(
    bounds: Bounds, forward: tuple[float, ...], middle: tuple[float, ...]
) -> None:
    street = DrawnField(100, bounds=bounds)
    warm_shelf(street=street).draw_once()
    (camera,) = street.drawn
    rotation = np.array(camera.world_from_cam.rotation_matrix())
    assert camera.world_from_cam.translation_m == middle
    np.testing.assert_allclose(rotation[:, 2], forward, atol=1e-12)
    np.testing.assert_allclose(rotation[:, 1], (0, 0, -1), atol=1e-12)  # a camera's y is down


def test_the_one_of_most_splats_is_drawn_and_a_hash_grid_is_not() -> None:
    small, large, grid = DrawnField(10), DrawnField(20), DrawnField(30, kind=NGP)
    warm_shelf(small=small, large=large, grid=grid).draw_once()
    assert (len(small.drawn), len(large.drawn), len(grid.drawn)) == (0, 1, 0)


def test_a_field_that_cannot_be_drawn_there_does_not_stop_a_server_nor_do_none() -> None:
    refuses = DrawnField(10, problem=InvalidInput("field", "too large"))
    warm_shelf(refuses=refuses).draw_once()
    assert len(refuses.drawn) == 1
    FieldShelf(Fields(), Fields().__getitem__).draw_once()  # type: ignore[arg-type]
    broken = DrawnField(10, problem=ZeroDivisionError())
    with pytest.raises(ZeroDivisionError):
        warm_shelf(broken=broken).draw_once()
