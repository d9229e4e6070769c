"""The finding of each page of results in one sentence, made from the result files of its kind."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import median
from typing import Any

from lab.bench import flattened
from lab.pages.losses import fetched_s
from lab.pages.savings import signed_span, span
from lab.pages.sizing import BAR_DB, told_cameras
from lab.pages.summary import comparisons
from lab.pages.summary import finding as compare_finding
from lab.paper.report import paper_rows, savings_by_frame
from lab.webrtc.report import finding as webrtc_finding
from rfedge.demo.report import figures_of
from rfedge.results import Result

Named = Sequence[tuple[str, Result]]
"""The results of one kind, each with its file's name."""
Row = Mapping[str, Any]
PUBLISHED_PERCENT = {
    ("3dgs", "empty"): "45 to 80",
    ("3dgs", "parked"): "30 to 75",
    ("ingp", "empty"): "30 to 68",
    ("ingp", "parked"): "28 to 68",
}
"""Savings that arXiv 2402.14642 reports, by field and scene."""


def _all(named: Named, key: str = "rows") -> list[Row]:
    return [row for _, result in named for row in result.get(key, ())]


def _held(rows: Sequence[Row], what: str, key: str = "held") -> str:
    return f"{sum(bool(row[key]) for row in rows)} of {len(rows)} {what} hold."


def _live_truth(named: Named) -> str:
    rows = [row for row in _all(named) if "pictures" in row]
    before = [row["before"] for row in rows if "before" in row]
    wrong = [sum(row.get("wrong_pictures") or 0 for row in of) for of in (rows, before)]
    then = f", where the revision before gave {wrong[1]}" if before else ""
    return f"{wrong[0]} wrong pictures are handed on in {len(rows)} cases{then}."


def _webrtc(named: Named) -> str:
    return webrtc_finding(named[0][1])


def _compare(named: Named) -> str:
    return compare_finding(comparisons(named))


def _never_worse(named: Named) -> str:
    rows = [row for row in _all(named) if row["control"] != "right"]
    shares = signed_span(row["excess_percent"] for row in rows)
    held = sum(row["holds"] for row in rows)
    return (
        f"With a wrong field or a black render a frame's slice takes {shares} of bytes against "
        f"x264's; {held} of {len(rows)} cases are within the 2 % allowed."
    )


def _lossy_link(named: Named) -> str:
    rows = _all(named)
    worst = max(row["loss_percent"] for row in rows)
    fast = max(row["rate_mbps"] for row in rows)

    def age_ms(loss_percent: float) -> float:
        of = [r for r in rows if (r["loss_percent"], r["rate_mbps"]) == (loss_percent, fast)]
        return float(median(row["age_p99_ms"] for row in of))

    return (
        f"On a link of {fast:g} Mbit/s, {worst:g} % loss raises the 99th percentile of a picture's "
        f"age from {age_ms(0):.0f} to {age_ms(worst):.0f} ms."
    )


def _ladder(named: Named) -> str:
    rows = [row for row in _all(named) if row["on_front"]]
    *_, exact = by_time = sorted(rows, key=lambda row: float(row["sender_ms"]))
    quick = by_time[0]
    return (
        f"A sender can go from {exact['sender_ms']:.0f} to {quick['sender_ms']:.0f} ms a frame for "
        f"{quick['rate_percent'] - exact['rate_percent']:.0f} points more bits at equal quality."
    )


def _paper(named: Named) -> str:
    told = []
    for _, result in named:
        rows = paper_rows(result)
        for (field, scene), published in PUBLISHED_PERCENT.items():
            if any((row.field, row.scene) == (field, scene) for row in rows):
                sizes = savings_by_frame(rows, field, scene).values()
                values = [float(value) for of in sizes for value in (of.min(), of.max())]
                told.append(f"{field}, {scene}: {span(values)} (published {published})")
    return (
        "By the published metric a frame saves, over all sizes, in the mean of presets and CRFs: "
        f"{'; '.join(told)}."
    )


def _benchmark(named: Named) -> str:
    rows = [r for r in _all(named) if r["rival"] == "x264-our-tools-medium"]
    first = [row for row in rows if row["window_db"] == rows[0]["window_db"]]
    return f"{_by(first, 'scene', 'bd_rate_percent')} of bits against x264 with our tools."


def _by(rows: Iterable[Row], name: str, value: str) -> str:
    return ", ".join(f"{row[name]} {row[value]:+.0f} %" for row in rows)


