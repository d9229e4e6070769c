"""Link profiles in files: TOML with a section for each direction and, in it, for each stage.

::

    description = "a drive through a town with a tunnel"
    seed = 7
    [uplink]
    rate_mbps = 4.0             # or a section [uplink.trace]
    delay_ms = 20.0
    queue_kib = 64
    [uplink.outage]             # and trace, delay_trace, jitter: see the modules of those names
    at_s = [[10.0, 2.0]]
    [downlink]
    rate_mbps = 20.0
    [connection_loss]
    mean_life_s = 30.0

A section is read by the module of its name in ``rfcore.link``, which is imported only then.
"""

from __future__ import annotations

import tomllib
from importlib import import_module
from pathlib import Path

from rfcore.errors import InvalidData, InvalidInput
from rfcore.link.plan import DirectionPlan, LinkPlan, Stage
from rfcore.link.profile import MAX_DELAY_S, MAX_RATE_BPS, LinkProfile
from rfcore.link.section import Section

__all__ = ["read_link"]

STAGES = ("outage", "delay_trace", "jitter")
"""In the order in which they act, whatever the order in the file; a trace is in place of a rate."""

MAX_QUEUE_KIB = 1 << 20


def read_link(path: Path) -> LinkPlan:
    """Read a profile.

    Raises ``InvalidInput`` naming a value and its limit, ``InvalidData`` for a file that is no
    TOML or a trace that is none, ``OSError`` for one that cannot be read.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InvalidData(f"{path}: not a link profile ({error})") from error
    top = Section("", values, path.parent)
    seed = str(int(top.checked("seed", top.take("seed", 0), (0, 2**53))))
    description = str(top.take("description", ""))
    uplink = _direction(top.section("uplink"), f"{seed}/uplink")
    downlink = _direction(top.section("downlink"), f"{seed}/downlink")
    loss = None
    if "connection_loss" in top:
        loss = import_module("rfcore.link.connection_loss").parse(top.section("connection_loss"))
    top.take("connection_loss", None)
    top.finish()
    return LinkPlan(uplink, downlink, loss, seed, description)


def _direction(section: Section, seed: str) -> DirectionPlan:
    stages: list[Stage] = []
    if "trace" in section:
        if "rate_mbps" in section:
            raise InvalidInput(f"{section.name}.rate_mbps", "is given beside a trace; give one")
        trace = import_module("rfcore.link.trace").parse(section.section("trace"))
        stages.append(trace)
        rate_bps = trace.mean_rate_bps
    else:
        rate_bps = 1e6 * section.number("rate_mbps", (1e-6, MAX_RATE_BPS / 1e6))
    delay_ms = section.number("delay_ms", (0.0, 1e3 * MAX_DELAY_S), 0.0)
    queue_kib = section.number("queue_kib", (1, MAX_QUEUE_KIB), 64)
    stages += [
        import_module(f"rfcore.link.{name}").parse(section.section(name))
        for name in STAGES
        if name in section
    ]
    for name in ("rate_mbps", "trace", *STAGES):
        section.take(name, None)
    section.finish()
    profile = LinkProfile(rate_bps, delay_ms / 1e3, int(queue_kib * 1024))
    return DirectionPlan(profile, tuple(stages), seed)
