"""The demo of docker-compose.yml, built and started: all targets up, every vehicle is seen.

Needs root, docker, docker-compose and the images (`make test-compose`). Nothing is asserted about
times; the clock only bounds the wait.
"""

import json
import os
import shutil
import subprocess
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
FILES = ("-f", "docker-compose.yml", "-f", "deploy/stand-in/docker-compose.yml")
PATIENCE_S = 600.0
LIMIT_BYTES = {"rfedge-runtime:local": 500e6, "rfedge-full:local": 1.6e9}

pytestmark = [pytest.mark.slow, pytest.mark.compose, pytest.mark.timeout(1200)]


def run(*words: str, **more: Any) -> str:
    done = subprocess.run(
        words, cwd=ROOT, capture_output=True, text=True, check=False, env={**os.environ, **more}
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def compose(*words: str, **more: Any) -> str:
    plugin = subprocess.run(["docker", "compose", "version"], capture_output=True, check=False)
    program = ("docker", "compose") if plugin.returncode == 0 else ("docker-compose",)
    return run(*program, *FILES, *words, **more)


@pytest.fixture(scope="module")
def prometheus() -> Iterator[Callable[[str], list[Any]]]:
    """The demo under a name of its own; returns a function that asks its Prometheus."""
    assert shutil.which("docker"), "docker is missing: install Debian's docker.io, docker-compose"
    own = {
        "COMPOSE_PROJECT_NAME": "rfedge-test", "PROMETHEUS_PORT": "19090",
        "GRAFANA_PORT": "13000", "RSU_A_PORT": "15051", "RSU_B_PORT": "15052",
    }  # fmt: skip

    def ask(expr: str) -> list[Any]:
        query = urllib.parse.urlencode({"query": expr})
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:19090/api/v1/query?{query}") as answer:
                result: list[Any] = json.load(answer)["data"]["result"]
        except (urllib.error.URLError, ConnectionError):
            return []
        return result

    try:
        compose("up", "-d", **own)
        yield ask
    finally:
        compose("down", "-v", **own)


def eventually(ask: Callable[[], Any]) -> Any:
    """Return the first true answer; fail when there is none in time."""
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        if answer := ask():
            return answer
        time.sleep(2)
    pytest.fail(f"no answer within {PATIENCE_S:g} s")


@pytest.mark.parametrize("image", LIMIT_BYTES)
def test_an_image_is_small_enough(image):
    size_bytes = int(run("docker", "image", "inspect", image, "--format", "{{.Size}}"))
    assert size_bytes <= LIMIT_BYTES[image]


def test_the_runtime_image_has_neither_torch_nor_opencv():
    listed = run("docker", "run", "--rm", "rfedge-runtime:local", "sh", "-c",
                 "ls /opt/rfedge/lib/python3.11/site-packages")  # fmt: skip
    assert not {"torch", "cv2", "matplotlib"} & set(listed.split())


def test_the_full_image_trains():
    run("docker", "run", "--rm", "--read-only", "--tmpfs", "/tmp", "rfedge-full:local",
        "python", "-c", "import torch, cv2, matplotlib, rfedge.training.run")  # fmt: skip


def test_every_target_is_up_and_every_vehicle_is_seen(prometheus):
    eventually(lambda: len(prometheus("up == 1")) == 10)
    seen = 'sum by (instance) (rfedge_agent_frames_total{result="acked"}) > 20'
    eventually(lambda: len(prometheus(seen)) == 4)
    assert len(prometheus('rfedge_server_frames_total{result="acked"} > 20')) == 2
    assert prometheus('rfedge_server_frames_total{result="nacked"} > 0') == []
