"""Profiles written to disk, and a way to send a schedule through them."""

from collections.abc import Callable
from pathlib import Path

import pytest

from rfcore.link.plan import LinkPlan, read_link

PLAIN = "rate_mbps = 1.0\n"


@pytest.fixture
def profile(tmp_path: Path) -> Callable[..., Path]:
    """Return what writes a profile: text of both directions, of what comes before and after."""

    def write(uplink: str = PLAIN, downlink: str = PLAIN, top: str = "", end: str = "") -> Path:
        path = tmp_path / "link.toml"
        path.write_text(f"{top}\n[uplink]\n{uplink}\n[downlink]\n{downlink}\n{end}\n")
        return path

    return write


@pytest.fixture
def read(profile: Callable[..., Path]) -> Callable[..., LinkPlan]:
    """Return what writes a profile and reads it back."""
    return lambda *sections, **more: read_link(profile(*sections, **more))
