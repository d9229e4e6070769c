"""Which of a tile's lights a frame is coded against."""

import numpy as np

from cav_agent.lights import FITS_LEVELS, TRY_EVERY, TileLights
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.packet import median_block_mean_difference
from rfcore.field import FULL, FieldMetadata, Quality, SplatField
from rfcore.field.quality import Beginning
from rfcore.harmonics import SH_DC
from rfcore.image import I420
from rfcore.raster.gaussians import Gaussians

CAMERA = Camera(Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0), Pose.identity())


def flat(level: float) -> SplatField:
    """One large splat of one grey before the camera."""
    arrays = {
        "means": [[0, 0, 5]], "quaternions": [[1, 0, 0, 0]], "log_scales": [[3, 3, 0]],
        "opacity_logits": [9], "sh": [[[(level - 0.5) / SH_DC] * 3]],
    }  # fmt: skip
    splat = Gaussians(**{name: np.asarray(a, np.float32) for name, a in arrays.items()})
    return SplatField(splat, FieldMetadata(name=f"{level}"))


def frame_of(field: SplatField) -> I420:
    return TileLights(field).view(grey(128), CAMERA, FULL).render


def grey(level: int) -> I420:
    half = np.full((24, 32), 128, np.uint8)
    return I420(np.full((48, 64), level, np.uint8), half, half)


def test_the_light_that_fits_is_taken_and_named() -> None:
    noon, dusk, night = flat(0.8), flat(0.4), flat(0.1)
    lights = TileLights(noon)
    lights.add(dusk)
    lights.add(night)
    view = lights.view(frame_of(dusk), CAMERA, FULL)
    assert lights.current is dusk
    assert lights.named_id == dusk.field_id
    assert view.render.digest() == frame_of(dusk).digest()


def test_while_the_field_fits_nothing_is_wanted() -> None:
    wanted: list[int] = []
    noon = flat(0.8)
    lights = TileLights(noon, lambda: wanted.append(1))
    lights.add(flat(0.7))
    for _ in range(3 * TRY_EVERY):
        lights.view(frame_of(noon), CAMERA, FULL)
    assert not wanted
    assert lights.current is noon
    assert lights.named_id == ""


def test_a_light_that_arrives_later_is_looked_at_by_the_next_frame() -> None:
    wanted: list[int] = []
    noon, dusk = flat(0.8), flat(0.4)
    lights = TileLights(noon, lambda: wanted.append(1))
    lights.view(frame_of(dusk), CAMERA, FULL)
    assert wanted == [1]
    assert lights.current is noon
    lights.add(dusk)
    lights.view(frame_of(dusk), CAMERA, FULL)
    assert lights.current is dusk


def test_between_two_lights_the_one_in_use_stays() -> None:
    """Half-way between them neither is clearly nearer."""
    noon, dusk = flat(0.6), flat(0.4)
    lights = TileLights(noon)
    lights.add(dusk)
    middle = round(float(np.median([frame_of(noon).y, frame_of(dusk).y])))
    for step in (-1, 1, -1, 1):
        for _ in range(TRY_EVERY):
            lights.view(grey(middle + step), CAMERA, FULL)
        assert lights.current is noon


def test_the_day_comes_back_to_the_tiles_own_field() -> None:
    noon, dusk = flat(0.8), flat(0.4)
    lights = TileLights(noon)
    lights.add(dusk)
    for field in (dusk, noon):
        for _ in range(TRY_EVERY + 1):
            lights.view(frame_of(field), CAMERA, FULL)
        assert lights.current is field


def test_vehicles_do_not_look_like_another_light() -> None:
    """A third of the picture in white: the median of the blocks is what it was."""
    seen = grey(100)
    seen.y[:16] = 235
    assert median_block_mean_difference(seen, grey(100)) == 0
    assert median_block_mean_difference(grey(140), grey(100)) == 40 > FITS_LEVELS


def test_the_own_field_takes_the_place_of_its_preview_with_the_next_frame() -> None:
    """Frames of the preview are named by its id, those of the own field by none."""
    preview, own, dusk = flat(0.79), flat(0.8), flat(0.4)
    lights = TileLights(preview, own_id=own.field_id)
    lights.view(frame_of(own), CAMERA, FULL)
    assert lights.named_id == preview.field_id
    lights.take_own(own)
    assert lights.named_id == preview.field_id, "the frame that is coded was drawn from it"
    view = lights.view(frame_of(own), CAMERA, FULL)
    assert lights.named_id == ""
    assert view.render.digest() == frame_of(own).digest()
    assert lights.held_ids() == {own.field_id}
    lights.add(dusk)
    for _ in range(TRY_EVERY):
        lights.view(frame_of(dusk), CAMERA, FULL)
    assert lights.current is dusk


def test_another_light_stays_when_the_own_field_arrives() -> None:
    preview, own, dusk = flat(0.79), flat(0.8), flat(0.4)
    lights = TileLights(preview, own_id=own.field_id)
    lights.add(dusk)
    lights.view(frame_of(dusk), CAMERA, FULL)
    lights.take_own(own)
    lights.view(frame_of(dusk), CAMERA, FULL)
    assert lights.current is dusk
    assert lights.held_ids() == {own.field_id, dusk.field_id}


def beginning_of(field: SplatField, detail: float) -> SplatField:
    """The first splats of a field, which draw it up to ``detail``."""
    begun = SplatField(field.gaussians, field.metadata, beginning=Beginning(4, detail))
    begun.field_id = field.field_id
    return begun


def test_a_part_of_the_field_is_drawn_at_the_detail_it_has_until_more_arrives() -> None:
    """Frames are named by the tile's own field throughout; what it shows depends on the detail."""
    own = flat(0.8)
    lights = TileLights(beginning_of(own, 0.1))
    half_size = Quality(scale=0.5)
    assert lights.drawable(half_size) == Quality(detail=0.1, scale=0.5)
    assert lights.drawable(Quality(detail=0.1)) == Quality(detail=0.1)
    lights.take_own(beginning_of(own, 0.25))
    assert lights.drawable(FULL) == Quality(detail=0.25)
    view = lights.view(frame_of(own), CAMERA, Quality(detail=0.25))
    assert view.render.digest() == frame_of(own).digest()
    lights.take_own(own)
    assert lights.drawable(FULL) == FULL
    assert lights.current is own
    assert lights.named_id == ""


def test_a_part_is_no_light_for_frames_of_more_detail_than_it_has() -> None:
    own, dusk = flat(0.8), flat(0.4)
    lights = TileLights(beginning_of(own, 0.25))
    lights.add(dusk)
    for _ in range(2 * TRY_EVERY):
        lights.view(frame_of(dusk), CAMERA, lights.drawable(FULL))
    assert lights.current is dusk
    for _ in range(2 * TRY_EVERY):
        lights.view(frame_of(own), CAMERA, lights.drawable(FULL))
    assert lights.current is dusk, "the part cannot be drawn at full detail"
    lights.take_own(own)
    for _ in range(2 * TRY_EVERY):
        lights.view(frame_of(own), CAMERA, lights.drawable(FULL))
    assert lights.current is own
