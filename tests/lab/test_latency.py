"""``rfedge-lab latency``: tau, waiting and dropping by arithmetic, and a run from files."""

import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from lab.latency import EvalLatency
from lab.latency.run import (
    AHEAD_BYTES,
    FRAMES_FOR_REQUIREMENT,
    REQUIREMENT,
    needed_rate_bps,
    play,
    run_latency,
)
from rfcore.errors import InvalidInput
from rfcore.link.plan import DirectionPlan
from rfcore.link.shaper import LinkProfile


def constant(rate_bps, delay_s=0.0):
    return DirectionPlan(LinkProfile(rate_bps, delay_s))


def test_tau_is_bits_over_rate_and_propagation_comes_after_it():
    played = play([1000, 2000], 10, constant(1e6, 0.02))
    np.testing.assert_allclose(played.tau_ms, [8, 16])
    np.testing.assert_allclose(played.network_ms, [28, 36])


def test_a_frame_waits_for_the_one_before_and_a_third_is_dropped():
    played = play([2500] * 4, 100, constant(1e6))  # 20 ms each, one every 10 ms
    np.testing.assert_allclose(played.network_ms, [20, 30, 40])
    assert played.dropped == 1
    assert played.frames == 4


@pytest.mark.parametrize("budget_ms", [5.0, 10.0])
def test_the_needed_rate_sends_the_largest_frame_within_the_budget(budget_ms):
    sizes = [1000] * 90 + [4000] * 10
    needed = needed_rate_bps(sizes, 10, budget_ms)
    exact = 8 * 4000 / (budget_ms / 1e3)
    assert exact <= needed <= 1.006 * exact
    assert play(sizes, 10, constant(needed)).quantile_ms(0.99) <= budget_ms


def test_one_large_frame_in_a_thousand_does_not_count_for_99_percent():
    sizes = [1000] * 999 + [100_000]
    assert needed_rate_bps(sizes, 10, 10) < 1.01 * 8 * 1000 / 0.01


def test_a_budget_that_nothing_meets_is_an_error():
    with pytest.raises(InvalidInput, match="not even 1e\\+10 bit/s"):
        needed_rate_bps([10**9], 10, 1e-3)


def test_the_requirement_takes_three_hundred_thousand_frames():
    """So many in a row without a late one have a chance of 5 % where the true share is 99.999 %."""
    assert REQUIREMENT**FRAMES_FOR_REQUIREMENT <= 0.05 < REQUIREMENT ** (FRAMES_FOR_REQUIREMENT - 1)
    assert 299_000 < FRAMES_FOR_REQUIREMENT < 300_000


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 30.0])
def test_on_a_link_that_is_quick_enough_nothing_waits_and_nothing_is_dropped(rate_hz):
    sizes = [500, 2000, 800] * 20
    played = play(sizes, rate_hz, constant(8 * 2000 * rate_hz))
    assert played.dropped == 0
    np.testing.assert_allclose(played.network_ms, played.tau_ms, rtol=1e-9)


def test_no_latency_is_below_its_transmission_and_propagation():
    rng = np.random.default_rng(3)
    sizes = rng.integers(100, 6000, 300).tolist()
    played = play(sizes, 20, constant(4e5, 0.01))
    assert played.dropped > 0
    assert played.frames == 300
    assert (played.network_ms >= played.tau_ms + 10 - 1e-9).all()


def test_shares_and_quantiles_agree():
    sizes = np.random.default_rng(4).integers(100, 6000, 300).tolist()
    played = play(sizes, 10, constant(4e5))
    for share in (0.1, 0.5, 0.9):
        assert played.share_within(played.quantile_ms(share)) >= share
        assert played.share_within(played.quantile_ms(share) - 1e-6) <= share


@pytest.fixture(scope="module")
def latency(thumbnail, tmp_path_factory):
    folder = tmp_path_factory.mktemp("latency")
    # One packet of 1500 bytes every 12 ms: 1 Mbit/s, in Mahimahi's format.
    (folder / "steady.up").write_text("\n".join(str(12 * k) for k in range(1, 2000)))
    job = EvalLatency(
        field=thumbnail.field,
        drives=(thumbnail.drive,),
        traces=(folder / "steady.up",),
        effort="fast",
        preset="ultrafast",
        quality_db=36.0,
        out=folder / "latency.json",
        cells=folder / "cells",
        quick=True,
    )
    return job, run_latency(job, Console(quiet=True))


