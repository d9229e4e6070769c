import pytest

from rfcore.field import SplatField
from wall_scene import wall_field


@pytest.fixture(scope="session")
def wall() -> SplatField:
    return wall_field(0.5)
