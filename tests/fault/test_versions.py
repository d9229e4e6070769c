"""Vehicles and servers of the previous release beside those of this one."""

from pathlib import Path
from typing import Any

import pytest

from integration.test_version_skew import Release, previous
from integration.test_version_skew import (
    test_earlier_releases_are_understood as understand_the_previous_release,
)

__all__ = ["previous"]


@pytest.mark.timeout(900)
@pytest.mark.parametrize(("server_is_old", "agent_is_old"), [(True, False), (False, True)])
async def test_version_skew(
    previous: Release,
    street: Any,
    case: Any,
    tmp_path: Path,
    server_is_old: bool,
    agent_is_old: bool,
) -> None:
    old = "server" if server_is_old else "vehicle"
    case.about(f"{old} of the previous release", "its commit, built from history", "F27")
    await understand_the_previous_release(previous, street, tmp_path, server_is_old, agent_is_old)
    case.holds("field fetched, 6 of 6 frames acknowledged, each exact", True)
    case.finish()
