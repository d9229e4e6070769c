"""The common part of all trainers: iterations, a digest, metadata, detection of divergence.

The trainer of a kind of field is a ``FieldTrainer`` that defines one iteration and its parameters.
Quality on pictures that a field was not trained on is measured here too.

A checkpoint is the complete state of a training run on disk, from which it ends with the same
bytes. The container is that of fields (``rfcore.field.archive``), of kind ``checkpoint``: digests
cover every byte, and a file is replaced whole or not at all.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, TileOrigin, median_focal_px
from rfcore.errors import FieldFormatError, InvalidInput, TrainingDiverged
from rfcore.field import FieldMetadata, RadianceField
from rfcore.field.archive import Archive, decode_archive, encode_archive, read_file
from rfcore.files import write_whole
from rfcore.geodesy import Anchor
from rfcore.metrics import psnr, ssim
from rfcore.vertical import sights_of, vertical_of
from rfcore.views import PosedPicture

KIND = "checkpoint"


@dataclass(frozen=True)
class Checkpoint:
    """A run after ``iteration`` iterations.

    ``kind`` and ``training_digest`` identify the run; ``values`` (JSON) and ``arrays`` are the
    trainer's own.
    """

    kind: str
    training_digest: str
    iteration: int
    values: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]

    def check(self, kind: str, training_digest: str) -> None:
        """Raise ``InvalidInput`` unless this belongs to the run ``training_digest``."""
        if (self.kind, self.training_digest) != (kind, training_digest):
            raise InvalidInput(
                "checkpoint",
                f"is of {self.kind} run {self.training_digest[:12]}, not of {kind} run "
                f"{training_digest[:12]}: give the same pictures, settings and seed, or start anew",
            )


def write_checkpoint(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint, whole or not at all."""
    metadata = {
        "trainer": checkpoint.kind,
        "training_digest": checkpoint.training_digest,
        "iteration": checkpoint.iteration,
        "values": dict(checkpoint.values),
    }
    arrays = {name: np.ascontiguousarray(array) for name, array in checkpoint.arrays.items()}
    write_whole(path, encode_archive(Archive(KIND, metadata, arrays)))


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint; raise ``FieldFormatError`` naming the file and what is wrong."""
    archive = decode_archive(read_file(path), str(path))
    if archive.kind != KIND:
        raise FieldFormatError(f"{path}: holds '{archive.kind}', not a {KIND}")
    m = archive.metadata
    try:
        return Checkpoint(
            str(m["trainer"]),
            str(m["training_digest"]),
            int(m["iteration"]),
            dict(m["values"]),
            archive.arrays,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FieldFormatError(f"{path}: not a readable checkpoint ({error!r})") from error


WINDOW = 100
"""Iterations whose mean loss is compared."""
TOLERATED_RISE = 1.5
NOT_OF_THE_RESULT = ("threads", "isa")
"""Settings that change only the time of a run, and no byte of the field."""


@dataclass(frozen=True)
class TrainingProgress:
    """The result of one iteration; ``iteration`` counts from 1 to ``total``."""

    iteration: int
    total: int
    loss: float


@dataclass(frozen=True)
class HeldOut:
    """Quality on pictures never trained on: means over them of RGB PSNR and SSIM."""

    psnr_db: float
    ssim: float | None = None

    def __post_init__(self) -> None:
        if not math.isfinite(self.psnr_db):
            raise InvalidInput("held_out.psnr_db", f"{self.psnr_db} must be finite")


class FieldTrainer(ABC):
    """One training run, an iteration at a time.

    ``training_digest`` is the SHA-256, in hex, of everything that the result depends on.
    """

    kind: ClassVar[str]
    """``splats`` or ``ngp``."""

    def __init__(
        self, iterations: int, training_digest: str, cameras: Sequence[Camera] = ()
    ) -> None:
        self.training_digest = training_digest
        self.total = iterations
        """Iterations of the whole run."""
        self.iteration = 0
        """Iterations done so far."""
        self._watch = DivergenceWatch()
        self._up = vertical_of(camera.world_from_cam for camera in cameras)
        self._sights = sights_of(cameras)
        self._focal_px = median_focal_px([c.intrinsics for c in cameras]) if cameras else None

    @property
    def finished(self) -> bool:
        """True if every iteration has been done."""
        return self.iteration >= self.total

    def step(self, progress: float | None = None) -> TrainingProgress:
        """Do one iteration; ``progress`` 0..1 replaces the share of iterations done.

        Raises ``InvalidInput`` when the run is finished, ``TrainingDiverged`` when it no longer
        gets anywhere.
        """
        if self.finished:
            raise InvalidInput("training", f"all {self.total} iterations are done")
        if progress is None:
            progress = self.iteration / self.total
        loss = self._descend(progress)
        self.iteration += 1
        self._watch.see(self.iteration, loss, self._parameters)
        self._after_iteration(progress)
        return TrainingProgress(self.iteration, self.total, loss)

    def steps(self) -> Iterator[TrainingProgress]:
        """Do the iterations that are left, one at a time."""
        while not self.finished:
            yield self.step()

    @property
    @abstractmethod
    def primitives(self) -> int:
        """The number of Gaussians, or of numbers of a hash grid, being learned."""

    @abstractmethod
    def field(
        self,
        name: str = "",
        tile_origin: TileOrigin | None = None,
        held_out: HeldOut | None = None,
        anchor: Anchor | None = None,
    ) -> RadianceField:
        """Return what has been learned so far."""

    @abstractmethod
    def checkpoint(self) -> Checkpoint:
        """Return the state for ``restore`` of a trainer with the same inputs."""

    @abstractmethod
    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on after ``checkpoint``. Raises ``InvalidInput`` when it is of another run."""

    @abstractmethod
    def _descend(self, progress: float) -> float:
        """Do one step of descent; return its loss."""

    @abstractmethod
    def _after_iteration(self, progress: float) -> None:
        """Do the work between two iterations, of which ``iteration`` are done."""

    @abstractmethod
    def _parameters(self) -> Any:
        """Return the groups of parameters as a dataclass of arrays."""

    def _metadata(
        self,
        name: str,
        tile_origin: TileOrigin | None,
        held_out: HeldOut | None,
        *,
        anchor: Anchor | None = None,
        antialiased: bool = False,
    ) -> FieldMetadata:
        """Return the metadata of the field learned so far."""
        return FieldMetadata(
            name=name,
            tile_origin=tile_origin if tile_origin is not None else TileOrigin(),
            training_digest=self.training_digest,
            held_out_psnr_db=held_out.psnr_db if held_out is not None else None,
            held_out_ssim=held_out.ssim if held_out is not None else None,
            antialiased=antialiased,
            kind=self.kind,
            anchor=anchor,
            up=self._up,
            sights=self._sights,
            focal_px=self._focal_px,
        )


