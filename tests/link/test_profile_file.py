"""A profile says what it means: stages it names are loaded, no others, and no key is ignored."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rfcore.errors import InvalidData, InvalidInput
from rfcore.link.plan import LinkPlan, read_link

SAMPLES = Path(__file__).parents[2] / "samples" / "links"

Read = Callable[..., LinkPlan]


def test_a_constant_rate_is_what_it_says(read: Read) -> None:
    plan = read("rate_mbps = 4.5\ndelay_ms = 20\nqueue_kib = 2", "rate_mbps = 10", "seed = 3")
    assert plan.uplink.profile.rate_bps == 4.5e6
    assert plan.uplink.profile.delay_s == 0.02
    assert plan.uplink.profile.queue_limit_bytes == 2048
    assert plan.downlink.profile.delay_s == 0.0
    assert plan.connection_lives_s() is None
    assert plan.uplink.impairments == plan.downlink.impairments == ()


@pytest.mark.parametrize("path", sorted(SAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_sample_profile_is_read(path: Path) -> None:
    assert read_link(path).description


def test_the_sample_traces_are_what_their_generator_makes(tmp_path: Path) -> None:
    subprocess.run([sys.executable, SAMPLES / "generate.py", tmp_path], check=True)
    for name in ("drive.up", "drive.delay.txt"):
        assert (tmp_path / name).read_bytes() == (SAMPLES / name).read_bytes(), name


@pytest.mark.parametrize(
    ("uplink", "end", "problem"),
    [
        ("", "", "uplink.rate_mbps: is missing"),
        ("rate_mbps = 0", "", "uplink.rate_mbps: is 0, outside 1e-06..1e.06"),
        ("rate_mbps = nan", "", "uplink.rate_mbps: is nan, outside 1e-06"),
        ("rate_mbps = inf", "", "uplink.rate_mbps: is inf, outside"),
        ("rate_mbps = '4'", "", "uplink.rate_mbps: is '4', not a number"),
        ("rate_mbps = true", "", "uplink.rate_mbps: is True, not a number"),
        ("rate_mbps = 4\nrate = 5", "", "uplink.rate: is none of delay_ms"),
        ("rate_mbps = 4\ndelay_ms = 90000", "", "uplink.delay_ms: is 90000, outside 0..60000"),
        ("rate_mbps = 4\noutage = 3", "", "uplink.outage: is 3, not a table"),
        ("rate_mbps = 4\n[uplink.trace]\nfile = 'x'", "", "is given beside a trace"),
        ("[uplink.trace]\nfil = 'x'", "", "uplink.trace.file: is missing"),
        (
            "rate_mbps = 4\n[uplink.jitter]\nspread_ms = -1",
            "",
            "uplink.jitter.spread_ms: is -1, outside 0..5000",
        ),
        (
            "rate_mbps = 4\n[uplink.jitter]\nspread_ms = 1\ndistribution = 'normal'",
            "",
            "uplink.jitter.distribution: is 'normal', none of uniform, exponential",
        ),
        (
            "rate_mbps = 4\n[uplink.outage]\nat_s = [[1]]",
            "",
            r"outage.at_s\[0\]: is \[1\], not \[from_s",
        ),
        ("rate_mbps = 4\n[uplink.outage]\nmean_up_s = 1", "", "outage.mean_down_s: is missing"),
        (
            "rate_mbps = 4",
            "[connection_loss]\nmean_life_s = 0",
            "connection_loss.mean_life_s: is 0, outside",
        ),
        ("rate_mbps = 4", "[uplinks]\n", "uplinks: is none of connection_loss"),
    ],
)
def test_a_wrong_value_is_named_with_its_limit(
    read: Read, uplink: str, end: str, problem: str
) -> None:
    with pytest.raises(InvalidInput, match=problem) as caught:
        read(uplink, end=end)
    assert "link.toml" in str(caught.value)


def test_a_file_that_is_no_toml_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.toml").write_text("rate = = 3")
    with pytest.raises(InvalidData, match=r"x\.toml: not a link profile"):
        read_link(tmp_path / "x.toml")
