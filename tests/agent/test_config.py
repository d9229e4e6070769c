"""A user's mistakes are refused by the name of the option."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cav_agent.config import AgentConfig
from rfcore.errors import InvalidInput

AGENT = AgentConfig("127.0.0.1:50051", Path("drive"), Path("fields"))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"rate": 0.0}, "rate: 0.0 Hz is outside"),
        ({"rate": float("nan")}, "rate: nan Hz is outside"),
        ({"crf": 99.0}, "crf: 99.0 is outside 1..51"),
        ({"field": "abc"}, "field: 'abc' must be the 64 hexadecimal digits"),
        ({"camera": "a/b"}, "camera: 'a/b' must be"),
        ({"vehicle": ""}, "vehicle: '' must be"),
    ],
)
def test_an_agents_bad_option_is_refused_by_name(change: dict[str, Any], named: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        replace(AGENT, **change)
    assert str(caught.value).startswith(named)
