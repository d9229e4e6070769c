"""Every attack of the list against a server under compose's limits (`make test-attack`)."""

import math
from functools import reduce
from operator import add
from typing import Any

import pytest

from attack.attacker import ATTACKS
from attack.conftest import ALLOWANCE_MS, MEMORY_BYTES, ROUNDS


@pytest.mark.parametrize("attack", ATTACKS)
async def test_an_attack_costs_the_bystander_nothing(attack: str, scene: Any) -> None:
    identity, work = ATTACKS[attack]
    scene.about(attack, (work.__doc__ or "").strip(), identity)
    calm, control, attacked = [], [], []
    for _ in range(ROUNDS):
        calm.append(await scene.phase())
        control.append(await scene.phase(attack, scene.decoy))
        attacked.append(await scene.phase(attack, scene.target))
    after = await scene.phase()
    judge(scene, *(reduce(add, parts) for parts in (calm, control, attacked)), after)
    assert scene.failed == []


def by_chance(count: int) -> int:
    """Return how many there may be where as long a while before had ``count``.

    Two standard deviations above it (Poisson). Of a bystander that loses none otherwise, none.
    """
    return math.floor(count + 2 * math.sqrt(count))


def judge(scene: Any, calm: Any, control: Any, attacked: Any, after: Any) -> None:
    """Hold what the attack did against the bounds."""
    scene.p99_ms = attacked.p99_ms
    limit_ms = 1.2 * max(calm.p99_ms, control.p99_ms) + ALLOWANCE_MS
    figures = " / ".join(f"{p.p99_ms:.0f}" for p in (calm, control, attacked))
    scene.note(
        f"bystander's p99 <= 1.2 x the larger of calm and control + {ALLOWANCE_MS:g} ms",
        f"calm / control / attacked {figures} ms",
        attacked.p99_ms <= limit_ms,
    )
    lengths = [max(1, len(p.lines)) for p in (calm, control, attacked)]
    for what, results in (("lost or refused", ("lost", "nacked")), ("dropped", ("dropped",))):
        counts = [p.count(*results) for p in (calm, control, attacked)]
        usual = round(max(counts[0] / lengths[0], counts[1] / lengths[1]) * lengths[2])
        scene.note(
            f"frames of it {what} <= the larger share of calm and control, and chance",
            "calm / control / attacked {} / {} / {} of {} / {} / {}".format(*counts, *lengths),
            counts[2] <= by_chance(usual),
        )
    cores = " / ".join(f"{p.cores:.2f}" for p in (calm, control, attacked))
    scene.note("processors that the server kept busy", f"calm / control / attacked {cores}", True)
    spent = f"control / attacked {control.attacked_s:.1f} / {attacked.attacked_s:.1f} s"
    scene.note("the attacker's processor time", spent, attacked.attacked_s > 0)
    scene.note("how its frames ended", attacked.told, attacked.count("acked") > 0)
    scene.note("how they ended afterwards", after.told, after.count("acked") > 0)
    alive = scene.server.poll() is None
    scene.note("server lives", "yes" if alive else "no", alive)
    scene.note("nothing killed for memory", str(scene.group.kills()), scene.group.kills() == 0)
    most, limit = max(attacked.most_bytes, after.most_bytes), MEMORY_BYTES / 2**20
    scene.note(f"memory <= {limit:.0f} MiB", f"{most / 2**20:.0f} MiB", most <= MEMORY_BYTES)
    scene.finished = True
