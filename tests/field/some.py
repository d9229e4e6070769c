"""Small sets of Gaussians, and files of other programs that hold them."""

from pathlib import Path

import numpy as np

from rfcore.field.ply_table import read_vertices
from rfcore.harmonics import SH_DC
from rfcore.raster.gaussians import Gaussians, gaussian_shapes


def make_gaussians(n: int = 5, sh_degree: int = 3, seed: int = 0) -> Gaussians:
    """Return ``n`` random Gaussians of an SH degree."""
    rng = np.random.default_rng(seed)
    shapes = gaussian_shapes(n, sh_degree)
    return Gaussians(**{k: rng.normal(size=s).astype(np.float32) for k, s in shapes.items()})


def as_text(ply: Path, digits: int = 9) -> bytes:
    """Return a binary file as text, with nine digits as float32 needs."""
    table = read_vertices(ply, ())
    header, _, _ = ply.read_bytes().partition(b"end_header\n")
    lines = [" ".join(f"{value:.{digits}g}" for value in row.tolist()) for row in table]
    text = header.replace(b"binary_little_endian", b"ascii") + b"end_header\n"
    return text + "\n".join(lines).encode()


def compressed_ply(splats: Gaussians, *, bounded_colours: bool = True) -> bytes:
    """Return splats in the layout of PlayCanvas: written from its description, chunk by chunk."""
    n, k = len(splats), splats.sh.shape[1]
    starts = range(0, n, 256)
    opacity = 1 / (1 + np.exp(-splats.opacity_logits.astype(np.float64)))
    rgb = 0.5 + SH_DC * splats.sh[:, 0].astype(np.float64)
    columns = {"": splats.means, "scale_": splats.log_scales}
    chunks, words = [], []
    for start in starts:
        part = slice(start, start + 256)
        bounds, shares = [], []
        for values in (*columns.values(), *([rgb] if bounded_colours else [])):
            low, high = values[part].min(axis=0), values[part].max(axis=0)
            bounds += [low, high]
            shares.append((values[part] - low) / np.maximum(high - low, 1e-9))
        chunks.append(np.concatenate(bounds).astype("<f4"))
        colours = shares[2] if bounded_colours else np.clip(rgb[part], 0, 1)
        rgba = np.concatenate([colours, opacity[part, None]], axis=1)
        packed = [_bits(shares[0], (11, 10, 11)), _rotations(splats.quaternions[part])]
        packed += [_bits(shares[1], (11, 10, 11)), _bits(rgba, (8, 8, 8, 8))]
        words.append(np.stack(packed, axis=1).astype("<u4"))
    names = [
        f"{side}_{kind}{axis}" for kind in columns for side in ("min", "max") for axis in "xyz"
    ]
    names += [f"{side}_{axis}" for side in ("min", "max") for axis in "rgb"] * bounded_colours
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {len(chunks)}"]
    lines += [f"property float {name}" for name in names] + [f"element vertex {n}"]
    lines += [f"property uint packed_{name}" for name in ["position", "rotation", "scale", "color"]]
    lines += [f"element sh {n}", *(f"property uchar f_rest_{i}" for i in range(3 * (k - 1)))]
    rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(n, -1)
    bands = np.clip(np.trunc((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8)
    tables = [np.concatenate(chunks).tobytes(), np.concatenate(words).tobytes(), bands.tobytes()]
    return "\n".join([*lines, "end_header\n"]).encode() + b"".join(tables)


def _bits(shares: np.ndarray, widths: tuple[int, ...]) -> np.ndarray:
    packed = np.zeros(len(shares), np.uint64)
    for column, width in enumerate(widths):
        level = np.floor(shares[:, column] * (2**width - 1) + 0.5).astype(np.uint64)
        packed = packed << np.uint64(width) | level
    return packed


def _rotations(quaternions: np.ndarray) -> np.ndarray:
    packed = []
    for q in quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True):
        largest = int(np.abs(q).argmax())
        others = np.delete(q, largest) * np.sign(q[largest])
        word = largest
        for value in others:
            word = word << 10 | int(np.floor((value / 2**0.5 + 0.5) * 1023 + 0.5))
        packed.append(word)
    return np.array(packed, np.uint64)
