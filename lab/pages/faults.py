"""``docs/reliability.md`` from ``lab/results/faults.json``, the scoreboard of the fault suite.

python -m lab.pages.faults lab/results/faults.json > docs/reliability.md
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

from rfcore.errors import InvalidInput
from rfedge.report.tables import table
from rfedge.results import read_result, rows_of

__all__ = ["FaultRow", "LinkCell", "faults_page"]


class LinkCell(TypedDict):
    """What came of pictures behind a link with loss, delay and a limited rate."""

    loss_percent: float
    rtt_ms: float
    rate_mbps: float
    shown_hz: float
    sent_mbps: float
    frozen_percent: float
    """Of the time: in gaps between pictures of at least max(3 d, d + 150 ms), d their mean."""
    age_p50_ms: float
    age_p99_ms: float
    psnr_db: float
    """Of the server's pictures against the camera's."""


@dataclass(frozen=True)
class FaultRow:
    """One fault. ``bound`` and ``measured`` are lists of the same length, split by ``; ``."""

    fault: str
    injected_with: str
    bound: str
    measured: str
    passed: bool
    covers: str | None = None
    """Which of ``KINDS`` it is, split by spaces."""
    test: str | None = None
    """The case of ``tests/fault`` that measured it."""
    cell: LinkCell | None = None


KINDS = {
    "F1": "server killed",
    "F2": "vehicle killed",
    "F3": "server or vehicle stopped for seconds",
    "F4": "silent partition",
    "F5": "link that flaps",
    "F6": "packet loss x RTT x rate",
    "F7": "slow reader",
    "F8": "rate collapse",
    "F9": "bit flips",
    "F10": "malformed payloads",
    "F11": "replayed, reordered packets",
    "F12": "wrong field",
    "F13": "render mismatch",
    "F14": "poses that are not numbers",
    "F15": "compressed bombs",
    "F16": "resolution bombs",
    "F17": "decoder crash or hang",
    "F18": "wrong clocks",
    "F19": "full disk",
    "F20": "damaged field file",
    "F21": "out of memory",
    "F22": "handshake and HTTP/2 floods",
    "F23": "hostile vehicle",
    "F24": "expired and revoked certificates",
    "F25": "rolling update",
    "F26": "metrics reader that is slow or dead",
    "F27": "version skew",
    "F28": "mistaken options",
    "L1": "load: transport only",
    "L2": "load: receiver without render",
    "L3": "load: full loop",
    "L4": "load: each vehicle on a link of its own",
    "L5": "connection storm",
    "L6": "load: twice what is held",
    "L7": "soak",
}
"""Kinds of fault (F) and load (L) that this project holds itself against."""

ELSEWHERE = {
    "L1": "load-transport",
    "L2": "load-receiver",
    "L3": "load-full",
    "L4": "load-links",
    "L6": "load-overload",
    "L7": "soak",
}
"""Loads are measured by these targets of make, not by the fault suite."""
SOAK = "L7"


OPENING = """# What happens when things break

Generated from `lab/results/faults.json`, of loads from `loadtest.json` and `soak.json`, by
`make figures`; do not edit.

What is promised, and no more:

* No silently wrong picture. Every frame that is shown has passed its sequence, CRC, the digest of
  the render it is predicted from, and the digest of what it decodes to; otherwise it is a Nack.
* Nothing stale. Pictures are dropped before they are coded, at most two coded frames of a camera
  are under way, and what was under way when a stream broke is never sent again.
