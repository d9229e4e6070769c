"""Pages of the suites that break and attack a server, and of the numerically hard cases.

The tests in ``tests/fault``, ``tests/attack`` and ``tests/hard`` record the rows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, TypedDict

from lab.report import Report, folded
from rfcore.errors import InvalidInput
from rfedge.report.tables import Column, Table, columns, shown, text_table
from rfedge.results import Result, read_result, rows_of

RESULTS = Path(__file__).parents[1] / "results"
HOLDS = Column("holds", lambda row: "yes" if row.held else "**no**")


class LinkCell(TypedDict):
    """The pictures of a vehicle behind a link with loss, delay and a limited rate."""

    loss_percent: float
    rtt_ms: float
    rate_mbps: float
    shown_hz: float
    sent_mbps: float
    frozen_percent: float
    """Share of the time in gaps between pictures of at least max(3 d, d + 150 ms), d their mean."""
    age_p50_ms: float
    age_p99_ms: float
    psnr_db: float
    """Quality of the server's pictures against the camera's."""


@dataclass(frozen=True)
class FaultRow:
    """One fault. ``bound`` and ``measured`` are lists of the same length, split by ``; ``."""

    fault: str = field(metadata=shown("fault"))
    injected_with: str
    bound: str
    measured: str
    passed: bool
    covers: str | None = None
    """Names of the kinds in ``KINDS`` that it is of, split by spaces."""
    test: str | None = None
    """The case of ``tests/fault`` that measured it."""
    cell: LinkCell | None = None

    @property
    def held(self) -> bool:
        """Whether every figure is within its bound."""
        return self.passed


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
"""Loads that are measured by these targets of make, not by the fault suite."""
SOAK = "L7"
PROMISES = """\
What is promised, and no more:

* No silently wrong picture. Every frame that is shown has passed its sequence, CRC, the digest of
  the render it is predicted from, and the digest of what it decodes to; otherwise it is a Nack.
* Nothing stale. Pictures are dropped before they are coded, at most two coded frames of a camera
  are under way, and what was under way when a stream broke is never sent again.
* One vehicle harms itself only. Its packets, its decoder, its streams and its speed are limited
  by name, and a frame it loses costs nobody else one.
* Coming back needs no operator. A vehicle connects again by itself, with a first frame that needs
  nothing from before; a decoder process is replaced by one that stands ready.
