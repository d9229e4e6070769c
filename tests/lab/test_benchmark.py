"""rfedge-bench: frozen, open to any command, and not to be cheated by what can be seen."""

import hashlib
import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from lab.benchmark import BenchmarkRun
from lab.benchmark.definition import (
    V1,
    Benchmark,
    BenchmarkDrive,
    print_scores,
    read_benchmark,
    record_anchors,
    score_parts,
    score_rows,
)
from lab.benchmark.method import (
    DECODER_NEEDS,
    Command,
    check_decoder,
    run_method,
)
from lab.benchmark.submission import check_submission, read_submission
from lab.cli import parse
from rfcore.errors import CodecError, InvalidData, InvalidInput, RfedgeError
from rfcore.image import I420, write_png
from rfcore.native.yuv import rgb_from_i420
from rfedge.evaluate.clips import Clip, read_drive
from rfedge.evaluate.compare.drives import rival_families
from rfedge.evaluate.compare.measure import BOOTSTRAP_SEED, WINDOWS_DB
from rfedge.evaluate.performance import perform
from rfedge.evaluate.rate_curve import MIN_POINTS, RateCurve
from rfedge.evaluate.rivals import x264_lowdelay
from rfedge.results import make_result, provenance

V1_SHA256 = "ab00137c0dad515dc781fd1a7fe2d7c957f918fcdc838cf79787fde14b800e24"
EXAMPLES = Path(__file__).parents[2] / "examples"
CRFS = (8.0, 14.0, 20.0, 26.0, 32.0, 38.0)
X264 = f"{sys.executable} {EXAMPLES / 'bench_x264.py'} {{frames}} {{hz}} {{point}} {{out}}"


def quiet(_text: str) -> None:
    pass


# --- the definition -----------------------------------------------------------------------------


def test_v1_is_frozen():
    """A change becomes v2 beside it: scores name this digest."""
    assert hashlib.sha256(V1.read_bytes()).hexdigest() == V1_SHA256


def test_v1_is_read_with_its_anchors():
    v1 = read_benchmark()
    assert v1.version == "rfedge-bench v1"
    assert {(d.name, a.name) for d in v1.drives for a in v1.anchors} == v1.anchor_clips.keys()
    for drive in v1.drives:
        for anchor in v1.anchors:
            clips = v1.anchor_clips[drive.name, anchor.name]
            assert [clip.point for clip in clips] == list(anchor.points)
            assert all(len(clip.frame_bytes) == drive.frames for clip in clips)


@pytest.mark.parametrize("name", ["sample-empty", "sample-vehicles"])
def test_the_samples_are_the_drives_of_v1(name):
    assert len(read_benchmark().drive(name).read().frames) == 24


def test_v1_compares_as_the_comparison_does():
    """Code that no longer does what v1 says needs a v2, not another v1."""
    scoring = read_benchmark().scoring
    assert scoring.windows_db == WINDOWS_DB
    assert scoring.seed == BOOTSTRAP_SEED
    assert scoring.least_points == MIN_POINTS


def test_the_anchors_of_v1_run_as_the_rivals_of_the_comparison():
    families = rival_families("veryfast")
    rivals = {rival.name: rival for family in families.values() for rival in family}
    for anchor in read_benchmark().anchors:
        rival: Any = rivals[anchor.name]
        same = (rival.encoder, rival.decoder, dict(rival.options))
        assert same == (anchor.encoder, anchor.decoder, dict(anchor.options)), anchor.name


