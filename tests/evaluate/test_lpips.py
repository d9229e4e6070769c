"""LPIPS against a plain evaluation of its formula, with random weights for few channels."""

import hashlib
import pickle
from pathlib import Path

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from rfcore.errors import InvalidInput
from rfcore.image import read_rgb
from rfedge.evaluate import lpips
from rfedge.evaluate.lpips import LAYERS, SCALE, SHIFT, TAPS, Lpips

REAL = Path("out/lpips")
CHANNELS = (5, 6, 4, 7, 3)


def arrays_of(network, rng):
    """Weights as the package has them: convolutions [H, W, in, out], then one kernel a tap."""
    kernels, before, level = {}, 3, 0
    convolutions = [layer for layer in LAYERS[network] if len(layer) == 3]
    for n, (side, *_) in enumerate(convolutions):
        after = CHANNELS[level]
        kernel = rng.normal(0, 1 / np.sqrt(before) / side, (side, side, before, after))
        bias = rng.normal(0, 0.1, after).astype("f4")
        kernels[f"Conv_{n}"] = {"kernel": kernel.astype("f4"), "bias": bias}
        before, level = after, level + (n in TAPS[network])
    linear = {
        f"NetLinLayer_{n}": {"Conv_0": {"kernel": rng.random((1, 1, c, 1)).astype("f4")}}
        for n, c in enumerate(CHANNELS)
    }
    return {"Backbone": kernels, **linear}


def written(folder, network, content, monkeypatch):
    (folder / f"{network}.ckpt").write_bytes(content)
    monkeypatch.setitem(lpips.SHA256, network, hashlib.sha256(content).hexdigest())
    return folder


@pytest.fixture(params=sorted(LAYERS))
def network(request, tmp_path, monkeypatch):
    """A network's name, its arrays, and LPIPS by them."""
    arrays = arrays_of(request.param, np.random.default_rng(3))
    content = pickle.dumps(arrays, protocol=3).replace(b"numpy._core.", b"numpy.core.")
    folder = written(tmp_path, request.param, content, monkeypatch)
    return request.param, arrays, Lpips(folder, request.param)


def picture(seed):
    return np.random.default_rng(seed).integers(0, 256, (40, 47, 3)).astype(np.uint8)


def windows(x, side, stride):
    return sliding_window_view(x, (side, side), axis=(0, 1))[::stride, ::stride]


def formula(name, arrays, a, b):
    """Zhang et al. 2018, eq. 1, window by window."""
    xs = [((p / 127.5 - 1) - np.array(SHIFT)) / np.array(SCALE) for p in (a, b)]
    convolution, tap, total = 0, 0, 0.0
    for side, stride, *padding in LAYERS[name]:
        if not padding:
            xs = [windows(x, side, stride).max(axis=(-2, -1)) for x in xs]
            continue
        layer, border = arrays["Backbone"][f"Conv_{convolution}"], (padding[0],) * 2
        seen = [windows(np.pad(x, (border, border, (0, 0))), side, stride) for x in xs]
        xs = [np.einsum("hwcij,ijco->hwo", w, layer["kernel"]) + layer["bias"] for w in seen]
        xs = [np.maximum(x, 0) for x in xs]
        if convolution in TAPS[name]:
            unit = [x / (np.sqrt((x * x).sum(-1, keepdims=True)) + 1e-10) for x in xs]
            weights = arrays[f"NetLinLayer_{tap}"]["Conv_0"]["kernel"][0, 0, :, 0]
            total += float((((unit[0] - unit[1]) ** 2) @ weights).mean())
            tap += 1
        convolution += 1
    return total


def test_the_distance_is_the_published_formula(network):
    name, arrays, measured = network
    a, b = picture(1), picture(2)
    assert measured.distance(a, b) == pytest.approx(formula(name, arrays, a, b), rel=1e-4)


def test_the_distance_is_symmetric_nought_for_equal_pictures_and_grows_with_noise(network):
    *_, measured = network
    clean, noise = picture(1), np.random.default_rng(5).normal(size=(40, 47, 3))
    noisy = [np.clip(clean + s * noise, 0, 255).astype(np.uint8) for s in (4, 16, 64)]
    distances = [measured.distance(clean, each) for each in noisy]
    assert distances == sorted(distances)
    assert distances[0] > measured.distance(clean, clean) == 0
    assert measured.distance(noisy[2], clean) == pytest.approx(distances[2], abs=2e-6)


def test_another_file_is_refused_before_it_is_read(tmp_path):
    (tmp_path / "alexnet.ckpt").write_bytes(b"weights")
    with pytest.raises(InvalidInput, match="make lpips-weights"):
        Lpips(tmp_path)
    with pytest.raises(InvalidInput, match=r"vgg16.ckpt is missing: make lpips-weights"):
        Lpips(tmp_path, "vgg16")


def test_a_file_that_would_call_something_calls_nothing(tmp_path, monkeypatch):
    class Caller:
        def __reduce__(self):
            return Path.touch, (tmp_path / "called",)

    folder = written(tmp_path, "alexnet", pickle.dumps({"x": Caller()}), monkeypatch)
    with pytest.raises(InvalidInput, match="is no array"):
        Lpips(folder)
    assert not (tmp_path / "called").exists()


def test_pictures_of_two_sizes_or_hardly_any_are_refused(network):
    *_, measured = network
    for a, b in ((picture(1), picture(1)[:, :40]), (picture(1)[:31], picture(1)[:31])):
        with pytest.raises(InvalidInput, match="not two equal sizes from 32 px up"):
            measured.distance(a, b)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "far", "near"), [("alexnet", 0.722, 0.138), ("vgg16", 0.569, 0.422)]
)
def test_the_method_s_own_pictures_have_the_published_distances(name, far, near):
    """With the weights (``make lpips-weights``) and, beside them, ex_ref.png, ex_p0.png and
    ex_p1.png of the method's repository, which are not ours to ship."""
    if not (REAL / "ex_ref.png").is_file():
        pytest.skip(f"needs the weights and example pictures in {REAL}")
    reference, first, second = (read_rgb(REAL / f"ex_{n}.png") for n in ("ref", "p0", "p1"))
    measured = Lpips(REAL, name)
    assert measured.distance(reference, first) == pytest.approx(far, abs=5e-4)
    assert measured.distance(reference, second) == pytest.approx(near, abs=5e-4)