* Frames are delivered at most once, and not stored: live pictures are gone when the server is."""
FAULT_WORDS = """\
`make test-fault` starts real servers and vehicles as processes, does to them what the
table says, and measures. Its bounds are part of the tests. A *bystander* is a vehicle at 20 Hz on
the same server that nothing is done to; its latencies while the fault lasts are compared with those
before and after, and with those of a *control*, a vehicle on a server of its own: what both suffer
is the machine's doing. Byte-equal means that the digests of the pictures at the server are those of
a stream that begins there and has no fault."""
LOAD_WORDS = """\
A load is held when 99 % of all pictures that are due are acknowledged within 100 ms and memory
stays flat: [what a server carries](loadtest.md). A fault has bounds of its own instead, so all
faults may hold where a load does not. L4 sends over `samples/links/drive.toml`, a drive past three
cells: its uplink stands still for 0.6 s at each change of cell and has 0.5 Mbit/s beside it, so
pictures of those moments are late whatever the server does."""
LOSS_WORDS = """\
Loss is of IP packets, so that the kernels' TCP meets it as it does on a road: what is
lost is sent again and comes late, and pictures that are too old by then are dropped before they are
coded. No picture is damaged by loss; what it costs is time and, with `--max-delay-ms`, quality."""


def _fault_parts(result: Result) -> Iterator[Table | str]:
    rows = rows_of(FaultRow, result["rows"])
    loads = {kind: _load_runs(kind) for kind in ELSEWHERE}
    runs = [run for those in loads.values() for run in those]
    lost = [kind for kind, those in loads.items() if not those]
    yield (
        f"Faults: {_score([row.held for row in rows])}. Loads, which other tests measure: "
        f"{_score([run['held'] for run in runs])}"
        + (f"; not recorded: {', '.join(lost)}." if lost else ".")
    )
    yield PROMISES
    yield _kinds(rows)
    yield LOAD_WORDS
    yield _loads(loads)
    cells = [row.cell for row in rows if row.cell is not None]
    if cells:
        yield LOSS_WORDS
        yield _loss(cells)
    yield FAULT_WORDS
    for row in rows:
        if not row.held:
            yield _measured(row.fault, row.injected_with, row.bound, row.measured)


def _kinds(rows: Sequence[FaultRow]) -> Table:
    """Return the table of the kinds of fault, each with the rows that test it and how many hold."""
    lines = []
    for kind, what in KINDS.items():
        tested = [row for row in rows if kind in (row.covers or "").split()]
        if tested or kind not in ELSEWHERE:
            by = ", ".join(row.fault for row in tested) or "**not tested**"
            lines.append((kind, what, by, _score([row.held for row in tested])))
    return text_table(("kind", "fault", "tested by", "hold"), lines, "Kinds of fault")


def _loads(loads: Mapping[str, Sequence[Mapping[str, Any]]]) -> Table:
    """Return the table of loads, each with how many runs held and what the others broke."""
    lines = []
    for kind, runs in loads.items():
        broken = dict.fromkeys("; ".join(run["broken"]) for run in runs if not run["held"])
        held = _score([run["held"] for run in runs])
        why = next(iter(broken), "") + (" (and alike)" if len(broken) > 1 else "")
        lines.append((kind, KINDS[kind], f"`make {ELSEWHERE[kind]}`", held, why or "-"))
    heads = ("kind", "load", "measured by", "runs that hold", "not kept")
    return text_table(heads, lines, "Loads")


def _score(held: Sequence[bool]) -> str:
    return f"{sum(held)} of {len(held)}" if held else "**not recorded**"


def _load_runs(kind: str) -> list[Mapping[str, Any]]:
    """Return the recorded runs of a load: those of the newest measurement."""
    path = RESULTS / ("soak.json" if kind == SOAK else "loadtest.json")
    if not path.exists():
        return []
    rows = read_result(path, path.stem)["rows"]
    if kind != SOAK:
        out = f"out/loadtest/{ELSEWHERE[kind].removeprefix('load-')}"
        rows = [row for row in rows if row["command"].split()[-1] == out]
    return [row for row in rows if row.get("run") is not None] or rows


def _loss(cells: Sequence[LinkCell]) -> Table:
    ordered = sorted(cells, key=lambda c: (c["loss_percent"], c["rtt_ms"], c["rate_mbps"]))
    wanted = (
        ("loss %", "loss_percent", "g"),
        ("RTT ms", "rtt_ms", "g"),
        ("link Mbit/s", "rate_mbps", "g"),
        ("shown Hz", "shown_hz", ".1f"),
        ("sent Mbit/s", "sent_mbps", ".2f"),
        ("frozen %", "frozen_percent", ".0f"),
    )
    made = [Column(heading, _item(name), form) for heading, name, form in wanted]
    made.append(Column("age p50 / p99, ms", _ages, "{:.0f} / {:.0f}"))
    made.append(Column("PSNR dB", _item("psnr_db"), ".1f"))
    return Table("Packet loss, round trip and rate", made, ordered)


def _item(name: str) -> Callable[[Mapping[str, float]], float]:
    return lambda cell: cell[name]


def _ages(cell: LinkCell) -> tuple[float, float]:
    return cell["age_p50_ms"], cell["age_p99_ms"]


def _measured(name: str, how: str, bound: str, measured: str) -> str:
    """Return the figures of a case that does not hold beside their bounds, folded away.

    Raises ``InvalidInput`` if a bound lacks its figure.
    """
    bounds, figures = bound.split("; "), measured.split("; ")
    if len(bounds) != len(figures):
        counts = f"{len(bounds)} bounds and {len(figures)} figures"
        raise InvalidInput("results", f"{name}: {counts}; each bound needs its figure")
    figures_table = text_table(("what", "measured"), list(zip(bounds, figures, strict=True)))
    return folded(f"{name}: **does not hold**", f"{how}\n\n{figures_table.markdown()}")


FAULTS = Report(
    "faults",
    "What happens when things break",
    "What servers, vehicles and viewers do when processes die, links break and data is damaged.",
    _fault_parts,
)


@dataclass(frozen=True)
class AttackRow:
    """One attack. ``bound`` and ``measured`` are lists of the same length, split by ``; ``."""

    attack: str
    identity: str
    bound: str
    measured: str
    bystander_p99_ms: float = field(metadata=shown("bystander p99 ms", ".0f"))
    held: bool
    test: str | None = None
    """The case of ``tests/attack`` that measured it."""
    consumer_p99_ms: float | None = field(default=None, metadata=shown("consumer p99 ms", ".0f"))
    """Time from capture to a consumer that watched the bystander, in JPEG."""
    newcomer_s: float | None = field(default=None, metadata=shown("newcomer s", ".2f"))
    """Time of the slowest vehicle that came meanwhile, from its first packet to its first picture
    shown; None if one was never shown, or none came."""

    @property
    def name(self) -> str:
        """The attack in a word."""
        return self.attack.partition(":")[0]


ATTACK_WORDS = """\
A real server with certificates, under the limits of `docker-compose.yml` (by a
control group), and a bystander at street size: the shipped field, 640x360, 10 Hz, its packets coded
beforehand; latencies from the time a picture is due to its Ack. *Control* is the same attacker
aimed at a decoy that reads everything and answers nothing: what the bystander suffers then is the
machine's doing. Calm, control and attack take turns; of what a slow machine drops in calm, as much
may be dropped under attack, and of what it does not drop, nothing. A consumer watches the bystander
all the while, in JPEG. In an attack of its own, newcomers come one after another, each a vehicle
with a certificate and an address of its own. See `SECURITY.md`."""


def _attack_parts(result: Result) -> Iterator[Table | str]:
    rows = rows_of(AttackRow, result["rows"])
    yield f"{sum(row.held for row in rows)} of {len(rows)} hold."
    yield ATTACK_WORDS
    name = Column("attack", lambda row: row.name)
    yield Table("Attacks", columns(AttackRow, name, *FELT, HOLDS), rows)
    for row in rows:
        if not row.held:
            how = f"{row.attack.partition(':')[2].strip()} Certificate: {row.identity}."
            yield _measured(row.name, how, row.bound, row.measured)


FELT = ("bystander_p99_ms", "consumer_p99_ms", "newcomer_s")
ATTACKS = Report(
    "attacks",
    "What attacks cost the others",
    "What a bystander, a consumer and newcomers notice while somebody attacks the server.",
    _attack_parts,
)


@dataclass(frozen=True)
class StabilityRow:
    """A numerically hard case: what is right, what came out, and by how much it may be off."""

    group: str
    name: str = field(metadata=shown("case"))
    expected: str = field(metadata=shown("expected"))
    got: str = field(metadata=shown("got"))
    holds: bool
    error: float | None
    limit: float | None


STABILITY_WORDS = """\
*error* is the largest difference from what is right: for pictures, of a colour or
opacity (of 1) in float32 from the float64 definition; for gradients, relative to the float64
gradient of a group of parameters; for poses, which are float64, from the exact value. *limit* is
what it may be; a case without numbers is a yes or no."""


def _stability_parts(result: Result) -> Iterator[Table | str]:
    rows = rows_of(StabilityRow, result["cases"])
    broken = [f"{row.group}: {row.name}" for row in rows if not row.holds]
    yield f"Broken: {'; '.join(broken)}." if broken else f"All {len(rows)} cases hold."
    yield STABILITY_WORDS
    numbers = [_number_column("error"), _number_column("limit")]
    for group, cases in groupby(rows, key=lambda row: row.group):
        yield Table(f"**{group}**", [*columns(StabilityRow), *numbers], list(cases))


def _number_column(name: str) -> Column:
    def text(row: StabilityRow) -> str:
        value: float | None = getattr(row, name)
        if value is None:
            return ""
        return f"{value:.1e}" if value and math.isfinite(value) else f"{value:g}"

    return Column(name, text)


STABILITY = Report(
    "stability",
    "Hard cases",
    "What comes out where arithmetic is at its limits; every case is judged by a float64 "
    "definition, a closed form or an invariance.",
    _stability_parts,
)
