"""Envoy's own check of a configuration, for tests."""

import subprocess

import pytest

from lab.servers.envoy import START_S, EnvoySetup


def check_config(setup: EnvoySetup):
    """Have Envoy read the configuration, and fail with its words if it refuses."""
    done = subprocess.run(
        [str(setup.binary), "--mode", "validate", "--config-path", str(setup.write())],
        cwd=setup.folder, capture_output=True, text=True, timeout=START_S, check=False,
    )  # fmt: skip
    if done.returncode != 0:
        pytest.fail(f"Envoy refuses {setup.config}: {done.stderr.strip()}")
