"""Time the native hash grid renderer on a field trained on the spot, beside the torch reference.

The field learns the sample street for a fixed number of iterations first, so that rays meet
surfaces as in use; or it is a trained one of that street. Before anything is timed, a small picture
must follow the reference in float64: every pixel within 2e-5, but for those where a sample rounds
across the face of a cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter_ns

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.extras import needs, require
from rfcore.field import NgpField, load_field
from rfcore.metrics import psnr
from rfcore.ngp.native import NgpRenderer
from rfcore.ngp.shape import NgpParameters
from rfcore.train.ngp import NgpTrainer, NgpTrainingConfig
from rfcore.views import PosedPicture
from rfedge.samples import sample_path
from rfedge.timing import median_ms

STREET = sample_path("street")
ITERATIONS = 600
BUDGETS = (None, 16, 12, 8)
CASES = (
    *(((300, 168), threads, budget) for threads in (1, 2) for budget in BUDGETS),
    *(((640, 360), 2, budget) for budget in (None, 16)),
)
"""Picture size, threads and budget of each row."""
TRAINING_THREADS = 2
CHECK_SIZE_PX = (48, 27)
TOLERANCE = 2e-5
MAX_FLIPPED = 0.02
"""Share of pixels where a sample may round across the face of an occupied cell."""
HELD_OUT_EVERY = 8


@dataclass(frozen=True)
class NgpRow:
    """One picture size, number of threads and budget of samples along a ray."""

    width: int
    height: int
    threads: int
    frame_ms: float
    """Median."""
    samples_per_ray: float
    """Mean of what was evaluated."""
    psnr_to_reference_db: float | None
    """Against the picture without a budget; None for that one, and for one that equals it."""
    budget: int | None
    """Samples along a ray that were asked for; None: as many as the field needs."""
    isa: str
    held_out_db: float
    """PSNR against pictures the field was not trained on."""
    torch_ms_scaled: float
    """The reference's time on a small picture, scaled by the pixels: an estimate."""


def ngp_rows(field: Path | None = None) -> list[NgpRow]:
    """Return a row per size, number of threads and budget, of ``field`` or of one made here.

    Raises ``DatasetError`` without the sample street (run it from the repository),
    ``FieldFormatError`` for a file that holds no field, ``InvalidInput`` for one of another kind,
    ``RfedgeError`` when the renderer is wrong.
    """
    require("reference", "torch")
    numbers = _trained() if field is None else _loaded(field)
    held_out = read_dataset(STREET / "transforms_drive_empty.json").pictures[::HELD_OUT_EVERY]
    camera = held_out[0].camera
    check_against_reference(numbers, _resized(camera, CHECK_SIZE_PX))
    quality_db = {n: _held_out_db(NgpRenderer(numbers, threads=2), held_out, n) for n in BUDGETS}
    rows = []
    for size, threads, budget in CASES:
        torch_ms = _torch_ms(numbers, _resized(camera, CHECK_SIZE_PX), size)
        renderer = NgpRenderer(numbers, threads=threads)
        rows.append(_row(renderer, _resized(camera, size), budget, (quality_db[budget], torch_ms)))
    return rows


def check_against_reference(numbers: NgpParameters, camera: Camera) -> None:
    """Raise ``RfedgeError`` unless the native colours follow the float64 reference."""
    got = NgpRenderer(numbers).render_colour(camera)
    error = np.abs(got - _reference_colour(numbers, camera)).max(axis=2)
    flipped = float((error > TOLERANCE).mean())
    if not flipped <= MAX_FLIPPED:
        raise RfedgeError(
            f"the hash grid renderer is off by up to {error.max():.2g} from the reference on "
            f"{flipped:.2%} of the pixels (limit {MAX_FLIPPED:.0%}): nothing was timed"
        )


def _trained() -> NgpParameters:
    """Return a field after a short training, rounded as its file would be."""
    dataset = read_dataset(STREET / "transforms_train.json")
    config = NgpTrainingConfig(iterations=ITERATIONS, threads=TRAINING_THREADS)
    trainer = NgpTrainer(dataset.pictures, dataset.points, config, seed=1)
    for _ in trainer.steps():
        pass
    field: NgpField = trainer.field()
    return field.numbers


def _loaded(path: Path) -> NgpParameters:
    field = load_field(path)
    if not isinstance(field, NgpField):
        raise InvalidInput("field", f"{path} holds {field.metadata.kind}; give one of kind ngp")
    return field.numbers


def _row(
    renderer: NgpRenderer, camera: Camera, budget: int | None, beside: tuple[float, float]
) -> NgpRow:
    """Time ``renderer``; ``beside`` holds ``held_out_db`` and ``torch_ms_scaled``."""
    size = camera.intrinsics
    picture = renderer.render_colour(camera, budget)
    samples = renderer.samples / (size.width_px * size.height_px)
    to_reference = None
    if budget is not None:
        exact = _shown(renderer.render_colour(camera))
        same = np.array_equal(_shown(picture), exact)
        to_reference = None if same else psnr(_shown(picture), exact, peak=1.0)
    return NgpRow(
        width=size.width_px,
        height=size.height_px,
        threads=renderer.threads,
        frame_ms=median_ms(lambda: renderer.render_colour(camera, budget)),
        samples_per_ray=round(samples, 2),
        psnr_to_reference_db=to_reference,
        budget=budget,
        isa=renderer.isa,
        held_out_db=beside[0],
        torch_ms_scaled=beside[1],
    )


def _held_out_db(
    renderer: NgpRenderer, held_out: tuple[PosedPicture, ...], budget: int | None
) -> float:
    """Return the mean PSNR over the pictures, at their own size."""
    qualities = [
        psnr(_shown(renderer.render_colour(p.camera, budget)), p.read() / 255.0, peak=1.0)
        for p in held_out
    ]
    return float(np.mean(qualities))


def _shown(colour: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.clip(colour.astype(np.float64), 0.0, 1.0)


def _resized(camera: Camera, size: tuple[int, int]) -> Camera:
    return Camera(camera.intrinsics.resized(*size), camera.world_from_cam)


def _torch_ms(numbers: NgpParameters, camera: Camera, size: tuple[int, int]) -> float:
    """Return the reference's time on a small picture, scaled to one of ``size``."""
    start = perf_counter_ns()
    _reference_colour(numbers, camera)
    pixels = camera.intrinsics.width_px * camera.intrinsics.height_px
    return (perf_counter_ns() - start) / 1e6 * size[0] * size[1] / pixels


def _reference_colour(numbers: NgpParameters, camera: Camera) -> NDArray[np.float64]:

    from rfcore.ngp import reference

    with needs("reference"):
        import torch

    with torch.no_grad():
        colour, _, _ = reference.render(reference.parameters(numbers), numbers, camera)
    picture: NDArray[np.float64] = colour.numpy()
    return picture
