"""An encoder that would run in real time does not make us do so."""

import os
from pathlib import Path

import numpy as np
import pytest

from rfcore.image import I420
from rfedge.evaluate.rivals import ordinary_scheduling, svtav1_lowdelay


def policies() -> set[int]:
    return {os.sched_getscheduler(int(task.name)) for task in Path("/proc/self/task").iterdir()}


def test_svtav1_leaves_our_scheduling_as_it_was():
    before = policies()
    luma = np.random.default_rng(0).integers(0, 256, (64, 64), np.uint8)
    frame = I420(luma, luma[::2, ::2].copy(), luma[1::2, 1::2].copy())
    svtav1_lowdelay(12).pictures([frame, frame], 10.0, 40.0)
    assert policies() == before


def test_a_policy_taken_inside_is_given_back():
    before = os.sched_getscheduler(0)
    with ordinary_scheduling():
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    assert os.sched_getscheduler(0) == before


def taken_until_an_error() -> None:
    with ordinary_scheduling():
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        raise RuntimeError("no encoder")


def test_it_is_given_back_after_an_error():
    before = os.sched_getscheduler(0)
    with pytest.raises(RuntimeError, match="no encoder"):
        taken_until_an_error()
    assert os.sched_getscheduler(0) == before
