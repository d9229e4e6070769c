"""Every attack of the list against a server under compose's limits (`make test-attack`)."""

import math
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from functools import reduce
from operator import add
from typing import Any

import pytest

from attack.attacker import ATTACKS, NO_CAPACITY, OPENED, PROCESSOR_S, Attack
from attack.conftest import ALLOWANCE_MS, ROUNDS, STOPPED_S
from attack.control_group import CPUS, MEMORY_BYTES
from attack.packet_attacks import was_given
from attack.target import Target
from mec_server.decoding.child import DECODER_NAME

NEWCOMER_S = 2.0
"""A SYN that is lost is sent again after 1 s (RFC 6298, section 2), and a vehicle that comes back
to a server at rest has a picture shown within 1 s (F1 of lab/results/faults.md)."""


@pytest.mark.parametrize("attack", ATTACKS)
async def test_an_attack_costs_the_bystander_nothing(attack: str, scene: Any) -> None:
    made = ATTACKS[attack]
    scene.about(attack, (made.work.__doc__ or "").strip(), made.identity)
    calm, control, attacked = [], [], []
    for _ in range(ROUNDS):
        calm.append(await scene.phase())
        control.append(await scene.phase(attack, scene.decoy))
        attacked.append(await scene.phase(attack, scene.target))
    newcomers = await scene.newcomers(attack)
    after = await scene.phase()
    phases = [reduce(add, parts) for parts in (calm, control, attacked)]
    judge_effect(scene, made, *phases[1:])
    judge_newcomers(scene, *newcomers)
    judge_consumer(scene, *phases)
    judge(scene, *phases, after)
    scene.finish()


def judge_effect(scene: Any, attack: Attack, control: Any, attacked: Any) -> None:
    """Hold against the server's own counters whether the attack reached it, or was refused."""
    before, now = attack.amount(control.grown), attack.amount(attacked.grown)
    scene.note(
        f"what of it reached the server: {attack.evidence}",
        f"control / attacked {before:.4g} / {now:.4g}",
        attack.is_noticed(control.grown, attacked.grown),
    )


def most_by_chance(count: int) -> int:
    """Return how many there may be where as long a while before had ``count``.

    None where it had none. Else two standard deviations above it (Poisson).
    """
    return math.floor(count + 2 * math.sqrt(count))


def judge_newcomers(scene: Any, calm: list[Any], attacked: list[Any]) -> None:
    """Hold the slowest of those that came during an attack against the bound."""
    slowest_s = [math.inf, math.inf]
    for i, came in enumerate((calm, attacked)):
        slowest_s[i] = max(math.inf if x["shown_s"] is None else x["shown_s"] for x in came)
    problems = sorted({x["problem"].replace(";", ",") for x in attacked} - {""})
    told = ", ".join((f"{slowest_s[0]:.2f} / {slowest_s[1]:.2f} s", *problems))
    scene.newcomer_s = slowest_s[1] if math.isfinite(slowest_s[1]) else None
    scene.note(
        f"from a newcomer's first packet to its first picture shown <= {NEWCOMER_S:g} s",
        f"slowest calm / attacked {told}, of {len(calm)} / {len(attacked)}",
        slowest_s[1] <= NEWCOMER_S,
        is_timed=math.isfinite(slowest_s[1]),
    )


def judge_consumer(scene: Any, calm: Any, control: Any, attacked: Any) -> None:
    """Hold what a consumer missed of the bystander's pictures against the bound."""
    phases = (calm, control, attacked)
    scene.consumer_p99_ms = attacked.consumer_p99_ms
    figures = " / ".join(f"{phase.consumer_p99_ms:.0f}" for phase in phases)
    scene.note(
        "p99 from capture to a consumer, in JPEG", f"calm / control / attacked {figures} ms", True
    )
    hold_share(
        scene,
        "that were shown and a consumer missed",
        [phase.missed for phase in phases],
        [phase.count("acked") for phase in phases],
    )


def hold_share(scene: Any, what: str, counts: list[int], lengths: list[int]) -> None:
    """Hold how many of the bystander's frames something happened to, in calm, control and attack,
    of how many each: under attack no larger share than in the others, but for chance."""
    lengths = [max(1, length) for length in lengths]
    usual = math.ceil(max(counts[0] / lengths[0], counts[1] / lengths[1]) * lengths[2])
    strict = "none" if usual == 0 else "the larger share of calm and control, and chance"
    scene.note(
        f"frames of it {what} <= {strict}",
        "calm / control / attacked {} / {} / {} of {} / {} / {}".format(*counts, *lengths),
        counts[2] <= most_by_chance(usual),
    )


