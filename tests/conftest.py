"""Settings of every test: a slow or busy machine changes no verdict."""

import shutil
import socket

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile("rfedge", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("rfedge")

SLOW_TEST_S = 120
"""Time limit of a slow test that states none, where --timeout does not either; pyproject.toml has
that of the fast ones."""


@pytest.hookimpl(trylast=True)  # after hooks that mark tests as slow
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("timeout") is not None:
        return
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW_TEST_S))


def debian_program(name: str) -> str:
    """Return the path of a program, or fail: this machine could have it."""
    path = shutil.which(name)
    if path is None:
        pytest.fail(f"{name} is missing: run `make test-system-packages` (root, Debian)")
    return path


@pytest.fixture
def promtool() -> str:
    return debian_program("promtool")


@pytest.fixture
def prometheus() -> str:
    return debian_program("prometheus")


@pytest.fixture
def free_port() -> int:
    """A port nobody has, for a program that cannot say which one it took when given 0."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
