"""A decoder that was taken over tries to leave its sandbox."""

from pathlib import Path
from typing import Any

import pytest

from confinement.test_escapes import ROOT, TOOK_OVER, USER, outcomes, place

__all__ = ["place"]


@pytest.mark.parametrize("confinement", ["landlock", "bubblewrap"])
async def test_tries_to_leave_the_sandbox(place: Path, case: Any, confinement: str) -> None:
    tries = ", ".join(sorted(TOOK_OVER))
    case.about(f"escapes from {confinement}", f"{len(TOOK_OVER)} tries: {tries}", "F17")
    for who in (ROOT, USER):
        came_to = outcomes(place, who, confinement, "confined")
        ended = sum(result == "SIGSYS" for result in came_to.values())
        case.tells(f"tries as {who} that end the process", f"{ended} of {len(came_to)}")
        case.holds(
            f"every try as {who} ends it", set(came_to) == TOOK_OVER and ended == len(came_to)
        )
    case.finish()
