"""Link profiles in files: TOML with a table for each direction and, in it, for each impairment.

::

    description = "a drive through a town with a tunnel"
    seed = 7
    [uplink]
    rate_mbps = 4.0             # or a table [uplink.trace]
    delay_ms = 20.0
    queue_kib = 64
    [uplink.outage]             # and trace, delay_trace, jitter: see the modules of those names
    at_s = [[10.0, 2.0]]
    [downlink]
    rate_mbps = 20.0
    [connection_loss]
    mean_life_s = 30.0

A table is read by the module of its name in ``rfcore.link``, which is imported only then.
"""

from __future__ import annotations

import tomllib
from importlib import import_module
from pathlib import Path

from rfcore.errors import InvalidData, InvalidInput
from rfcore.link.plan import DirectionPlan, Impairment, LinkPlan
from rfcore.link.profile import MAX_DELAY_S, MAX_RATE_BPS, LinkProfile
from rfcore.tables import Range, Table

__all__ = ["read_link"]

IMPAIRMENTS = ("outage", "delay_trace", "jitter")
"""In the order in which they act, whatever the order in the file; a trace is in place of a rate."""

MAX_QUEUE_KIB = 1 << 20


def read_link(path: Path) -> LinkPlan:
    """Read a profile.

    Raises ``InvalidInput`` naming the file, the key, its value and the limit, ``InvalidData`` for a
    file that is no TOML or a trace that is none, ``OSError`` for one that cannot be read.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InvalidData(f"{path}: not a link profile ({error})") from error
    try:
        return _link(Table(values, InvalidInput), path.parent)
    except InvalidInput as error:
        raise InvalidInput(f"{path}: {error.field}", error.problem) from error


def _link(top: Table, folder: Path) -> LinkPlan:
    seed = str(top.whole("seed", Range(0, 2**53), 0))
    description = str(top.value("description", ""))
    uplink = _direction(top.table("uplink"), folder, f"{seed}/uplink")
    downlink = _direction(top.table("downlink"), folder, f"{seed}/downlink")
    loss = None
    if "connection_loss" in top:
        loss = import_module("rfcore.link.connection_loss").parse(top.table("connection_loss"))
    top.finish("connection_loss")
    return LinkPlan(uplink, downlink, loss, seed, description)


def _direction(table: Table, folder: Path, seed: str) -> DirectionPlan:
    impairments: list[Impairment] = []
    if "trace" in table:
        if "rate_mbps" in table:
            raise table.error("rate_mbps", "is given beside a trace; give one")
        trace = import_module("rfcore.link.trace").parse(table.table("trace"), folder)
        impairments.append(trace)
        rate_bps = trace.mean_rate_bps
    else:
        rate_bps = 1e6 * table.number("rate_mbps", Range(1e-6, MAX_RATE_BPS / 1e6))
    delay_ms = table.number("delay_ms", Range(0.0, 1e3 * MAX_DELAY_S), 0.0)
    queue_kib = table.number("queue_kib", Range(1, MAX_QUEUE_KIB), 64)
    impairments += [_impairment(name, table, folder) for name in IMPAIRMENTS if name in table]
    table.finish("rate_mbps", "trace", *IMPAIRMENTS)
    profile = LinkProfile(rate_bps, delay_ms / 1e3, int(queue_kib * 1024))
    return DirectionPlan(profile, tuple(impairments), seed)


def _impairment(name: str, table: Table, folder: Path) -> Impairment:
    """Return what the module of this name makes of its table; a recording is read from a file."""
    parse = import_module(f"rfcore.link.{name}").parse
    impairment: Impairment
    if name == "delay_trace":
        impairment = parse(table.table(name), folder)
    else:
        impairment = parse(table.table(name))
    return impairment
