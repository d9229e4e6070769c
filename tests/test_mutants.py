"""A change of one line that makes a figure wrong fails the test named beside it.

The first eight are those of an audit that no fast test noticed then.
"""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FAILED = 1
"""Pytest's status when tests ran, and some failed."""


@dataclass(frozen=True)
class Mutant:
    """``before`` becomes ``after`` in ``file``; ``test`` is to fail then."""

    name: str
    file: str
    before: str
    after: str
    test: str


RIVALS = "rfedge/evaluate/rivals.py"
BENCHMARK = "lab/benchmark"
BENCHMARK_TESTS = "tests/lab/test_benchmark.py"
MUTANTS = (
    Mutant(
        "x264 is crippled",
        RIVALS,
        '{"preset": preset, "tune": "zerolatency", "x264-params": _joined(options)}',
        '{"preset": preset, "tune": "zerolatency", "x264-params": _joined({**options, '
        '"cabac": "0", "ref": "1", "subme": "0"})}',
        "tests/evaluate/test_rivals.py::test_a_rival_runs_with_the_options_it_is_named_for",
    ),
    Mutant(
        "x264 runs at another preset than it is named for",
        RIVALS,
        '{"preset": preset, "tune": "zerolatency", "x264-params": _joined(options)}',
        '{"preset": "superfast", "tune": "zerolatency", "x264-params": _joined(options)}',
        "tests/evaluate/test_rivals.py::test_a_rival_runs_with_the_options_it_is_named_for",
    ),
    Mutant(
        "the steady state has the first frame",
        "rfedge/evaluate/clips.py",
        "STEADY = slice(1, None)",
        "STEADY = slice(0, None)",
        "tests/evaluate/test_compare.py"
        "::test_what_the_first_frame_takes_does_not_count_in_the_steady_state",
    ),
    Mutant(
        "the interval draws the first frame",
        "rfedge/evaluate/rate_curve.py",
        "starts = rng.integers(first, count - length + 1",
        "starts = rng.integers(0, count - length + 1",
        "tests/evaluate/test_rate_curve.py::test_the_first_frame_is_never_drawn",
    ),
    Mutant(
        "our processor time is that of rendering",
        "rfedge/evaluate/field_coder.py",
        "both_ms = cpu_ms + render_cpu_ms, receiver",
        "both_ms = render_cpu_ms, receiver",
        "tests/evaluate/test_field_coder.py"
        "::test_processor_time_is_coding_and_the_frames_share_of_rendering",
    ),
    Mutant(
        "processor time is that of the most disturbed run",
        "rfedge/evaluate/performance.py",
        "float(np.median([run.cpu_ms for run in runs]))",
        "float(np.max([run.cpu_ms for run in runs]))",
        "tests/evaluate/test_performance.py"
        "::test_processor_time_in_turns_is_that_of_the_median_round",
    ),
    Mutant(
        "our frames always arrive",
        "lab/robust/lossy_link.py",
        "yield arrival if delivered or index == 0 else None",
        "yield arrival",
        "tests/lab/test_loss.py::test_no_frame_is_new_that_did_not_arrive",
    ),
    Mutant(
        "no second picture of the field is chosen",
        "rfcore/codec/sender/reference_choice.py",
        "helpful = [r for r in others if",
        "helpful = [r for r in others[:0] if",
        "tests/codec/test_reference_choice.py"
        "::test_a_second_picture_of_the_field_is_taken_where_it_saves",
    ),
    Mutant(
        "x264 with our tools lacks one",
        RIVALS,
        '"trellis": "2", "aq-mode": "0"',
        '"trellis": "0", "aq-mode": "0"',
        "tests/evaluate/test_rivals.py::test_a_rival_runs_with_the_options_it_is_named_for",
    ),
    Mutant(
        "x264 is not tuned for the metric",
        RIVALS,
        'return replace(plain, options={**plain.options, "tune": f"zerolatency,{metric}"})',
        "return plain",
        "tests/evaluate/test_rivals.py::test_tuning_for_psnr_changes_the_stream",
    ),
    Mutant(
        "our frames cost their slices alone",
        "rfedge/evaluate/field_coder.py",
        "sizes = [len(message) for message in messages]",
        "sizes = [len(frame.encoded.packet.payload) for frame in coded]",
        "tests/evaluate/test_field_coder.py::test_a_frame_costs_its_slice_and_its_header",
    ),
    Mutant(
        "quality is the mean of PSNRs",
        "rfedge/evaluate/rate_curve.py",
        "        psnr_db = 10 * np.log10(PEAK * PEAK / mse)",
        "        psnr_db = np.array([(10 * np.log10(PEAK * PEAK / clip.luma_mse[frames])).mean() "
        "for clip in clips])",
        "tests/evaluate/test_rate_curve.py"
        "::test_quality_is_the_psnr_of_the_mean_error_not_the_mean_of_psnrs",
    ),
    Mutant(
        "the benchmark counts bytes as they are stated",
        f"{BENCHMARK}/submission.py",
        "        if found != stated:",
        "        if False:",
        f"{BENCHMARK_TESTS}::test_a_poisoned_submission_is_refused_with_its_fault",
    ),
    Mutant(
        "the benchmark takes packets that are made of later frames",
        f"{BENCHMARK}/method.py",
        "        if one != other:",
        "        if False:",
        f"{BENCHMARK_TESTS}::test_a_coder_that_looks_ahead_is_found_out",
    ),
    Mutant(
        "the benchmark scores the first frame",
        f"{BENCHMARK}/definition.py",
        "return slice(self.first_scored_frame, None)",
        "return slice(0, None)",
        f"{BENCHMARK_TESTS}::test_v1_scores_as_it_did_when_it_was_frozen",
    ),
    Mutant(
        "the benchmark takes any frames for a drive",
        f"{BENCHMARK}/definition.py",
        "        if drive.digest != self.sha256:",
        "        if False:",
        f"{BENCHMARK_TESTS}::test_a_drive_of_other_frames_is_refused",
    ),
)


def outcome(test: str, mutant: Mutant | None) -> tuple[int, str]:
    """Run a test by itself; return pytest's status, and what it printed."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", test]
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    if mutant is not None:
        command += ["-p", "mutant"]
        environment["MUTANT"] = json.dumps([mutant.file, mutant.before, mutant.after])
        environment["PYTHONPATH"] = str(ROOT / "tests")
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_a_change_that_makes_figures_wrong_is_noticed(mutant):
    status, said = outcome(mutant.test, mutant)
    assert status == FAILED, said
    assert outcome(mutant.test, None)[0] == 0
