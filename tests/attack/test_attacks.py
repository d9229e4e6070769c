"""Every attack of the list against a server under compose's limits (`make test-attack`)."""

import math
from functools import reduce
from operator import add
from typing import Any

import pytest

from attack.attacker import ATTACKS, EFFECT, MUCH
from attack.conftest import ALLOWANCE_MS, CPUS, MEMORY_BYTES, ROUNDS


@pytest.mark.parametrize("attack", ATTACKS)
async def test_an_attack_costs_the_bystander_nothing(attack: str, scene: Any) -> None:
    made = ATTACKS[attack]
    scene.about(attack, (made.work.__doc__ or "").strip(), made.identity)
    calm, control, attacked = [], [], []
    for _ in range(ROUNDS):
        calm.append(await scene.phase())
        control.append(await scene.phase(attack, scene.decoy))
        attacked.append(await scene.phase(attack, scene.target))
    after = await scene.phase()
    phases = [reduce(add, parts) for parts in (calm, control, attacked)]
    judge_effect(scene, made.effect, *phases[1:])
    judge(scene, *phases, after)
    assert scene.failed == []


def judge_effect(scene: Any, effect: str, control: Any, attacked: Any) -> None:
    """Hold against the server's own counters whether the attack reached it."""
    before, now = control.grown[effect], attacked.grown[effect]
    scene.note(
        f"what of it reached the server: {effect}",
        f"control / attacked {before:.4g} / {now:.4g}",
        now > EFFECT.get(effect, MUCH) * before,
    )


def most_by_chance(count: int) -> int:
    """Return how many there may be where as long a while before had ``count``.

    None where it had none. Else two standard deviations above it (Poisson).
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
        usual = math.ceil(max(counts[0] / lengths[0], counts[1] / lengths[1]) * lengths[2])
        strict = "none" if usual == 0 else "the larger share of calm and control, and chance"
        scene.note(
            f"frames of it {what} <= {strict}",
            "calm / control / attacked {} / {} / {} of {} / {} / {}".format(*counts, *lengths),
            counts[2] <= most_by_chance(usual),
        )
    cores = " / ".join(f"{p.cores:.2f}" for p in (calm, control, attacked))
    busy = f"processors that the server kept busy, of {CPUS:g} that it may"
    scene.note(busy, f"calm / control / attacked {cores}", True)
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
