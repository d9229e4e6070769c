"""Drives and clips: what is read, decimated and measured."""

import hashlib
import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.metrics import psnr_of_mse
from rfedge.evaluate.clips import (
    ONE_RUN,
    QUICK,
    CodedClip,
    Drive,
    DriveName,
    Runs,
    luma_mse,
    luma_sse,
    read_drive,
)

RNG = np.random.default_rng(2)


def picture(luma):
    chroma = np.full((luma.shape[0] // 2, luma.shape[1] // 2), 128, np.uint8)
    return I420(luma.astype(np.uint8), chroma, chroma)


A, B = (picture(RNG.integers(0, 256, (8, 12))) for _ in range(2))


def test_the_error_is_the_mean_square_whatever_the_order():
    expected = np.mean((A.y.astype(float) - B.y) ** 2)
    assert luma_mse(A, B) == luma_mse(B, A) == pytest.approx(expected)
    assert luma_mse(A, A) == 0


def test_errors_of_complementary_regions_add_up():
    where = RNG.random(A.y.shape) < 0.3
    total = luma_sse(A, B, where) + luma_sse(A, B, ~where)
    assert total == pytest.approx(luma_mse(A, B) * A.y.size)


def test_psnr_falls_by_ten_decibels_for_ten_times_the_error():
    assert psnr_of_mse(255.0**2) == 0
    assert psnr_of_mse(1.0) - psnr_of_mse(10.0) == pytest.approx(10)
    assert psnr_of_mse(0.0) == math.inf


def test_a_clips_quality_and_rate_leave_out_its_first_frame():
    clip = CodedClip(1.0, np.array([900, 10, 30]), np.array([0.0, 2.0, 4.0]), np.ones(3), 1.0)
    assert clip.psnr_db() == psnr_of_mse(3.0)
    assert clip.bytes_per_frame() == 20
    assert clip.psnr_db(slice(None)) == psnr_of_mse(2.0)
    assert clip.bytes_per_frame(slice(0, 1)) == 900


def test_a_drive_is_read_as_far_as_asked(thumbnail):
    whole, two = read_drive(thumbnail.drive), read_drive(thumbnail.drive, 2)
    assert (len(whole.frames), len(two.frames)) == (5, 2)
    assert two.digest == whole.first(2).digest != whole.digest
    assert two.name == DriveName.parse(thumbnail.drive)
    assert read_drive(two.name, 2).digest == two.digest


def test_the_digest_of_a_drive_is_that_of_its_frames_in_order(thumbnail):
    drive = read_drive(thumbnail.drive)
    each = [
        hashlib.blake2b(f"{frame.size_px}".encode() + frame.packed(), digest_size=16).digest()
        for frame in drive.frames
    ]
    assert drive.digest == hashlib.sha256(b"".join(each)).hexdigest()
    assert drive.every(2).digest != drive.first(3).digest


def test_every_nth_frame_is_a_slower_drive(thumbnail):
    drive = read_drive(thumbnail.drive)
    slow = drive.every(2)
    assert slow.name.rate_hz == 5.0
    assert [f.digest() for f in slow.frames] == [f.digest() for f in drive.frames[::2]]
    assert slow.cameras == drive.cameras[::2]


def test_cameras_have_the_poses_a_vehicle_sends(thumbnail):
    drive = read_drive(thumbnail.drive)
    for camera, posed in zip(drive.cameras, drive.pictures, strict=True):
        assert camera.world_from_cam == posed.camera.world_from_cam.rounded()
        assert camera.world_from_cam == camera.world_from_cam.rounded()


def test_a_clip_is_named_with_the_condition_it_is_coded_under(thumbnail):
    drive = read_drive(thumbnail.drive, 2)
    assert drive.clip().scene == "wall"
    noisy = drive.clip("pose noise", 27.5)
    assert (noisy.scene, noisy.rate_hz, noisy.field_psnr_db) == ("wall pose noise", 10.0, 27.5)
    assert noisy.frames_digest == drive.digest


def test_a_noisy_drive_has_the_noise_that_its_name_says_and_always_the_same(thumbnail):
    plain = read_drive(thumbnail.drive)
    noisy, again = (read_drive(f"{thumbnail.drive},noise=3") for _ in range(2))
    assert (noisy.name.scene, noisy.name.noise_sigma) == ("wall noise 3", 3.0)
    assert noisy.digest == again.digest != plain.digest
    assert read_drive(f"{thumbnail.drive},noise=0").digest == plain.digest
    differences = [n.y.astype(float) - p.y for n, p in zip(noisy.frames, plain.frames, strict=True)]
    inside = [(p.y > 20) & (p.y < 235) for p in plain.frames]
    of_all = np.concatenate([d[w] for d, w in zip(differences, inside, strict=True)])
    assert of_all.std() == pytest.approx(3.0, abs=0.1)
    assert abs(of_all.mean()) < 0.1


@pytest.mark.parametrize("noise", ["65", "-1", "much"])
def test_noise_that_is_none_is_refused(noise):
    with pytest.raises(InvalidInput, match=f"noise={noise} is not a number of 0..64"):
        DriveName.parse(f"wall@10=drive.json,noise={noise}")


@given(st.integers(1, 500), st.sampled_from((QUICK, ONE_RUN, Runs(2, 1), Runs(3, 5, 2))))
def test_runs_are_consecutive_and_cover_a_drive_from_end_to_end(length, runs):
    chosen = runs.chosen(length)
    assert len(chosen) == min(length, runs.count * runs.frames)
    assert chosen == sorted(set(chosen))
    starts = [k for k in chosen if k - 1 not in chosen]
    assert all(k + runs.frames - 1 in chosen for k in starts) or len(chosen) == length
    left, right = chosen[0], length - 1 - chosen[-1]
    if runs.count > 1:
        gaps = [b - a for a, b in pairwise(chosen) if b - a > 1]
        assert (left, right) == (0, 0)
        assert max(gaps, default=0) - min(gaps, default=0) <= 1
    else:
        assert abs(right - left) <= 1, "in the middle"


def test_of_each_run_the_settling_frames_do_not_count():
    frames = [A] * 20
    clip = Drive(DriveName.parse("a@10=x"), frames, frames).spread(Runs(2, 4, 2)).clip()
    assert clip.runs == [slice(0, 4), slice(4, 8)]
    assert clip.coded == [0, 2, 3, 6, 7], "the very first stands for the first of the drive"
    assert clip.drive_frames == 20


def test_a_drive_no_longer_than_its_runs_is_whole():
    frames = [A] * 8
    drive = Drive(DriveName.parse("a@10=x"), frames, frames)
    assert drive.spread(Runs(2, 4, 2)).clip() == drive.clip()
