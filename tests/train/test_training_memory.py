"""The memory a run takes is said before it starts, and is about right."""

import subprocess
import sys
from dataclasses import replace

import pytest

from rfcore.errors import InvalidInput
from rfcore.train.ngp import NgpTrainingConfig
from rfcore.train.schedule import DensityControl
from rfcore.train.splats import SplatTrainingConfig
from rfedge.arguments import parse_size
from rfedge.training.memory import (
    BASE_BYTES,
    available_bytes,
    check_memory,
    splat_training_bytes,
    training_bytes,
)

SIZE_PX = (320, 184)
GAUSSIANS = 60_000


STREET = SplatTrainingConfig(density=DensityControl(limit=1_500_000), halved_until=(0.5, 0.2))
LARGE_PX = [(1920, 1080)] * 120


@pytest.mark.parametrize(
    ("config", "available", "options"),
    [
        (STREET, 4 << 30, ["--limit", "--size"]),
        (STREET, 2 << 30, ["--limit"]),
        (replace(STREET, sky=60_000), 1 << 30, ["--size --limit --gaussians"]),
        (replace(STREET, gaussians=1_000_000, density=DensityControl()), 2 << 30, ["--gaussians"]),
        (NgpTrainingConfig(), 1200 << 20, ["--size"]),
    ],
)
def test_a_run_that_does_not_fit_says_what_does(config, available, options):
    """Each remedy, taken alone, fits, and much more would not."""
    with pytest.raises(InvalidInput, match=r"GiB are available; what fits: ") as refused:
        check_memory(config, LARGE_PX, available)
    remedies = str(refused.value).split("what fits: ")[1].split(" or ")
    assert [" ".join(remedy.split()[::2]) for remedy in remedies] == options
    for remedy in remedies:
        words = remedy.split()
        asked = dict(zip(words[::2], words[1::2], strict=True))
        sizes_px = [parse_size(asked["--size"])] * 120 if "--size" in asked else LARGE_PX
        tried = config
        if "--limit" in asked:
            tried = replace(tried, density=DensityControl(limit=int(asked["--limit"])))
        if "--gaussians" in asked:
            tried = replace(tried, gaussians=int(asked["--gaussians"]))
        check_memory(tried, sizes_px, available)
        assert training_bytes(tried, sizes_px) > 0.7 * available


def test_a_run_that_no_option_brings_down_is_refused():
    with pytest.raises(InvalidInput, match="fewer pictures"):
        check_memory(STREET, LARGE_PX, 100 << 20)


def test_a_run_that_fits_or_whose_limit_is_unknown_goes_on():
    check_memory(STREET, LARGE_PX, training_bytes(STREET, LARGE_PX))
    check_memory(STREET, LARGE_PX, None)


def test_available_memory_is_what_the_system_says(tmp_path):
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal: 9 kB\nMemAvailable:    2048 kB\n")
    assert available_bytes(meminfo) == 2 << 20
    assert available_bytes(tmp_path / "nothing") is None
    meminfo.write_text("MemTotal: 9 kB\n")
    assert available_bytes(meminfo) is None


def test_more_of_anything_takes_more():
    one = splat_training_bytes(1000, 2, [SIZE_PX])
    assert splat_training_bytes(2000, 2, [SIZE_PX]) > one
    assert splat_training_bytes(1000, 3, [SIZE_PX]) > one
    assert splat_training_bytes(1000, 2, [SIZE_PX] * 2) - one == 3 * 320 * 184
    assert splat_training_bytes(1000, 2, [SIZE_PX], 1) - one == 0.75 * 320 * 184


RUN = f"""
import numpy as np
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.train.schedule import DensityControl
from rfcore.train.splats import SplatTrainer, SplatTrainingConfig
from rfcore.views import PointCloud, PosedPicture
# Not getrusage: what it says includes the process this one was forked from.
status = lambda: open("/proc/self/status").read()
peak = lambda: 1024 * int(status().split("VmHWM:")[1].split()[0])
rng, before = np.random.default_rng(0), peak()
camera = Camera(Intrinsics({SIZE_PX[0]}, {SIZE_PX[1]}, 160., 160., 160., 92.),
                Pose((0., 0., 0.), (1., 0., 0., 0.)))
rgb = np.full(({SIZE_PX[1]}, {SIZE_PX[0]}, 3), 99, np.uint8)
points = PointCloud((rng.normal(size=({GAUSSIANS // 2}, 3)) + [0, 0, 5]).astype(np.float32),
                    np.full(({GAUSSIANS // 2}, 3), 99, np.uint8))
config = SplatTrainingConfig(gaussians={GAUSSIANS // 2}, iterations=8, density=DensityControl(
    limit={GAUSSIANS}, interval=1, growth=0.5, start=0, stop=1))
trainer = SplatTrainer([PosedPicture("a", camera, lambda: rgb)], points, config)
list(trainer.steps())
trainer.checkpoint()
print(peak() - before)
"""


def test_the_estimate_is_near_the_peak_of_a_real_run():
    done = subprocess.run(
        [sys.executable, "-c", RUN], capture_output=True, text=True, check=True, timeout=60
    )
    estimate = splat_training_bytes(GAUSSIANS, 3, [SIZE_PX]) - BASE_BYTES
    assert 0.6 * estimate < int(done.stdout) < 1.2 * estimate
