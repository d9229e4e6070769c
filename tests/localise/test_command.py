"""``rfedge localise`` measures poses and writes them."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cav_agent.pose_feed import FieldPlacement
from lab.localisation.pose_errors import PoseErrorModel
from lab.localisation.pose_feed import FeedPlan, MakeFeed, feed_lines
from rfcore.camera import Camera, Intrinsics, Pose, TileOrigin
from rfcore.dataset import read_dataset
from rfcore.dataset.trajectory import read_trajectory
from rfcore.errors import InvalidData, InvalidInput
from rfcore.field import Bounds, load_field
from rfcore.localise.localiser import Localised, Lost, Obstacle
from rfcore.localise.matching import PnpSolution
from rfcore.motion import rotation_vector
from rfcore.views import PosedPicture
from rfedge.cli.dataset import DatasetConvert
from rfedge.cli.localise import Localise
from rfedge.localisation.report import write_localise_report
from rfedge.localisation.searches import (
    RecordedFeed,
    SearchOutcome,
    SearchSummary,
    StartError,
    displaced,
    parse_start_error,
    searches_from_displaced,
    write_poses,
)

SAMPLES = Path(__file__).parents[2] / "samples"
POSE = Pose((1.0, 2.0, 3.0), (0.5, -0.5, 0.5, -0.5))
CAMERA = Camera(Intrinsics(4, 4, 2, 2, 2, 2), POSE)
LOST = Lost(Obstacle.FEW_INLIERS, 7)
ERROR = StartError(2.0, 3.0)


def picture(number: int, time_ns: int = 0) -> PosedPicture:
    return PosedPicture(
        f"{number}.png", CAMERA, lambda: np.zeros((4, 4, 3), np.uint8), time_ns=time_ns
    )


def outcome(number: int, error_m: float | None, time_ns: int = 0) -> SearchOutcome:
    """A search that was lost, or found a pose; right where it is within 0.01 m."""
    if error_m is None:
        return SearchOutcome(picture(number, time_ns), POSE, LOST, None, None, False, 100.0, 90.0)
    found = Localised(PnpSolution(POSE, 90, 0.5), 80.0, 1)
    right = error_m < 0.01
    return SearchOutcome(picture(number, time_ns), POSE, found, error_m, 0.02, right, 300.0, 250.0)


def test_a_start_is_exactly_as_far_off_as_asked_and_mostly_level():
    rng = np.random.default_rng(1)
    starts = [POSE.inverse().compose(displaced(POSE, ERROR, rng)) for _ in range(50)]
    for start in starts:
        assert math.hypot(*start.translation_m) == pytest.approx(2.0)
        assert math.hypot(*rotation_vector(start.rotation)) == pytest.approx(math.radians(3.0))
    assert np.std([start.translation_m[1] for start in starts]) < 0.4
    yaws = [rotation_vector(start.rotation)[1] for start in starts]
    assert min(map(abs, yaws)) > math.radians(2.5)
    assert {yaw > 0 for yaw in yaws} == {True, False}


def test_a_summary_counts_right_and_wrong_poses_of_all_tries():
    done = [outcome(n, error_m) for n, error_m in enumerate((0.002, 0.004, 1.0, None))]
    row = SearchSummary.of("drive", ERROR, done)
    assert (row.tries, row.localised_percent, row.false_percent) == (4, 50.0, 25.0)
    assert row.median_m == 0.004
    assert row.p95_m == pytest.approx(0.004 + 0.9 * 0.996)
    assert (row.localise_ms, row.localise_cpu_ms) == (300.0, 250.0)
    assert "50.0 % of 4 localised" in str(row)
    assert "no pose" in str(SearchSummary.of("drive", ERROR, [outcome(0, None)]))


def test_poses_are_written_once_a_picture_and_gaps_are_told(tmp_path):
    out = tmp_path / "poses.tum"
    done = [outcome(n, 0.001 if n != 1 else None, n * 100_000_000) for n in range(3)]
    assert write_poses(out, [*done, outcome(2, 0.001)]) == 2
    read = read_trajectory(out)
    assert read.times_ns == (0, 200_000_000)
    assert read.poses == (POSE, POSE)
    assert "# 0.100000000 lost: few inliers" in out.read_text()


def test_poses_of_pictures_without_times_are_numbered(tmp_path):
    out = tmp_path / "poses.tum"
    assert write_poses(out, [outcome(n, 0.001) for n in range(3)]) == 3
    assert out.read_text().startswith("# number of the picture tx ty tz qx qy qz qw\n0 1 2 3 ")


@pytest.mark.parametrize("text", ["2m", "3deg:2m", "0m:1deg", "2m:0deg", "-1m:1deg", "nanm:1deg"])
def test_a_start_error_of_another_form_is_refused(text):
    with pytest.raises(InvalidInput, match="is not METRESm:DEGREESdeg, such as 2m:3deg"):
        parse_start_error(text)


def test_a_start_error_may_have_fractions():
    assert parse_start_error("0.5m:1.25deg") == StartError(0.5, 1.25)


@pytest.mark.sample
def test_the_command_localises_the_samples_drive(tmp_path, capsys):
    out, result = tmp_path / "poses.tum", tmp_path / "localise.json"
    drive = SAMPLES / "street/transforms_drive_empty.json"
    field = SAMPLES / "fields/street.rff"
    Localise(drive, field, tries=3, out=out, json=str(result)).run()
    (row,) = json.loads(result.read_text())["rows"]
    assert (row["tries"], row["localised_percent"], row["false_percent"]) == (3, 100.0, 0.0)
    assert row["median_m"] < 0.03
    assert len(read_trajectory(out).poses) == 3
    assert "100.0 % of 3 localised" in capsys.readouterr().out


@pytest.mark.sample
def test_the_report_shows_errors_matches_and_what_was_lost(tmp_path):
    field = load_field(SAMPLES / "fields/street.rff")
    pictures = read_dataset(SAMPLES / "street/transforms_drive_empty.json").pictures
    dark = replace(pictures[1], read=lambda: np.zeros((360, 640, 3), np.uint8))
    rng = np.random.default_rng(1)
    done = list(searches_from_displaced(field, [pictures[0], dark], ERROR, 2, rng))
    out = tmp_path / "report.html"
    write_localise_report(out, field, SearchSummary.of("drive", ERROR, done), done)
    page = out.read_text()
    assert "50.0 % of 2 pictures found their pose" in page
    assert f"<td>{dark.name}</td><td>the picture has too few features" in page
    assert "The best pose" in page
    assert "The first one lost" in page
    assert page.count("data:image/jpeg;base64,") == 4
    agree, count = re.search(r"render: (\d+) of (\d+) matches agree", page).groups()
    assert 0.5 * int(count) < int(agree) <= int(count)
    assert page.count("<svg") == 2


@pytest.mark.sample
def test_a_recorded_feed_says_where_to_search(tmp_path):
    drive, feed = SAMPLES / "street/transforms_drive_empty.json", tmp_path / "feed.jsonl"
    MakeFeed(drive, str(feed), form="xyz", errors="gnss,rate_hz=5", seed=2).run()
    result = tmp_path / "result.json"
    pictures = 4
    short = tmp_path / "drive"
    DatasetConvert(drive, short, every=6).run()
    Localise(short, SAMPLES / "fields/street.rff", pose_feed=feed, json=str(result)).run()
    (row,) = json.loads(result.read_text())["rows"]
    assert row["tries"] == pictures
    assert row["localised_percent"] == 100.0
    assert 0.3 < row["start_m"] < 10.0


@pytest.mark.sample
def test_a_feed_of_another_time_is_refused(tmp_path):
    drive, feed = SAMPLES / "street/transforms_drive_empty.json", tmp_path / "feed.jsonl"
    MakeFeed(drive, str(feed), form="xyz", start_s=1.7e9).run()
    with pytest.raises(InvalidInput, match="see --feed-offset-s"):
        Localise(drive, SAMPLES / "fields/street.rff", pose_feed=feed).run()
    feed.write_text("nothing\n")
    with pytest.raises(InvalidData, match="holds no fix"):
        Localise(drive, SAMPLES / "fields/street.rff", pose_feed=feed).run()


@pytest.mark.parametrize("late_s", [-0.25, 0.4])
def test_poses_that_were_found_tell_how_late_a_feed_is(tmp_path, late_s):
    poses = [Pose((8.0 * math.sin(0.15 * n), 0.6 * n, 0.0), POSE.rotation) for n in range(60)]
    times_s = [10.0 + 0.1 * n for n in range(60)]
    pictures = [
        replace(picture(n, round(time_s * 1e9)), camera=replace(CAMERA, world_from_cam=pose))
        for n, (time_s, pose) in enumerate(zip(times_s, poses, strict=True))
    ]
    errors = PoseErrorModel(offset_m=1.0, rate_hz=5.0)
    plan = FeedPlan("xyz", errors, times_s[0] + late_s)
    file = tmp_path / "feed.jsonl"
    file.write_text("".join(text for _, text in feed_lines(poses, times_s, plan)))
    feed = RecordedFeed.read(file, 0.0)
    place = FieldPlacement(None, TileOrigin())
    feed.priors(pictures, place, Bounds((-99, -99, -99), (99, 99, 99)), 10.0)
    done = [
        replace(
            outcome(n, 0.001),
            picture=p,
            answer=Localised(PnpSolution(p.camera.world_from_cam, 90, 0.5), 80.0, 1),
        )
        for n, p in enumerate(pictures)
    ]
    told = feed.time_offset(pictures, done)
    found = re.match(r"add (-?[\d.]+) s to its times", told)
    assert found is not None, told
    assert float(found[1]) == pytest.approx(-late_s, abs=0.05)