def _classes(named: Named) -> str:
    quality: dict[tuple[str, str], dict[str, float]] = {}
    for row in _all(named):
        quality.setdefault((row["equal"], row["class"]), {})[row["method"]] = row["psnr_db"]

    def gain(equal: str, of_class: str) -> float:
        of = quality[(equal, of_class)]
        return of["rfedge"] - of["x264-our-tools-medium"]

    return (
        f"At equal bits vehicles are {gain('bits', 'vehicle'):+.1f} dB and people "
        f"{gain('bits', 'person'):+.1f} dB against x264 with our tools; at equal mean quality "
        f"{gain('quality', 'vehicle'):+.1f} and {gain('quality', 'person'):+.1f} dB."
    )


def _detect(named: Named) -> str:
    rows = [
        row
        for row in _all(named, "bd_rates")
        if row["rival"] == "x264-our-tools-medium" and row.get("bd_rate_percent") is not None
    ]
    told = _by(rows, "method", "bd_rate_percent")
    return f"At equal average precision, bits against x264 with our tools: {told}."


def _adapt(named: Named) -> str:
    changes: dict[str, dict[str, float]] = {}
    for row in _all(named):
        if row.get("kbit_33db") is not None and row.get("x264_kbit_33db"):
            change = 100 * (row["kbit_33db"] / row["x264_kbit_33db"] - 1)
            changes.setdefault(row["case"], {})[row["variant"]] = change
    both = [of for of in changes.values() if {"off", "auto"} <= set(of)]
    return (
        f"In {len(both)} cases of another light bits against x264 are "
        f"{median(of['off'] for of in both):+.0f} % without adapting and "
        f"{median(of['auto'] for of in both):+.0f} % with it (medians)."
    )


def _head(named: Named) -> str:
    rows = _all(named)
    before = [row["before"][0] for row in rows if row.get("before")]
    return (
        f"A frame's head takes {span((row['head'][0] for row in rows), ' bytes')} (medians)"
        f"{f', {span(before)[:-2]} at an earlier revision' if before else ''}."
    )


def _latency(named: Named) -> str:
    told = []
    for row in _all(named, "needed"):
        mbps = row["uplink_bps_p99_within"]["10"] / 1e6
        told.append(((row["scene"], row["hz"]), row["method"], mbps))
    drives = dict.fromkeys(drive for drive, _, _ in told)
    texts = []
    for scene, hz in drives:
        of = [f"{mbps:.1f}" for drive, _, mbps in told if drive == (scene, hz)]
        texts.append(f"{scene} at {hz:g} Hz {' / '.join(of)}")
    return (
        "Mbit/s of uplink that send 99 % of frames within 10 ms, ours / x264's: "
        f"{', '.join(texts)}."
    )


def _robust(named: Named) -> str:
    rows = _all(named, "disturbances")
    raw = [r for r in rows if r["condition"] == "pose noise"]
    refined = [r for r in rows if r["condition"] == "refined pose noise"]
    worst = max(raw, key=lambda row: row["more_percent"])
    text = f"A pose that is off by {worst['level']} costs {worst['more_percent']:+.0f} % of bits"
    if refined:
        costs = signed_span(row["more_percent"] for row in refined)
        text += f", and {costs} once it is found in the field"
    return f"{text}."


def _tcp(named: Named) -> str:
    passed: dict[tuple[float, float], dict[str, float]] = {}
    for row in _all(named):
        of = passed.setdefault((row["rate_mbps"], row["loss_percent"]), {})
        of[row["sender"]] = row["bulk_mbps"]
    off = [100 * (of["model"] / of["kernel"] - 1) for of in passed.values() if len(of) == 2]
    return f"The model passes {signed_span(off)} of throughput against the kernel's TCP."


def _localise(named: Named) -> str:
    rows = [row for row in _all(named) if row.get("localised_percent") is not None]
    return (
        f"Of tries from wrong poses {span(row['localised_percent'] for row in rows)} end at the "
        f"right one, {span((1000 * row['median_m'] for row in rows), ' mm')} off (medians)."
    )


def _sizing(_: Named) -> str:
    told = [
        f"{camera.ours_mbps:.2f} against {camera.x264_mbps:.2f} at {camera.name(', ')}"
        for camera in told_cameras()
    ]
    return f"Mbit/s of a camera with rfedge and with x264, {BAR_DB:g} dB: {'; '.join(told)}."


def _loadtest(named: Named) -> str:
    held: dict[tuple[str, str, float], int] = {}
    for name, result in named:
        for row in result["rows"]:
            if row["held"]:
                key = name, row["mode"], row["hz"]
                held[key] = max(held.get(key, 0), row["vehicles"])
    told = [f"{count} ({name}, mode {mode}, {hz:g} Hz)" for (name, mode, hz), count in held.items()]
    return f"The most vehicles held within 100 ms: {', '.join(told)}."


def _load_ratio(named: Named) -> str:
    before, now = _all(named)
    return (
        f"The server held {median(now['vehicles']):g} vehicles now and "
        f"{median(before['vehicles']):g} before (medians)."
    )


