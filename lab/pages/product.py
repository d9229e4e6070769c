"""Pages of results that the product's own commands write, and of experiments that are no more."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from lab.bench import flattened
from lab.pages.ladder import ladder_parts, write_ladder_figure
from lab.pages.savings import span
from lab.pages.sizing import told_cameras
from lab.pages.summary import DRIVES, larger_sizes
from lab.report import Draw, Report, bars
from rfcore.errors import InvalidInput
from rfedge.demo.report import METRIC, SUMMARY, figures_of
from rfedge.evaluate.compare.figures import write_bd_rates, write_compare_figures
from rfedge.evaluate.compare.rows import (
    BEST_OF_ANY_CPU,
    HEADLINE_ANCHOR,
    BitShareRow,
    BreakEvenRow,
    CompareRow,
    of_first_method,
    of_first_window,
    without_field,
)
from rfedge.evaluate.lossy_link.measure import lossy_link_parts
from rfedge.evaluate.never_worse.measure import NeverWorseRow, never_worse_parts
from rfedge.report.tables import Column, Table, named_columns, text_table
from rfedge.results import Result, rows_of

# --- compare

README_LOSS = "sample-rain"
README_FIGURE = "lab/results/figures/bd_rates.svg"
SUMMARY_COLUMNS = (
    "drive",
    "against x264 medium with our tools (95 %)",
    "against the best of all rivals",
    "our coder without the field",
    "ms at both ends: ours / that x264",
    "field MB",
    "passes to break even",
    "MB saved an hour",
)


def headline(compared: Result, harder: Result, sized: Result | None = None) -> str:
    """Return the README's sentence with its loss, and a row for each of three drives.

    ``sized``: larger pictures with fields of their own. Raises ``InvalidInput`` for a comparison
    that lacks one of them.
    """
    rows, lossy = (of_first_window(rows_of(CompareRow, r["rows"])) for r in (compared, harder))
    fair = [_against(rows, scene) for scene in DRIVES]
    *synthetic, real = (-row.bd_rate_percent for row in fair)
    rain = _against(lossy, README_LOSS).bd_rate_percent
    sentence = (
        f"**{min(synthetic):.0f} to {max(synthetic):.0f} % fewer bits** than x264 with the same "
        f"tools, at equal PSNR, on synthetic streets, and **{real:.0f} %** on a real street's "
        f"second pass; in rain **{abs(rain):.0f} % {'more' if rain > 0 else 'fewer'}**."
    )
    lines = []
    for row in fair:
        best = _against(rows, row.scene, rival=BEST_OF_ANY_CPU)
        low, high = _interval(row)
        lines.append(
            (
                f"{row.scene}, {row.hz:g} Hz",
                f"{row.bd_rate_percent:+.0f} % ({low:.0f} to {high:.0f})",
                f"{best.bd_rate_percent:+.0f} % ({best.rival_setting})",
            )
        )
    heads = ("drive", "bits against x264 with our tools (95 %)", "against the best of all rivals")
    table = text_table(heads, lines).markdown()
    return (
        f"{sentence}\n{_of_own_size(sized)}{_larger()}\n\n{table}\n\n![bits saved]({README_FIGURE})"
    )


def _of_own_size(sized: Result | None) -> str:
    """Return what is saved on larger pictures, each size with the field that stands first."""
    if sized is None:
        return ""
    saved = defaultdict[str, list[float]](list)
    for drive in larger_sizes({"compare-size": sized}):
        saved[drive.scene.rpartition("-")[2]].append(-drive.anchor.bd_rate_percent)
    told = [f"{span(values)} at {size}" for size, values in saved.items()]
    return f"Larger pictures want a field trained on such: {', '.join(told)}. " if told else ""


def _larger() -> str:
    """Return what ``rfedge size`` says of larger pictures and faster cameras."""
    told = [
        f"{100 * (1 - camera.ours_mbps / camera.x264_mbps):.0f} % at {camera.name(' and ')}"
        for camera in told_cameras()
    ]
    return (
        "With the sample's, of 640x360 pictures, larger ones and faster cameras save less: "
        f"[`rfedge size`](docs/how-to/sizing.md) says {', '.join(told)}."
    )


def _interval(row: CompareRow) -> Sequence[float]:
    if row.ci95 is None:
        raise InvalidInput("result", f"{row.scene} has no interval: a quick run is not recorded")
    return row.ci95


def _against(
    rows: Iterable[CompareRow],
    scene: str,
    rival: str = HEADLINE_ANCHOR,
    method: str = "rfedge",
) -> CompareRow:
    for row in rows:
        if (row.scene, row.rival, _bare(row.method)) == (scene, rival, method):
            return row
    raise InvalidInput("rows", f"{scene} lacks {method} against {rival}")


def _bare(method: str) -> str:
    """Return a method's name without its field and its effort."""
    return without_field(method).rsplit("-", 1)[0]