def settings_of(config: Any) -> list[tuple[str, Any]]:
    """Return the settings of a configuration that the result depends on, as (name, value)."""
    kept = [f.name for f in fields(config) if f.name not in NOT_OF_THE_RESULT]
    return [(name, getattr(config, name)) for name in kept]


class DivergenceWatch:
    """Detects that a run has diverged.

    The mean loss over ``WINDOW`` iterations of a run that learns falls. If it rises above
    ``TOLERATED_RISE`` times its lowest value, and above its first, the run has diverged; the error
    names the group of parameters whose size grew most since the first window.
    """

    def __init__(self) -> None:
        self._sum = 0.0
        self._first: float | None = None
        self._lowest = math.inf
        self._sizes: dict[str, float] = {}

    def see(self, iteration: int, loss: float, parameters: Callable[[], Any]) -> None:
        """Take the loss of one iteration; raise ``TrainingDiverged`` if the run has diverged."""
        if not math.isfinite(loss):
            raise TrainingDiverged(iteration, self._grown(parameters()), f"the loss is {loss}")
        self._sum += loss
        if iteration % WINDOW:
            return
        mean, self._sum = self._sum / WINDOW, 0.0
        if self._first is None:
            self._first, self._sizes = mean, _sizes(parameters())
        self._lowest = min(self._lowest, mean)
        if mean > max(TOLERATED_RISE * self._lowest, self._first):
            raise TrainingDiverged(
                iteration,
                self._grown(parameters()),
                f"a mean loss of {mean:.3g} after {self._lowest:.3g}; lower the group's rate",
            )

    def values(self) -> dict[str, Any]:
        """Return what ``restore`` needs, as JSON."""
        lowest = self._lowest if math.isfinite(self._lowest) else None
        return {"sum": self._sum, "first": self._first, "lowest": lowest, "sizes": self._sizes}

    def restore(self, values: dict[str, Any]) -> None:
        """Go on from ``values``."""
        self._sum, self._first = values["sum"], values["first"]
        self._lowest = math.inf if values["lowest"] is None else values["lowest"]
        self._sizes = values["sizes"]

    def _grown(self, parameters: Any) -> str:
        growth = {
            name: size / max(self._sizes.get(name, size), 1e-9)
            for name, size in _sizes(parameters).items()
        }
        return max(growth, key=lambda name: growth[name])


def _sizes(parameters: Any) -> dict[str, float]:
    """Return the root of the mean square of every group, the arrays of a dataclass."""
    arrays = {f.name: getattr(parameters, f.name) for f in fields(parameters)}
    return {
        name: float(np.sqrt(np.mean(np.square(array, dtype=np.float64)))) if array.size else 0.0
        for name, array in arrays.items()
    }


def mean_psnr_db(field: RadianceField, pictures: Sequence[PosedPicture]) -> float:
    """Return the mean over pictures of the RGB PSNR of the field's view, clipped to 0..1."""
    _check(pictures)
    values = [psnr(*_pair(field, p), peak=1.0, mask=p.read_mask()) for p in pictures]
    return float(np.mean(values))


def held_out_quality(field: RadianceField, pictures: Sequence[PosedPicture]) -> HeldOut:
    """Return the means over pictures of RGB PSNR and SSIM of the field's view."""
    _check(pictures)
    psnr_db, similarity = [], []
    for picture in pictures:
        pair, mask = _pair(field, picture), picture.read_mask()
        psnr_db.append(psnr(*pair, peak=1.0, mask=mask))
        similarity.append(ssim(*pair, peak=1.0, mask=mask))
    return HeldOut(float(np.mean(psnr_db)), float(np.mean(similarity)))


def mean_colour_db(shown: Sequence[PosedPicture], seen: Sequence[PosedPicture]) -> float:
    """Return the mean PSNR of ``seen`` against the mean colour of ``shown`` everywhere: what knows
    nothing of a place has."""
    colour = np.mean([picture.read().mean(axis=(0, 1)) / 255.0 for picture in shown], axis=0)
    values_db = []
    for picture in seen:
        rgb = picture.read() / 255.0
        flat = np.broadcast_to(colour, rgb.shape)
        values_db.append(psnr(flat, rgb, peak=1.0, mask=picture.read_mask()))
    return float(np.mean(values_db))


def _check(pictures: Sequence[PosedPicture]) -> None:
    if not pictures:
        raise InvalidInput("pictures", "at least one is needed to measure a field")


def _pair(
    field: RadianceField, picture: PosedPicture
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    colour = np.clip(field.render_colour(picture.camera).astype(np.float64), 0.0, 1.0)
    return colour, picture.read() / 255.0
