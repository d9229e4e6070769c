"""The summary and the page of losses take whatever comparisons hold, and say losses as losses."""

from dataclasses import replace

import pytest

from lab.pages.losses import losses_parts
from lab.pages.savings import FIRST, HIGH, savings_of, signed_span, span
from lab.pages.summary import comparisons, finding, summary_parts, weakest
from rfcore.errors import InvalidInput
from rfedge.evaluate.compare.rows import BEST_OF_ANY_CPU, HEADLINE_ANCHOR, CompareRow
from rfedge.report.tables import Table
from rfedge.results import as_json

FIELD, OTHER = "0123456789ab", "ba9876543210"
ROW = CompareRow(
    scene="sample-empty",
    hz=10.0,
    method=f"rfedge-default-{FIELD}",
    rival=HEADLINE_ANCHOR,
    rival_setting=HEADLINE_ANCHOR,
    window_db=FIRST,
    bd_rate_percent=-80.0,
    ci95=(-85.0, -75.0),
    points=8,
    saving_percent_at_db={},
    first_frame_bytes=1,
    rival_first_frame_bytes=1,
    ssim=0.9,
    rival_ssim=0.9,
    psnr_deviation_db=0.1,
    rival_psnr_deviation_db=0.1,
    cpu_ms=1.0,
    rival_cpu_ms=1.0,
    both_ends_ms=(30.0, 29.0, 31.0),
    rival_both_ends_ms=(10.0, 9.0, 11.0),
    field_psnr_db=None,
)


def drive(scene: str, anchor: float, best: float, **changes) -> list[CompareRow]:
    """Return a drive's rows against x264 with our tools and the strongest rival."""
    one = replace(ROW, scene=scene, bd_rate_percent=anchor, **changes)
    strongest = replace(one, rival=BEST_OF_ANY_CPU, rival_setting="av1", bd_rate_percent=best)
    return [one, strongest]


def result(*drives: list[CompareRow]):
    return {"rows": as_json([row for rows in drives for row in rows])}


COMPARE = result(drive("sample-empty", -80.0, -70.0), drive("kitti-loop", -60.0, -50.0))
HARDER = result(drive("sample-people", -40.0, -30.0), drive("sample-rain", 20.0, 150.0))
BOTH = [("compare", COMPARE), ("compare-harder", HARDER)]


def text_of(parts) -> str:
    return "\n".join(part.markdown() if isinstance(part, Table) else part for part in parts)


def test_of_several_fields_the_first_counts_and_windows_stay_apart():
    first = drive("sample-empty", -80.0, -70.0)
    high = drive("sample-empty", -50.0, -40.0, window_db=HIGH)
    other = drive("sample-empty", -20.0, -10.0, method=f"rfedge-default-{OTHER}")
    (found,) = savings_of(result(first, high, other))
    assert (found.anchor.bd_rate_percent, found.best.bd_rate_percent) == (-80.0, -70.0)
    assert found.against(HEADLINE_ANCHOR, HIGH).bd_rate_percent == -50.0
    assert found.time_ratio == pytest.approx(3.0)


def test_a_drive_without_one_of_the_rivals_is_left_out():
    assert savings_of(result(drive("sample-empty", -80.0, -70.0)[:1])) == []


def test_the_finding_spans_the_drives_and_names_the_worst():
    said = finding(comparisons(BOTH))
    assert "60 to 80 % fewer bits" in said
    assert "50 to 70 % fewer" in said
    assert "sample-rain, 10 Hz, 150 % more" in said
    dry = [BOTH[0], ("compare-harder", result(drive("sample-people", -40.0, -30.0)))]
    assert "sample-people, 10 Hz, 30 % fewer" in finding(comparisons(dry))


def test_the_weakest_comes_first():
    names = [each.scene for each in weakest(comparisons(BOTH))]
    assert names == ["sample-rain", "sample-people"]


def test_sizes_noise_rain_and_libaom_are_shown_where_they_are_and_only_there():
    bare = text_of(losses_parts({"compare": BOTH}))
    assert "## Rain" in bare
    assert "150 %" in bare
    assert "## Noise" not in bare
    assert "libaom" not in bare
    assert "1280x720" not in text_of(summary_parts(comparisons(BOTH)))
    noisy = drive("sample-empty noise 3", -10.0, 5.0)
    libaom = replace(ROW, scene="sample-empty-1280x720", rival="libaom-good-3", bd_rate_percent=7.0)
    sized = [*drive("sample-empty-1280x720", -30.0, 7.0), libaom]
    more = [
        ("compare", COMPARE),
        ("compare-harder", result(noisy)),
        ("compare-size", result(sized)),
    ]
    shown = text_of(losses_parts({"compare": more}))
    assert "## Rain" not in shown
    assert "| 3 | -10 % | +5 % (av1) |" in shown
    assert "+7 %" in shown
    assert "sample-empty-1280x720" in text_of(summary_parts(comparisons(more)))


def test_a_missing_comparison_is_named():
    with pytest.raises(InvalidInput, match=r"compare-harder\.json is missing"):
        comparisons(BOTH[:1])


def test_spans_say_both_ends_once_and_no_zero_below_zero():
    assert span([55.4, 80.6, 60.0]) == "55 to 81 %"
    assert span([55.4, 55.3]) == "55 %"
    assert signed_span([-0.2, 3.0]) == "+0 to +3 %"