def test_both_methods_are_played_at_the_same_quality_over_every_link(latency):
    _, result = latency
    assert len(result["needed"]) == 2
    for row in result["needed"]:
        assert 36.0 <= row["psnr_db"] < 37.5
    links = {row["link"] for row in result["rows"]}
    assert len(result["rows"]) == 2 * len(links) == 2 * 10
    assert "steady" in links


def test_a_quicker_link_takes_no_longer(latency):
    _, result = latency
    for method in {row["method"] for row in result["rows"]}:
        rows = [r for r in result["rows"] if r["method"] == method and "Mbit" in r["link"]]
        rows.sort(key=lambda row: row["rate_bps"])
        taus = [row["tau_ms"]["mean"] for row in rows]
        assert taus == sorted(taus, reverse=True)
        shares = [row["share_within"]["10"] for row in rows]
        assert shares == sorted(shares)


def test_a_recorded_link_of_a_constant_rate_takes_about_as_long_as_the_rate(latency):
    _, result = latency
    for method in {row["method"] for row in result["rows"]}:
        recorded, constant_rate = (
            next(r for r in result["rows"] if (r["method"], r["link"]) == (method, link))
            for link in ("steady", "1 Mbit/s")
        )
        assert recorded["rate_bps"] == pytest.approx(1e6, rel=1e-3)
        # A packet leaves at the next of its link's ticks: at most 12 ms later.
        wait_ms = recorded["network_ms"]["p50"] - constant_rate["network_ms"]["p50"]
        assert -0.01 <= wait_ms <= 12.01


def test_the_uplink_that_is_needed_sends_99_percent_in_time(latency):
    job, result = latency
    for row in result["needed"]:
        five, ten = (row["uplink_bps_p99_within"][budget] for budget in ("5", "10"))
        assert five > ten
        assert ten >= 0.99 * 8 * row["largest_kbit"] / 8 * 1e3 / 0.01
    assert json.loads(job.out.read_text()) == result


def test_what_both_ends_compute_is_told_stage_by_stage(latency):
    _, result = latency
    ours, theirs = (row["stage_ms"] for row in result["needed"])
    assert {"sender render", "sender encode", "receiver render", "receiver decode"} <= ours.keys()
    assert theirs.keys() == {"sender encode", "receiver decode"}
    assert all(ms >= 0 for ms in (*ours.values(), *theirs.values()))


def test_from_capture_to_shown_takes_longer_than_the_link_alone(latency):
    _, result = latency
    rows = {(row["method"], row["link"]): row for row in result["rows"]}
    alone = [row for row in result["shown"] if not row["pose_ahead"]]
    assert {(row["method"], row["link"]) for row in alone} >= rows.keys()
    for shown in alone:
        assert 0 < shown["sender_busy_percent"] < 100
        played = rows.get((shown["method"], shown["link"]))
        if played is None:  # a link that the frames alone are not played over
            continue
        assert shown["frames"] == played["frames"]
        assert (shown["width_px"], shown["height_px"]) == (96, 64)
        if shown["dropped"] == played["dropped"] == 0:
            assert shown["sent_ms"]["mean"] > played["network_ms"]["mean"]


def test_with_the_pose_ahead_no_frame_is_shown_later(latency):
    _, result = latency
    ours = {row["method"] for row in result["shown"] if row["pose_ahead"]}
    rows = {
        (row["link"], row["pose_ahead"]): row for row in result["shown"] if row["method"] in ours
    }
    links = {link for link, _ in rows}
    assert len(rows) == 2 * len(links)
    for link in links:
        if rows[link, True]["dropped"] == rows[link, False]["dropped"] == 0:
            pose_ms = 8e3 * AHEAD_BYTES / rows[link, True]["rate_bps"]
            waited_ms = rows[link, False]["shown_p50_ms"]
            assert rows[link, True]["shown_p50_ms"] <= waited_ms + 2 * pose_ms


@pytest.mark.parametrize(
    ("change", "named"), [({"out": Path("x.txt")}, "out"), ({"quality_db": 10.0}, "quality_db")]
)
def test_a_job_that_cannot_be_done_is_refused_by_name(change, named):
    with pytest.raises(InvalidInput, match=named):
        EvalLatency(**change)
