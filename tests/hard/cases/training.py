"""Hard training: gradients against float64, losses in closed form, steps that never go astray."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from hard.cases.case import Case, Finding, statement, within
from hard.cases.scenes import (
    AHEAD,
    RATES,
    TURNED,
    Values,
    arrays_of,
    blobs,
    gradient_error,
    one_splat,
    poisoned,
    without,
)
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.trainable import TrainableRasterizer

GROUP = "Training"
GRADIENT_LIMIT = 1e-4
"""Relative, of a parameter group: float32 carries 1e-7, sums of hundreds of pixels cancel some."""

FOLLOWED: dict[str, tuple[Values, Camera]] = {
    "needle of 7 m by 15 nm": ({"log_scales": (2.0, -18.0, -18.0)}, AHEAD),
    "needle, turned camera": ({"log_scales": (2.0, -18.0, -18.0)}, TURNED),
    "disc of 3 m by 15 nm": ({"log_scales": (1.0, 1.0, -18.0)}, TURNED),
    "ball of 10 km around the camera": ({"log_scales": np.log(1e4)}, AHEAD),
    "ball of 10 nm": ({"log_scales": np.log(1e-8)}, TURNED),
    "quaternion of norm 4e15": ({"quaternions": (1e15, -2e15, 3e15, 0.0)}, AHEAD),
    "quaternion of norm 1e-5": ({"quaternions": (6e-6, 0.0, 8e-6, 0.0)}, TURNED),
    "zero quaternion": ({"quaternions": 0.0}, AHEAD),
    "opacity logit 30": ({"opacity_logits": 30.0}, AHEAD),
    "opacity logit -30": ({"opacity_logits": -30.0}, AHEAD),
    "just beyond the near plane": ({"means": (0.001, -0.002, 0.010001)}, AHEAD),
    "straddling the near plane": ({"means": (0.05, 0.02, 0.02), "log_scales": -1.0}, AHEAD),
    "a quarter of all at one point": ({"means": (0.1, 0.1, 3.0)}, TURNED),
    "black (SH below zero)": ({"sh": -5.0}, AHEAD),
}

POISONS: dict[str, Values] = {
    "needles": {"log_scales": (2.0, -18.0, -18.0)},
    "10 km balls": {"log_scales": np.log(1e4)},
    "scales beyond float32": {"log_scales": 3e38},
    "zero quaternions": {"quaternions": 0.0},
    "opaque": {"opacity_logits": 30.0},
    "at the camera centre": {"means": 0.0},
    "at the near plane": {"means": (0.001, -0.002, 0.010001)},
    "all at one point": {"means": (0.1, 0.1, 3.0)},
    "harmonics of 3e38": {"sh": 3e38},
}

LOSS_LIMIT = 0.2 * 4 * 2.0**-24 / 9e-4
"""Variances of flat pictures are differences of squares, four roundings, over C2, times 0.2."""

STEPS = 30


def _followed(values: Values, camera: Camera) -> Finding:
    error = gradient_error(poisoned(blobs(), values), camera)
    return within(error, GRADIENT_LIMIT, "the gradients of float64")


def _followed_antialiased() -> Finding:
    values = {"log_scales": (1.0, -5.0, -5.0)}
    error = gradient_error(poisoned(blobs(), values), TURNED, antialiased=True)
    return within(error, GRADIENT_LIMIT, "the gradients of float64")


def _saturated_logit() -> Finding:
    """1 - sigmoid(x) at x = 12 has four digits in float32; sigmoid(-x) has them all."""
    far = one_splat(opacity_logits=12.0, log_scales=[-3.0, -2.5, -2.0])
    error = gradient_error(far, TURNED)
    return within(error, GRADIENT_LIMIT, "the gradients of float64")


def _steps(values: Values, seed: int) -> Finding:
    """Steps on noise; ``gaussians()`` raises on any parameter that is not finite."""
    trainable = TrainableRasterizer(poisoned(blobs(), values))
    targets = np.random.default_rng(seed).random((4, 24, 40, 3), dtype=np.float32)
    losses = []
    for step in range(STEPS):
        losses.append(trainable.iterate((AHEAD, TURNED)[step % 2], targets[step % 4], RATES))
        trainable.gaussians()
    good = bool(np.isfinite(losses).all())
    return statement(good, f"loss {losses[0]:.3g} to {losses[-1]:.3g}", "a loss is not finite")


def _repeats() -> Finding:
    first, again, threaded = (_trained(threads) for threads in (1, 1, 3))
    return statement(first == again == threaded, "equal bytes", "bytes differ")


def _trained(threads: int) -> bytes:
    poison = {"log_scales": (2.0, -18.0, -18.0)}
    trainable = TrainableRasterizer(poisoned(blobs(), poison), threads=threads)
    target = np.random.default_rng(0).random((24, 40, 3), dtype=np.float32)
    for _ in range(10):
        trainable.iterate(TURNED, target, RATES)
    return b"".join(array.tobytes() for array in arrays_of(trainable.gaussians()))


def _unseen_do_not_move() -> Finding:
    """Behind the camera nothing is learned and no moment decays: the others train as alone."""
    both = poisoned(blobs(), {"means": (0.0, 0.0, -3.0)})
    target = np.random.default_rng(0).random((24, 40, 3), dtype=np.float32)
    results = []
    for gaussians in (both, without(blobs())):
        trainable = TrainableRasterizer(gaussians)
        for _ in range(5):
            trainable.iterate(AHEAD, target, RATES)
        results.append(trainable.gaussians())
    moved, alone = results
    same = all(
        x.tobytes() == y.tobytes()
        for x, y in zip(arrays_of(without(moved)), arrays_of(alone), strict=True)
    )
    still = moved.means[::4].tobytes() == both.means[::4].tobytes()
    return statement(same and still, "equal bytes", "an unseen Gaussian moved something")


def _flat_loss(level: float, target: float, size_px: tuple[int, int]) -> Finding:
    """Loss of flat pictures against the definition on the very same pixels."""
    import torch

    from rfcore.raster.reference import loss_l1_dssim

    camera = _camera(size_px)
    trainable = TrainableRasterizer(_wall(level))
    colour = trainable.forward(camera).colour
    goal = np.full_like(colour, target)
    got = trainable.loss(goal)
    drawn, wanted = (torch.tensor(p, dtype=torch.float64) for p in (colour, goal))
    want = float(loss_l1_dssim(drawn, wanted))
    return within(abs(got - want), LOSS_LIMIT, f"loss {got:.6f}")


def _loss_of_equals() -> Finding:
    trainable = TrainableRasterizer(blobs())
    colour = trainable.forward(TURNED).colour
    loss = trainable.loss(colour.copy())
    trainable.backward()
    largest = max(float(np.abs(g).max()) for g in trainable.gradients().values())
    return Finding(
        f"loss {loss}, gradient {largest:.1e}", loss == 0.0 and largest < 1e-6, loss, 0.0
    )


def _one_pixel_gradient() -> Finding:
    camera = _camera((1, 1))
    return within(gradient_error(one_splat(), camera), GRADIENT_LIMIT, "the gradients of float64")


def _adam_from_rest() -> Finding:
    """A gradient of zero, with zero moments: 0 / (0 + 1e-15) moves nothing."""
    trainable = TrainableRasterizer(blobs())
    view = trainable.forward(AHEAD)
    before = trainable.gaussians()
    trainable.backward(np.zeros_like(view.colour))
    trainable.adam_step(RATES)
    after = trainable.gaussians()
    same = all(
        x.tobytes() == y.tobytes() for x, y in zip(arrays_of(before), arrays_of(after), strict=True)
    )
    return statement(same, "equal bytes", "something moved")


def _gradient_of_1e30() -> Finding:
    """A gradient beyond 1e15 counts as zero instead of becoming an infinite moment."""
    trainable = TrainableRasterizer(blobs())
    view = trainable.forward(AHEAD)
    trainable.backward(np.full_like(view.colour, 1e30))
    trainable.adam_step(RATES)
    before, after = arrays_of(blobs()), arrays_of(trainable.gaussians())
    moved = max(float(np.abs(x - y).max()) for x, y in zip(before, after, strict=True))
    return within(moved, max(RATES.opacity, RATES.means) * 1.01, "no step longer than a rate")


def _wall(level: float) -> Gaussians:
    """Nothing at level 0, else opaque layers that leave nothing of the background."""
    sh = (level / 0.99 - 0.5) / 0.28209479177387814
    logit = 30.0 if level else -30.0
    return one_splat(opacity_logits=logit, log_scales=[6.0] * 3, sh=[[sh] * 3])


def _camera(size_px: tuple[int, int]) -> Camera:
    width, height = size_px
    return Camera(Intrinsics(width, height, 30.0, 30.0, 0.5 * width, 0.5 * height), Pose.identity())


def _case(name: str, expected: str, measure: Callable[[], Finding]) -> Case:
    return Case(GROUP, name, expected, measure)


CASES = (
    *(
        _case(f"gradient: {name}", "float64, relative by group", partial(_followed, values, camera))
        for name, (values, camera) in FOLLOWED.items()
    ),
    _case(
        "gradient: thin needle, antialiased", "float64, relative by group", _followed_antialiased
    ),
    _case("gradient: opacity logit 12", "float64, relative by group", _saturated_logit),
    _case("gradient: one pixel", "float64, relative by group", _one_pixel_gradient),
    *(
        _case(f"{STEPS} steps: {name}", "finite after every step", partial(_steps, values, 11))
        for name, values in POISONS.items()
    ),
    _case("the same seed, 1 and 3 threads", "the same bytes", _repeats),
    _case("Gaussians nobody sees", "stay, and leave the others' bytes alone", _unseen_do_not_move),
    _case("black against black", "loss 0", partial(_flat_loss, 0.0, 0.0, (40, 24))),
    _case("black against white", "the float64 loss", partial(_flat_loss, 0.0, 1.0, (40, 24))),
    _case("white against white", "the float64 loss", partial(_flat_loss, 1.0, 1.0, (33, 17))),
    _case("one pixel against grey", "the float64 loss", partial(_flat_loss, 0.5, 0.25, (1, 1))),
    _case("a picture against itself", "loss exactly 0, no gradient", _loss_of_equals),
    _case("Adam without a gradient", "nothing moves", _adam_from_rest),
    _case("colour gradient of 1e30", "no step longer than a rate", _gradient_of_1e30),
)