def _compare_parts(result: Result) -> Iterator[Table | str]:
    yield (
        "Our bytes count the whole message of a frame, the rivals' only the slices; all code with "
        "low delay. BD-rates are over 32 to 35 dB of luma PSNR unless a table says otherwise; "
        "negative is a saving. `kitti-city` and `kitti-residential` have map and drive of one "
        "pass, which makes them upper bounds; the poses of `kitti-loop-localised` were found in "
        "the field."
    )
    rows = of_first_window(rows_of(CompareRow, result["rows"]))
    methods = {_bare(row.method) for row in rows}
    if {"rfedge", "rfedge-without-field"} <= methods and any(
        r.rival == HEADLINE_ANCHOR for r in rows
    ):
        paid = rows_of(BreakEvenRow, result.get("break_even", ()))
        drives = dict.fromkeys(row.scene for row in rows)
        lines = [_summary_line(rows, paid, scene) for scene in drives]
        yield text_table(SUMMARY_COLUMNS, lines, "Every drive")
    if rows:
        yield _rivals_table(of_first_method(rows))
    bits = of_first_method(rows_of(BitShareRow, result.get("bits", ())))
    if bits:
        yield _bits_table(bits)


def _rivals_table(rows: Sequence[CompareRow]) -> Table:
    """Return a row for each rival and a column for each drive, and field if there are several."""
    shown: dict[str, dict[tuple[str, float, str], float]] = {}
    for row in sorted(rows, key=lambda row: row.rival_setting):
        of_rival = shown.setdefault(row.rival_setting, {})
        of_rival[(row.scene, row.hz, row.method)] = row.bd_rate_percent
    drives = dict.fromkeys((row.scene, row.hz, row.method) for row in rows)
    several = len(drives) > len({drive[:2] for drive in drives})
    lines = [
        [rival, *(f"{of[drive]:+.1f}" if drive in of else "-" for drive in drives)]
        for rival, of in shown.items()
    ]
    names = [
        f"{scene}, {hz:g} Hz" + (f", field {method.rsplit('-', 1)[-1][:6]}" if several else "")
        for scene, hz, method in drives
    ]
    return text_table(("rival", *names), lines, "BD-rate in percent against each rival")


def _bits_table(rows: Sequence[BitShareRow]) -> Table:
    """Return a row for each drive and field, and a column for each kind of macroblock."""
    shown: dict[tuple[str, float, str], dict[str, str]] = {}
    for row in rows:
        share = f"{row.area_percent:.0f} / {row.slice_percent:.0f}"
        shown.setdefault((row.scene, row.hz, row.method), {})[row.shows] = share
    kinds = dict.fromkeys(row.shows for row in rows)
    lines = [
        [f"{scene}, {hz:g} Hz", *(of.get(kind, "-") for kind in kinds)]
        for (scene, hz, _), of in shown.items()
    ]
    title = "Macroblocks near 33.5 dB: share of the picture / of the bytes, %"
    return text_table(("drive", *kinds), lines, title)


def _summary_line(rows: list[CompareRow], paid: list[BreakEvenRow], scene: str) -> list[str]:
    fair = _against(rows, scene)
    best = _against(rows, scene, rival=BEST_OF_ANY_CPU)
    ablated = _against(rows, scene, method="rfedge-without-field")
    low, high = _interval(fair)
    (even,) = [row for row in paid if (row.scene, row.method) == (scene, fair.method)][:1]
    saved_mb = 3.6e-3 * even.saved_bytes_per_pass * fair.hz / even.frames_per_pass
    passes = even.passes_to_break_even
    return [
        f"{scene}, {fair.hz:g} Hz",
        f"{fair.bd_rate_percent:+.1f} % ({low:.1f}..{high:.1f})",
        f"{best.bd_rate_percent:+.1f} % ({best.rival_setting})",
        f"{ablated.bd_rate_percent:+.1f} %",
        f"{fair.both_ends_ms[0]:.0f} / {fair.rival_both_ends_ms[0]:.0f}",
        f"{even.field_bytes / 1e6:.1f}",
        "never" if passes is None else str(passes),
        f"{saved_mb:.0f}",
    ]


def _draw_compare(result: Result, folder: Path, name: str) -> list[Path]:
    if name == "compare":
        return write_compare_figures(result, folder)
    return write_bd_rates(result, folder, name.replace("compare", "bd_rates").replace("-", "_"))


# --- never worse


def _excess(result: Result) -> Iterator[tuple[str, float]]:
    for row in rows_of(NeverWorseRow, result["rows"]):
        yield f"{row.scene} {row.hz:g} Hz, {row.control}, {row.at_db:g} dB", row.excess_percent


# --- demo, benchmarks of kernels, training


def _demo_parts(result: Result) -> Iterator[Table | str]:
    drives = figures_of(result)
    settings, field = result["settings"], result["field"]
    yield (
        f"Field of {field['gaussians']:,} Gaussians, {field['held_out_psnr_db']:.2f} dB on the "
        f"held-out empty drive; CRF {settings['crf']:g}, {settings['rate_hz']:g} Hz, link "
        f"{settings['link_bps'] / 1e6:g} Mbit/s and {settings['link_delay_ms']:g} ms."
    )
    lines = [
        [f"{label} ({note})", *(show(drive) for drive in drives.values())]
        for label, note, show in SUMMARY
    ]
    lines += [
        [f"100·I/(I+P) with {label}", *(f"{show(drive):.1f} %" for drive in drives.values())]
        for label, show in METRIC
    ]
    yield text_table(("", *drives), lines, "Both drives")


