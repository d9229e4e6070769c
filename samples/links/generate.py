"""Make the synthetic traces of this folder: ``python samples/links/generate.py samples/links``.

``drive.up`` is 30 s of uplink in Mahimahi's format: three cells passed at walking pace, 0.5 to
4 Mbit/s, with 0.6 s of nothing at each change of cell. ``drive.delay.txt`` is 30 s of delay in the
format of the CICV5G recordings: 20 ms and what a scheduler adds, more near the cells' edges.
"""

import math
import sys
from pathlib import Path
from random import Random

SECONDS = 30
CELL_S = 10
HANDOVER_S = 0.6
OPPORTUNITY_BITS = 1500 * 8


def nearness(at_s: float) -> float:
    """Return 1 in the middle of a cell and 0 at its edge."""
    return math.sin(math.pi * (at_s % CELL_S) / CELL_S)


def capacity_lines(random: Random) -> list[str]:
    """Return one line for each opportunity to deliver 1500 bytes."""
    lines, owed_bits = [], 0.0
    for at_ms in range(1, SECONDS * 1000 + 1):
        at_s = at_ms / 1000
        if at_s % CELL_S < HANDOVER_S:
            continue
        rate_bps = 0.5e6 + 3.5e6 * nearness(at_s)
        owed_bits += rate_bps / 1000 * random.expovariate(1.0)
        while owed_bits >= OPPORTUNITY_BITS:
            owed_bits -= OPPORTUNITY_BITS
            lines.append(str(at_ms))
    return [*lines, str(SECONDS * 1000)]


def delay_lines(random: Random) -> list[str]:
    """Return a header and 20 samples a second."""
    lines = ["pub_time(ms) sub_time(ms) delay(ms)"]
    for at_ms in range(0, SECONDS * 1000, 50):
        extra_ms = random.expovariate(1.0) * (4 + 20 * (1 - nearness(at_ms / 1000)))
        delay_ms = 20 + min(200, round(extra_ms))
        lines.append(f"{at_ms} {at_ms + delay_ms} {delay_ms}")
    return lines


def main(folder: Path) -> None:
    """Write both files."""
    (folder / "drive.up").write_text("\n".join(capacity_lines(Random("capacity"))) + "\n")
    (folder / "drive.delay.txt").write_text("\n".join(delay_lines(Random("delay"))) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
