"""The memory a run takes is said before it starts, and is about right."""

import subprocess
import sys

import pytest

from rfcore.errors import InvalidInput
from rfedge.training.run import BASE_BYTES, available_bytes, check_memory, splat_training_bytes

SIZE_PX = (320, 184)
GAUSSIANS = 60_000


def test_a_run_that_does_not_fit_is_refused_with_both_figures():
    with pytest.raises(InvalidInput, match=r"3\.0 GiB of memory and 2\.0 GiB are available"):
        check_memory(3 << 30, 2 << 30)
    check_memory(2 << 30, 2 << 30)
    check_memory(2 << 30, None)


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
    assert splat_training_bytes(1000, 2, [SIZE_PX] * 2) - one == 3 * 1.25 * 320 * 184


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