* One vehicle harms itself only. Its packets, its decoder, its streams and its speed are limited
  by name ([limits](operations.md#limits)), and a frame it loses costs nobody else one.
* Coming back needs no operator. A vehicle connects again by itself, with a first frame that needs
  nothing from before; a decoder process is replaced by one that stands ready.
* Frames are delivered at most once, and not stored: live pictures are gone when the server is.

`make test-fault` starts real servers and vehicles as processes, does to them what the table says,
and measures. Its bounds are part of the tests. A *bystander* is a vehicle at 20 Hz on the same
server that nothing is done to; its latencies while the fault lasts are compared with those before
and after, and with those of a *control*, a vehicle on a server of its own: what both suffer is the
machine's doing. Byte-equal means that the digests of the pictures at the server are those of a
stream that begins there and has no fault. Namespaces and mounts need root; without it those cases
are skipped.

Loss is of IP packets, so that the kernels' TCP meets it as it does on a road: what is lost is sent
again and comes late, behind it everything waits, and pictures that are too old by then are dropped
before they are coded. No picture is damaged by loss; what it costs is time and, with
`--max-delay-ms`, quality, since a link that answers late is taken for a slow one. Datagrams that
would leave lost pictures behind are not used.
"""


def faults_page(path: Path) -> str:
    """Return the page; raise ``InvalidInput`` for a file of another kind."""
    result = read_result(path, "faults")
    rows = rows_of(FaultRow, result["rows"])
    passed, machine = sum(row.passed for row in rows), result["host"]
    score = (
        f"## Scoreboard\n\n{passed} of {len(rows)} hold. `{result['command']}` at "
        f"`{result['revision']}`; {machine['cpu']}, {machine['cores']} cores, {machine['isa']}.\n"
    )
    loads = {kind: _runs_held(kind, path.parent) for kind in ELSEWHERE}
    cells = [row.cell for row in rows if row.cell is not None]
    return "\n".join([OPENING, score, *_kinds(rows, loads), *_matrix(cells), *_sections(rows)])


def _runs_held(kind: str, folder: Path) -> list[bool]:
    """Return which of the runs of a load held that results in ``folder`` have, of the newest
    measurement: in ``soak.json`` or ``loadtest.json``, by the folder that its command names."""
    path = folder / ("soak.json" if kind == SOAK else "loadtest.json")
    if not path.exists():
        return []
    rows = read_result(path, path.stem)["rows"]
    if kind == SOAK:
        return [bool(row["held"]) for row in rows]
    out = f"out/loadtest/{ELSEWHERE[kind].removeprefix('load-')}"
    rows = [row for row in rows if row["command"].split()[-1] == out]
    numbered = [row for row in rows if row.get("run") is not None]
    return [bool(row["held"]) for row in numbered or rows]


def _kinds(rows: list[FaultRow], loads: Mapping[str, list[bool]]) -> Iterator[str]:
    """Yield the table of kinds, each with the rows that test it; results before it have none."""
    if not any(row.covers for row in rows):
        return
    cells = []
    for kind, what in KINDS.items():
        tested = [row for row in rows if kind in (row.covers or "").split()]
        by = ", ".join(row.fault for row in tested) or "**not tested**"
        held = [row.passed for row in tested]
        if not tested and kind in ELSEWHERE:
            by, held = f"`make {ELSEWHERE[kind]}`", loads[kind]
        told = f"{sum(held)} of {len(held)}" if held else "**not recorded**"
        cells.append((kind, what, by, told if tested or kind in ELSEWHERE else ""))
    yield table(("kind", "fault", "tested by", "hold"), cells)
    yield ""


def _matrix(cells: list[LinkCell]) -> Iterator[str]:
    """Yield the table of packet loss x RTT x rate."""
    if not cells:
        return
    yield "## Packet loss, round trip and rate\n"
    heads = ("loss", "RTT", "link", "shown", "sent", "frozen", "age, median / 99th", "quality")
    lines = [
        (
            f"{cell['loss_percent']:g} %",
            f"{cell['rtt_ms']:g} ms",
            f"{cell['rate_mbps']:g} Mbit/s",
            f"{cell['shown_hz']:.1f} Hz",
            f"{cell['sent_mbps']:.2f} Mbit/s",
            f"{cell['frozen_percent']:.0f} %",
            f"{cell['age_p50_ms']:.0f} / {cell['age_p99_ms']:.0f} ms",
            f"{cell['psnr_db']:.1f} dB",
        )
        for cell in sorted(cells, key=lambda c: (c["loss_percent"], c["rtt_ms"], c["rate_mbps"]))
    ]
    yield table(heads, lines)
    yield ""


def _sections(rows: list[FaultRow]) -> Iterator[str]:
    for row in rows:
        verdict = "holds" if row.passed else "**does not hold**"
        yield f"### {row.fault}: {verdict}\n\n{row.injected_with}\n"
        bounds, figures = row.bound.split("; "), row.measured.split("; ")
        if len(bounds) != len(figures):
            counts = f"{len(bounds)} bounds and {len(figures)} figures"
            raise InvalidInput("results", f"{row.fault}: {counts}; each bound needs its figure")
        yield table(("what", "measured"), zip(bounds, figures, strict=True))
        yield ""


if __name__ == "__main__":
    print(faults_page(Path(sys.argv[1])), end="")
