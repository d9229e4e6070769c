"""``docs/attacks.md`` from ``lab/results/attacks.json``: what attacks on a server cost a bystander.

python -m lab.pages.attacks lab/results/attacks.json > docs/attacks.md
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from rfcore.errors import InvalidInput
from rfedge.report.tables import table
from rfedge.results import read_result, rows_of

__all__ = ["AttackRow", "attacks_page"]


@dataclass(frozen=True)
class AttackRow:
    """One attack. ``bound`` and ``measured`` are lists of the same length, split by ``; ``."""

    attack: str
    identity: str
    bound: str
    measured: str
    bystander_p99_ms: float
    held: bool
    test: str | None = None
    """The case of ``tests/attack`` that measured it."""
    consumer_p99_ms: float | None = None
    """From capture to a consumer that watched the bystander, in JPEG."""
    newcomer_s: float | None = None
    """Of the slowest vehicle that came meanwhile, from its first packet to its first picture shown;
    None: one was never shown, or the row is from before there were any."""


OPENING = """# What attacks cost the others

Generated from `lab/results/attacks.json` by `make test-attack`; do not edit.

A real server with certificates, under the limits of `docker-compose.yml` (by a control group; an
attack's table says which), and a bystander at street size: the shipped field, 640x360, 10 Hz, its
packets coded beforehand, as a vehicle codes on a machine of its own; latencies from the time a
picture is due to its Ack. One attack after the other, each from a process that has a processor
while it is idle. *Control* is the same attacker aimed at a decoy that reads everything and answers
nothing: what the bystander suffers then is the machine's doing. Calm, control and attack take
turns; of what a slow machine drops in calm, as much may be dropped under attack, and of what it
does not drop, nothing. A consumer watches the bystander all the while, in JPEG. In an attack of its
own, newcomers come one after another, each a vehicle with a certificate and an address of its own:
what is measured is the way from its first packet to its first picture shown, and the slowest
counts. A packet that opens a connection and is lost is sent again after a second, and a vehicle
that comes back to a server at rest is held to one, so a newcomer has two.
See [SECURITY.md](../SECURITY.md).
"""


def attacks_page(path: Path) -> str:
    """Return the page; raise ``InvalidInput`` for a file of another kind."""
    result = read_result(path, "attacks")
    rows, machine = rows_of(AttackRow, result["rows"]), result["host"]
    held = sum(row.held for row in rows)
    score = (
        f"{held} of {len(rows)} hold. `{result['command']}` at `{result['revision']}`; "
        f"{machine['cpu']}, {machine['cores']} cores, {machine['isa']}.\n"
    )
    return "\n".join([OPENING, score, *map(_section, rows)])


def _section(row: AttackRow) -> str:
    name, _, what = row.attack.partition(":")
    bounds, figures = row.bound.split("; "), row.measured.split("; ")
    if len(bounds) != len(figures):
        counts = f"{len(bounds)} bounds and {len(figures)} figures"
        raise InvalidInput("results", f"{name}: {counts}; each bound needs its figure")
    verdict = "holds" if row.held else "**does not hold**"
    heading = f"## {name}: {verdict}\n\n{what.strip()} Certificate: {row.identity}.\n\n"
    return heading + table(("what", "measured"), zip(bounds, figures, strict=True)) + "\n"


if __name__ == "__main__":
    print(attacks_page(Path(sys.argv[1])), end="")