def _bench_parts(result: Result) -> Iterator[Table | str]:
    rows = [flattened(row) for row in result["rows"]]
    if not rows:
        raise InvalidInput("result", "a bench has no rows")
    yield Table("", named_columns(dict.fromkeys(n for row in rows for n in row)), rows)


TRAINING = (
    Column("views", lambda run: run["views"]),
    Column("size", lambda run: (run["width"], run["height"]), "{}x{}"),
    Column("held out dB", lambda run: run["held_out"]["psnr_db"], ".2f"),
    Column("SSIM", lambda run: run["held_out"]["ssim"], ".3f"),
    Column("seconds", lambda run: run["seconds"], ".0f"),
    Column("iterations", lambda run: run["iterations"]),
    Column("primitives", lambda run: run["primitives"]),
    Column("MB", lambda run: run["bytes"] / 1e6, ".1f"),
)


def _training_parts(result: Result) -> Iterator[Table | str]:
    yield Table("", TRAINING, [result])


def _training_curve(result: Result, folder: Path, name: str) -> list[Path]:
    from matplotlib import pyplot as plt

    from rfedge.report.charts import BLUE, STYLE, write_figure

    points = result.get("curve", ())
    if not points:
        return []
    seconds, quality_db = zip(*points, strict=True)
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 2.6))
        axes.plot(seconds, quality_db, color=BLUE, marker="o", markersize=4)
        axes.set(xlabel="seconds of training", ylabel="held-out PSNR, dB")
    lines = [["seconds", "psnr_db"], *([f"{s:.1f}", f"{db:.3f}"] for s, db in points)]
    return write_figure(folder / f"train-{name}", figure, lines)


def _plain_parts(result: Result) -> Iterator[Table | str]:
    """Yield every list of rows under the names of its fields."""
    for name, rows in result.items():
        if isinstance(rows, list) and rows and isinstance(rows[0], Mapping):
            flat = [flattened(row) for row in rows]
            yield Table(name, named_columns(dict.fromkeys(n for row in flat for n in row)), flat)


def _rows_bars(label: str, text: str, value: str) -> Draw:
    """Return a function that draws a value of each of a plain result's rows, named by ``text``."""

    def values(result: Result) -> Iterator[tuple[str, float]]:
        for row in result["rows"]:
            yield text.format(**row), row[value]

    return bars(label, values)


REPORTS = (
    Report(
        "compare",
        "Against x264, x265 and SVT-AV1",
        "Bits of our coder on each drive against rivals at equal quality, and processor time of "
        "both. Other methods, windows and SSIM are in the files.",
        _compare_parts,
        _draw_compare,
    ),
    Report(
        "never-worse",
        "Never worse than x264",
        "What a frame costs against plain x264 with the right field, a wrong one and none; at most "
        "2 % more is allowed.",
        never_worse_parts,
        bars("bytes without the header above those of x264, %", _excess),
    ),
    Report(
        "lossy-link",
        "Lossy links",
        "What a thin link that loses packets does to a drive over TCP: age, frozen share, quality.",
        lossy_link_parts,
    ),
    Report(
        "ladder",
        "What accuracy costs in time",
        "Milliseconds of sender and receiver, bits and quality of every setting that a sender may "
        "choose; `cav-agent --ladder` chooses among them.",
        ladder_parts,
        write_ladder_figure,
    ),
    Report(
        "demo",
        "The demo",
        "What `make demo` measured: two drives from a vehicle to a server over a link.",
        _demo_parts,
    ),
    Report(
        "bench",
        "Kernels and codec",
        "Times of the rasterizers, the trainer and the codec, beside their references.",
        _bench_parts,
    ),
    Report(
        "training",
        "Training runs",
        "Quality on pictures that a field was not trained on, over the time of training.",
        _training_parts,
        _training_curve,
    ),
    Report(
        "seams",
        "Tiles",
        "What it costs to cut a street's field into tiles: bits near the seams and elsewhere. The "
        "experiment is no longer here.",
        _plain_parts,
        _rows_bars("kbit a frame in tiles, % more", "{frames_are}", "more_percent"),
    ),
    Report(
        "slice-coder",
        "Our slice coder",
        "How many more bytes our slices need than those of x264 that predict from the same "
        "references, and their times. The experiment is no longer here.",
        _plain_parts,
        _rows_bars(
            "BD-rate against x264, %", "{drive} {hz:g} Hz: {effort}/{rival}", "bd_rate_percent"
        ),
    ),
    Report(
        "tail",
        "The largest of many frames",
        "How the sizes of 300,000 different frames are distributed. The experiment is no longer "
        "here.",
        _plain_parts,
        _rows_bars("largest frame, bytes", "{method}", "largest_bytes"),
    ),
)