def _rig(named: Named) -> str:
    rows = [row for row in _all(named, "sessions") if row["case"] == "one CRF"]
    one, each = (next(row for row in rows if row["sessions"] == s) for s in ("one", "one each"))
    saved = 100 * (1 - one["link_bytes"] / each["link_bytes"])
    return (
        f"One session for {one['cameras']} cameras saves {saved:.1f} % of the link's bytes, and "
        f"takes {one['agent_mb']:.0f} MB of memory in place of {each['agent_mb']:.0f}."
    )


def _live(named: Named) -> str:
    rows = _all(named, "ages")
    counts = [row["cameras"] for row in rows]
    return (
        f"A browser shows a picture of {min(counts)} to {max(counts)} live cameras when it is "
        f"{span((row['median_ms'] for row in rows if row['median_ms'] is not None), ' ms')} old "
        "(medians)."
    )


def _cold_start(named: Named) -> str:
    told = [f"{median(seconds):.0f} s on {link}" for link, seconds in fetched_s(named).items()]
    return f"The whole field is there after {', '.join(told)}, while pictures are sent."


def _demo(named: Named) -> str:
    told = [
        f"{label} {drive.saving_vs_x264_percent:.0f} %"
        for _, result in named
        for label, drive in figures_of(result).items()
    ]
    return f"Saved against low-delay x264 at equal quality (RGB PSNR): {', '.join(told)}."


def _bench(named: Named) -> str:
    told = []
    for name, result in named:
        rows = [flattened(row) for row in result["rows"]]
        times = [
            (key, value) for key, value in rows[0].items() if key.endswith(("_ms", "_ms total"))
        ]
        if times:
            first = rows[0]
            size = f"{first['width']}x{first['height']}, " if "width" in first else ""
            label, value = times[0]
            told.append(f"{name} {value:.0f} ms ({size}{label})")
    return f"The first row of each: {'; '.join(told)}."


def _training(named: Named) -> str:
    best = max((result for _, result in named), key=lambda result: result["held_out"]["psnr_db"])
    return (
        f"{len(named)} runs; the best reaches {best['held_out']['psnr_db']:.1f} dB on pictures it "
        f"was not trained on, after {best['seconds'] / 60:.0f} minutes."
    )


def _seams(named: Named) -> str:
    rows = _all(named)
    told = [f"{row['frames_are']} {row['more_percent']:+.0f} %" for row in rows]
    return f"Bits of frames when a street's field is cut into tiles: {', '.join(told)}."


def _slice_coder(named: Named) -> str:
    efforts: dict[tuple[str, str], list[float]] = {}
    for row in _all(named):
        efforts.setdefault((row["effort"], row["rival"]), []).append(row["bd_rate_percent"])
    told = [f"{ours}/{rival} {signed_span(of)}" for (ours, rival), of in efforts.items()]
    return (
        "Bits of our slices against x264's of the same references, by effort/preset: "
        f"{', '.join(told)}."
    )


def _tail(named: Named) -> str:
    told = [
        f"{row['method']} {row['largest_bytes'] / row['mean_bytes']:.1f} times"
        for row in _all(named)
    ]
    return f"The largest frame over the mean one: {', '.join(told)}."


def _faults(named: Named) -> str:
    return _held(_all(named), "faults", "passed")


def _attacks(named: Named) -> str:
    return _held(_all(named), "attacks")


def _stability(named: Named) -> str:
    return _held(_all(named, "cases"), "hard cases", "holds")


def _bounds(named: Named) -> str:
    return _held(_all(named), "bounds")


def _soak(named: Named) -> str:
    return _held(_all(named), "runs")


FINDINGS: Mapping[str, Callable[[Named], str]] = {
    "compare": _compare,
    "never-worse": _never_worse,
    "lossy-link": _lossy_link,
    "ladder": _ladder,
    "paper": _paper,
    "benchmark": _benchmark,
    "classes": _classes,
    "detect": _detect,
    "adapt": _adapt,
    "head": _head,
    "latency": _latency,
    "robust": _robust,
    "tcp": _tcp,
    "webrtc": _webrtc,
    "localise": _localise,
    "sizing": _sizing,
    "loadtest": _loadtest,
    "load-ratio": _load_ratio,
    "rig": _rig,
    "live": _live,
    "live-truth": _live_truth,
    "cold-start": _cold_start,
    "world": _bounds,
    "scale": _bounds,
    "faults": _faults,
    "attacks": _attacks,
    "stability": _stability,
    "soak": _soak,
    "demo": _demo,
    "bench": _bench,
    "training": _training,
    "seams": _seams,
    "slice-coder": _slice_coder,
    "tail": _tail,
}
"""Writers of a page's finding, by the kind of its result."""
