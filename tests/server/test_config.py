"""A user's mistakes are refused by the name of the option."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mec_server.config import ServerConfig
from rfcore.errors import InvalidInput


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"workers": 0}, "workers: 0 is outside 1..256"),
        ({"drain_hold_s": 601.0}, "drain_hold_s: 601.0 is outside 0..600"),
        ({"drain_s": -1.0}, "drain_s: -1.0 must not be negative"),
        ({"fields": Path("/nonexistent")}, "fields: /nonexistent is not a directory"),
    ],
)
def test_a_servers_bad_option_is_refused_by_name(
    change: dict[str, Any], named: str, tmp_path: Path
) -> None:
    with pytest.raises(InvalidInput) as caught:
        replace(ServerConfig(tmp_path), **change)
    assert str(caught.value).startswith(named)