def test_an_anchor_comes_out_as_it_is_recorded():
    v1 = read_benchmark()
    (anchor,) = [a for a in v1.anchors if a.name == "x264-lowdelay-veryfast"]
    rows = json.loads(v1.recorded.read_text())
    (row,) = [r for r in rows if (r["drive"], r["anchor"]) == ("sample-empty", anchor.name)]
    assert row["encoder"] == anchor.version, "recorded with another x264"
    frames = v1.drive("sample-empty").read().frames[:3]
    coded = anchor.code(frames, 10.0, 29.0)
    recorded = v1.anchor_clips["sample-empty", anchor.name][anchor.points.index(29.0)]
    assert coded.frame_bytes.tolist() == recorded.frame_bytes[:3].tolist()
    assert coded.luma_mse.tolist() == pytest.approx(recorded.luma_mse[:3].tolist(), rel=1e-12)


def test_v1_scores_as_it_did_when_it_was_frozen():
    v1 = read_benchmark()
    headline = replace(v1.scoring, windows_db=v1.scoring.windows_db[:1])
    v1 = replace(v1, scoring=headline, anchors=v1.anchors[:1])
    clips = v1.anchor_clips["sample-empty", "x265-lowdelay-psnr-medium"]
    clip = Clip("sample-empty", 10.0, [], "", None)
    (row,), break_even = score_rows(v1, clip, "x265", clips, 0)
    assert break_even == []
    assert (row.rival, row.window_db) == ("x264-our-tools-medium", (32.0, 35.0))
    assert row.bd_rate_percent == pytest.approx(GOLDEN_BD_RATE, abs=1e-6)
    assert row.ci95 == pytest.approx(GOLDEN_CI95, abs=1e-6)
    own = v1.anchor_clips["sample-empty", row.rival]
    assert score_rows(v1, clip, "itself", own, 0)[0][0].bd_rate_percent == 0


GOLDEN_BD_RATE, GOLDEN_CI95 = -3.593759041767455, (-5.691207891814563, -1.9795819112294164)


def test_anchors_that_were_changed_are_refused(tmp_path):
    changed = tmp_path / "anchors.json"
    changed.write_text("[]\n")
    with pytest.raises(InvalidData, match=r"has the digest .*, rfedge-bench v1 names"):
        _ = replace(read_benchmark(), recorded=changed).anchor_clips


def test_a_key_that_v1_does_not_know_is_refused(tmp_path):
    (tmp_path / "v.toml").write_text(V1.read_text().replace("seed = 2026", "seeds = 2026"))
    with pytest.raises(InvalidData, match=r"interval\.seed is missing"):
        read_benchmark(tmp_path / "v.toml")


def test_a_drive_that_nobody_ships_says_how_to_get_it():
    with pytest.raises(InvalidInput, match=r"kitti-loop is not here: .*KITTI odometry 00"):
        read_benchmark().drive("kitti-loop").read()


def test_points_too_far_apart_in_a_window_are_refused():
    scoring = read_benchmark().scoring
    curve = RateCurve(np.array([20.0, 25, 30, 33.5, 36, 40]), np.arange(1.0, 7))
    with pytest.raises(InvalidInput, match=r"none between 30\.00 and 33\.50 dB.*limit is 3 dB"):
        scoring.check_dense(curve, (32.0, 35.0))
    scoring.check_dense(curve, (33.5, 36.0))


# --- a small benchmark with one drive -----------------------------------------------------------


@pytest.fixture(scope="module")
def small(thumbnail: Any, tmp_path_factory: pytest.TempPathFactory) -> Benchmark:
    """A benchmark of five frames, with x264 as the only anchor."""
    folder = tmp_path_factory.mktemp("small")
    v1, drive = read_benchmark(), read_drive(thumbnail.drive)
    ours = BenchmarkDrive(
        "wall", 10.0, len(drive.frames), (96, 64), drive.digest,
        str(drive.name.dataset), "made by this test", "nothing", required=True,
    )  # fmt: skip
    scoring = replace(v1.scoring, windows_db=((32.0, 36.0),), most_gap_db=9.0, repetitions=20)
    anchors = (replace(x264_lowdelay("veryfast"), points=CRFS),)
    made = folder / "anchors.json"
    benchmark = replace(
        v1, version="small", drives=(ours,), anchors=anchors, scoring=scoring, recorded=made
    )
    record_anchors(benchmark, [drive], made, quiet)
    return replace(benchmark, recorded_sha256=hashlib.sha256(made.read_bytes()).hexdigest())