def judge(scene: Any, calm: Any, control: Any, attacked: Any, after: Any) -> None:
    """Hold what the attack did against the bounds."""
    scene.p99_ms = attacked.p99_ms
    limit_ms = 1.2 * max(calm.p99_ms, control.p99_ms) + ALLOWANCE_MS
    figures = " / ".join(f"{p.p99_ms:.0f}" for p in (calm, control, attacked))
    scene.note(
        f"bystander's p99 <= 1.2 x the larger of calm and control + {ALLOWANCE_MS:g} ms",
        f"calm / control / attacked {figures} ms",
        attacked.p99_ms <= limit_ms,
        is_timed=True,
    )
    phases = (calm, control, attacked)
    for what, results in (("lost or refused", ("lost", "nacked")), ("dropped", ("dropped",))):
        hold_share(scene, what, [p.count(*results) for p in phases], [len(p.lines) for p in phases])
    cores = " / ".join(f"{p.cores:.2f}" for p in (calm, control, attacked))
    busy = f"processors that the server kept busy, of {CPUS:g} that it may"
    scene.note(busy, f"calm / control / attacked {cores}", True)
    stopped = " / ".join(f"{p.grown[STOPPED_S]:.2f}" for p in (calm, control, attacked))
    scene.note(
        "for how long the kernel stopped it, as its processor time was used up, on each processor",
        f"calm / control / attacked {stopped} s",
        True,
    )
    spent = f"control / attacked {control.attacked_s:.1f} / {attacked.attacked_s:.1f} s"
    scene.note("the attacker's processor time", spent, attacked.attacked_s > 0)
    scene.note("how its frames ended", attacked.told, attacked.count("acked") > 0)
    scene.note("how they ended afterwards", after.told, after.count("acked") > 0)
    alive = scene.server.poll() is None
    scene.note("server lives", "yes" if alive else "no", alive)
    scene.note("nothing killed for memory", str(scene.group.kills()), scene.group.kills() == 0)
    most, limit = max(attacked.most_bytes, after.most_bytes), MEMORY_BYTES / 2**20
    scene.note(f"memory <= {limit:.0f} MiB", f"{most / 2**20:.0f} MiB", most <= MEMORY_BYTES)


async def nothing(_: Target) -> None:
    """An attack that does nothing."""


def test_what_nobody_notices_is_no_attack() -> None:
    refused_early = Attack("vehicle", nothing, OPENED, NO_CAPACITY)
    assert not refused_early.is_noticed({}, {})
    assert not refused_early.is_noticed({OPENED: 2.0}, {OPENED: 2.0, NO_CAPACITY: 2.0})
    assert not Attack("none", nothing, PROCESSOR_S).is_noticed(
        {PROCESSOR_S: 4.0}, {PROCESSOR_S: 4.3}
    )


@pytest.mark.parametrize("grown", [{OPENED: 1.0}, {NO_CAPACITY: 1.0}])
def test_what_is_refused_was_noticed_too(grown: dict[str, float]) -> None:
    assert Attack("vehicle", nothing, OPENED, NO_CAPACITY).is_noticed({}, grown)


def test_a_refusal_for_another_reason_is_no_effect() -> None:
    assert not Attack("vehicle", nothing, OPENED).is_noticed({}, {NO_CAPACITY: 9.0})


def test_of_two_decoders_only_the_one_that_was_given_the_slice_is_found() -> None:
    slice_, other = bytes(range(1, 200)), bytes(range(2, 201))
    with decoding(other) as bystanders, decoding(bytes(354_000) + slice_) as attackers:
        assert was_given(attackers, slice_)
        assert not was_given(bystanders, slice_)
    assert not was_given(attackers, slice_)


@contextmanager
def decoding(given: bytes) -> Iterator[int]:
    """Yield the number of a process with a decoder's memory, in which ``given`` stands."""
    memory = os.memfd_create(DECODER_NAME)
    os.write(memory, given)
    process = subprocess.Popen(["cat"], stdin=subprocess.PIPE, pass_fds=(memory,))
    os.close(memory)
    try:
        yield process.pid
    finally:
        process.communicate()