def job_of(out: Path, method: str = X264, **change: Any) -> BenchmarkRun:
    given = BenchmarkRun(out, method, "x264", CRFS, version="1", only=("wall",))
    return replace(given, **change)


@pytest.fixture(scope="module")
def handed_in(small: Benchmark, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The submission of x264, with a prior of ten bytes that it does not use."""
    folder = tmp_path_factory.mktemp("handed_in")
    (folder / "map.bin").write_bytes(b"0123456789")
    run_method(job_of(folder / "x264", prior=(folder / "map.bin",)), small, quiet)
    return folder / "x264"


@pytest.fixture
def copied(handed_in: Path, tmp_path: Path) -> Path:
    return shutil.copytree(handed_in, tmp_path / "x264")


def test_x264_by_a_command_scores_as_the_rival_of_the_comparison(
    small, handed_in, thumbnail, tmp_path
):
    """The same encoder by both doors: equal packets, equal errors, no difference in rate."""
    from rfedge.jobs import CellStore

    drive = read_drive(thumbnail.drive)
    rival = perform(drive.clip(), small.anchors[0], CellStore(tmp_path), timed=False)
    content = check_submission(handed_in, small, {}, tell=quiet)
    (curve,) = content["curves"]
    assert curve["psnr_db"] == pytest.approx([clip.psnr_db() for clip in rival.clips], abs=1e-9)
    assert curve["bytes_per_frame"] == [clip.bytes_per_frame() for clip in rival.clips]
    (row,) = content["rows"]
    assert row["bd_rate_percent"] == pytest.approx(0, abs=1e-9)
    assert row["ci95"] == pytest.approx((0, 0), abs=1e-9)


def test_a_result_says_what_was_checked_and_what_was_not(small, handed_in):
    content = check_submission(handed_in, small, {}, tell=quiet)
    assert any("no --decoder was named" in what for what in content["not_checked"])
    assert any("made without later frames" in what for what in content["not_checked"])
    assert content["submission"]["later_frames_withheld"] == "stated, not checked"
    assert content["submission"]["prior_bytes"] == 10
    (cost,) = content["break_even"]
    assert (cost["field_bytes"], cost["passes_to_break_even"]) == (10, None)
    result = make_result("benchmark", provenance(command="x", at="1"), content)
    console = Console(record=True, width=120)
    print_scores(console, result)
    assert "Not checked: " in console.export_text()
    table, remarks = score_parts(result)
    assert table.cells[0][:5] == ["wall", "10", "x264-lowdelay-veryfast", "32..36", "+0.0"]
    assert "* wall: the prior of 10 bytes is never paid for." in remarks


def test_pictures_may_be_handed_in_as_png(small, copied, handed_in):
    """RGB rounds once more: by less than a tenth of a decibel at these qualities."""
    for raw in copied.glob("wall/*/*.yuv"):
        picture = I420.unpacked((96, 64), raw.read_bytes())
        write_png(raw.with_suffix(".png"), rgb_from_i420(picture))
        raw.unlink()
    by_format = [check_submission(f, small, {}, tell=quiet) for f in (copied, handed_in)]
    png, raw_ = (content["curves"][0]["psnr_db"] for content in by_format)
    assert png[2:] == pytest.approx(raw_[2:], abs=0.1)


# --- poisoned submissions -----------------------------------------------------------------------


def edited(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "submission.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def first_point(content: dict[str, Any]) -> dict[str, Any]:
    point: dict[str, Any] = content["drives"][0]["points"][0]
    return point


def on_disk(name: str, change: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda folder: change(folder / "wall" / "8" / name)


def stated(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], object]:
    return partial(edited, change=change)


POISON: dict[str, tuple[Callable[[Path], object], str]] = {
    "a missing packet": (
        on_disk("0003.packet", Path.unlink),
        r"0003\.packet is missing; every frame of 0 to 4 has a packet",
    ),
    "a missing picture": (on_disk("0004.yuv", Path.unlink), r"0004\.yuv is missing"),
    "a picture of another size": (
        on_disk("0002.yuv", lambda path: path.write_bytes(b"grey")),
        r"0002\.yuv: 4 bytes for 96x64 px, expected 9216",
    ),
    "a packet of other bytes than stated": (
        on_disk("0001.packet", lambda path: path.write_bytes(b"short")),
        r"0001\.packet has 5 bytes, submission\.json states \d+",
    ),
    "bytes that are stated too low": (
        stated(lambda c: first_point(c)["frame_bytes"].__setitem__(2, 7)),
        r"0002\.packet has \d+ bytes, submission\.json states 7",
    ),
    "an empty packet": (
        on_disk("0001.packet", lambda path: path.write_bytes(b"")),
        "is empty; a frame takes at least one byte",
    ),
    "a file that is not counted": (
        on_disk("side.bin", lambda path: path.write_bytes(b"x" * 9)),
        r"side\.bin is no packet or picture .* what is sent must be counted",
    ),
    "a packet that is a link": (
        on_disk("0005.packet", lambda path: path.symlink_to("0000.packet")),
        "is a link, folder or device",
    ),
    "too few frames": (
        stated(lambda c: first_point(c)["frame_bytes"].pop()),
        r"frame_bytes has 4, wall 5 frames",
    ),
    "a frame of no bytes": (
        stated(lambda c: first_point(c)["frame_bytes"].__setitem__(2, 0)),
        r"frame_bytes\[2\] is 0, must be at least 1",
    ),
    "too few points": (
        stated(lambda c: c["drives"][0]["points"].pop()),
        r"points has 5, at least 6 are needed",
    ),
    "a point twice": (
        stated(lambda c: c["drives"][0]["points"].__setitem__(1, first_point(c))),
        "5 points, at least 6 needed",
    ),
    "a folder outside": (
        stated(lambda c: first_point(c).update(folder="../elsewhere")),
        r"folder is '\.\./elsewhere', outside the submission",
    ),
    "a folder that is not there": (
        stated(lambda c: first_point(c).update(folder="wall/99")), "99 is missing"
    ),
    "another benchmark": (
        stated(lambda c: c.update(benchmark="rfedge-bench v9")), "benchmark must be 'small'"
    ),
    "no required drive": (stated(lambda c: c.update(drives=[])), "wall is missing, which small"),
    "a drive twice": (
        stated(lambda c: c["drives"].append(c["drives"][0])),
        "names 2 drives, of which only 1 differ",
    ),
    "half a byte": (
        stated(lambda c: first_point(c)["frame_bytes"].__setitem__(2, 7.5)),
        r"frame_bytes\[2\] is 7\.5, not a whole number",
    ),
    "an unknown drive": (
        stated(lambda c: c["drives"][0].update(name="moon")),
        r"drives\[0\]\.name of 'moon' is none of wall",
    ),
    "a stated quality": (
        stated(lambda c: first_point(c).update(psnr_db=99.0)),
        r"points\[0\]\.psnr_db is none of cpu_ms, folder, frame_bytes, point",
    ),
    "a prior that is not listed": (
        stated(lambda c: c.update(prior=[])), r"map\.bin is not in submission\.json"
    ),
    "a prior that is not there": (
        lambda folder: (folder / "prior" / "map.bin").unlink(), r"map\.bin is missing"
    ),
    "a prior elsewhere": (
        stated(lambda c: c.update(prior=["../field.rff"])), r"is not prior/FILE"
    ),
    "no JSON": (
        lambda folder: (folder / "submission.json").write_text("{"), "not a readable submission"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", POISON)
def test_a_poisoned_submission_is_refused_with_its_fault(name, small, copied):
    poison, message = POISON[name]
    poison(copied)
    with pytest.raises(RfedgeError, match=message):
        check_submission(copied, small, {}, tell=quiet)


def test_a_window_that_is_not_spanned_is_refused(small, handed_in):
    scoring = replace(small.scoring, windows_db=((2.0, 36.0),))
    with pytest.raises(InvalidInput, match=r"2\.\.36 dB is not within .* more operating points"):
        check_submission(handed_in, replace(small, scoring=scoring), {}, tell=quiet)


def test_better_pictures_that_are_stated_are_not_believed(small, copied):
    """A picture of noise costs its decibels whatever else is handed in."""
    before = check_submission(copied, small, {}, tell=quiet)["curves"][0]["psnr_db"][0]
    noise = np.random.default_rng(1).integers(0, 255, 9216, np.uint8)
    (copied / "wall" / "8" / "0002.yuv").write_bytes(noise.tobytes())
    clip = read_submission(copied, small).drives["wall"][0].pictures((96, 64))[2]
    assert clip.packed() == noise.tobytes()
    changed = replace(small, scoring=replace(small.scoring, windows_db=((31.0, 32.0),)))
    after = check_submission(copied, changed, {}, tell=quiet)["curves"][0]["psnr_db"][0]
    assert after < before - 10


def test_a_drive_of_other_frames_is_refused(small, thumbnail):
    empty = Path(thumbnail.empty.partition("=")[2])
    with pytest.raises(InvalidInput, match=r"have the digest .*, those of wall have .*; get it"):
        small.drive("wall").read(empty)
    with pytest.raises(InvalidInput, match=r"5 frames of 96x64 px, wall has 9 of 96x64"):
        replace(small.drive("wall"), frames=9).read()


# --- commands -----------------------------------------------------------------------------------

AHEAD = """
import sys
from pathlib import Path
frames, out = map(Path, sys.argv[1:3])
files = sorted(frames.glob("*.yuv"))
for k, file in enumerate(files):
    later = files[min(k + LOOK, len(files) - 1)].read_bytes()
    (out / f"{k:04d}.packet").write_bytes(file.read_bytes()[:9] + later[:9])
    (out / f"{k:04d}.yuv").write_bytes(file.read_bytes())
"""


def program(folder: Path, text: str) -> str:
    (folder / "coder.py").write_text(text)
    return f"{sys.executable} {folder / 'coder.py'} {{frames}} {{out}} {{point}}"


def test_a_coder_that_looks_ahead_is_found_out(small, tmp_path):
    method = program(tmp_path, AHEAD.replace("LOOK", "1"))
    with pytest.raises(CodecError, match=r"frame 1 is another one when frames from 2 on are with"):
        run_method(job_of(tmp_path / "ahead", method), small, quiet)
    assert not (tmp_path / "ahead").exists()
    run_method(
        job_of(tmp_path / "fair", program(tmp_path, AHEAD.replace("LOOK", "0"))), small, quiet
    )
    assert read_submission(tmp_path / "fair", small).withheld


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import sys; sys.exit('out of memory')", "ended with 1: out of memory"),
        ("pass", r"0000\.packet is missing"),
        ("while True: pass", r"not done after 0\.5 s; raise --timeout-s"),
    ],
)
def test_a_command_that_fails_is_reported(text, message, small, tmp_path):
    job = job_of(tmp_path / "out", program(tmp_path, text))
    with pytest.raises(RfedgeError, match=message):
        run_method(replace(job, timeout_s=0.5 if "True" in text else 60), small, quiet)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mine {frames} {out}", r"lacks \{point\}; placeholders are"),
        ("mine {frames} {point} {out} {crf}", r"has \{crf\}; placeholders are"),
    ],
)
def test_a_command_without_its_placeholders_is_refused(text, message):
    with pytest.raises(InvalidInput, match=message):
        Command(text)


def test_a_program_that_is_not_there_is_named():
    with pytest.raises(InvalidInput, match="'no-such-codec' cannot be started"):
        Command("no-such-codec {frames} {point} {out}").run(frames="a", point="1", out="b")


def test_too_few_points_are_refused_before_anything_runs(small, tmp_path):
    job = job_of(tmp_path / "out", "no-such-codec {frames} {point} {out}", points=(1.0, 2.0))
    with pytest.raises(InvalidInput, match="points: 2 given, at least 6 are needed"):
        run_method(job, small, quiet)


# --- decoders -----------------------------------------------------------------------------------

DECODER = """
import sys
from pathlib import Path
import av
packets, out = map(Path, sys.argv[1:3])
decoder = av.CodecContext.create("h264", "r")
decoder.thread_count = 1
files = sorted(packets.glob("*.packet"))
shown = [f for file in files for f in decoder.decode(av.Packet(file.read_bytes()))]
for k, frame in enumerate([*shown, *decoder.decode(None)]):
    frame.to_ndarray(format="yuv420p").tofile(out / f"{k:04d}.yuv")
"""


def decoder_of(folder: Path, text: str = DECODER) -> Any:
    (folder / "decoder.py").write_text(text)
    command = f"{sys.executable} {folder / 'decoder.py'} {{packets}} {{out}}"
    return partial(check_decoder, Command(command, DECODER_NEEDS))


def test_a_decoder_makes_the_pictures_from_the_packets(small, handed_in, tmp_path):
    content = check_submission(handed_in, small, {}, tell=quiet, check_decoder=decoder_of(tmp_path))
    assert any("from the packets alone" in what for what in content["checked"])
    assert not any("--decoder" in what for what in content["not_checked"])


def test_pictures_that_the_packets_do_not_show_are_found_out(small, copied, thumbnail, tmp_path):
    camera = read_drive(thumbnail.drive).frames[3]
    (copied / "wall" / "20" / "0003.yuv").write_bytes(camera.packed())
    with pytest.raises(CodecError, match=r"wall/20 the decoder makes another picture of frame 3"):
        check_submission(copied, small, {}, tell=quiet, check_decoder=decoder_of(tmp_path))


def test_a_frame_that_needs_a_later_packet_is_found_out(small, handed_in, tmp_path):
    late = DECODER.replace("enumerate([*shown, *decoder.decode(None)])", "enumerate(shown[:-1])")
    with pytest.raises(CodecError, match="made no picture of frame"):
        check_submission(handed_in, small, {}, tell=quiet, check_decoder=decoder_of(tmp_path, late))


# --- our own coder, and the command line --------------------------------------------------------


def test_our_own_coder_goes_through_the_same_door(small, thumbnail, tmp_path):
    ours = f"{sys.executable} {EXAMPLES / 'bench_rfedge.py'}"
    method = f"{ours} encode {{prior}}/wall.rff {{frames}} {{out}} {{point}}"
    decode = f"{ours} decode {{prior}}/wall.rff {{packets}} {{out}}"
    few = replace(small, scoring=replace(small.scoring, least_points=1))
    job = job_of(tmp_path / "ours", method, points=(30.0,), prior=(thumbnail.field,))
    run_method(job, few, quiet)
    (point,) = read_submission(tmp_path / "ours", few).drives["wall"]
    drive = read_drive(thumbnail.drive)
    check_decoder(Command(decode, DECODER_NEEDS), point, drive, tmp_path / "ours" / "prior")
    x264 = small.anchor_clips["wall", small.anchors[0].name]
    assert sum(point.frame_bytes) < max(int(clip.frame_bytes.sum()) for clip in x264)


def test_the_command_line_names_drives_by_example():
    verb = parse(["benchmark", "check", "out/mine", "--drive", "kitti-loop"])
    with pytest.raises(InvalidInput, match="'kitti-loop' is not NAME=DATASET"):
        verb.run()
