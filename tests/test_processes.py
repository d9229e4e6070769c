"""The demo's processes: ready files, early ends and failures are all said plainly."""

import sys

import pytest

from rfcore.errors import RfedgeError
from rfedge.processes import run_to_end, service

LISTENS = """
import pathlib, signal, sys
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
pathlib.Path(sys.argv[-1] + ".part").write_text("127.0.0.1:9\\n")
pathlib.Path(sys.argv[-1] + ".part").replace(sys.argv[-1])
signal.pause()
"""


def test_a_service_is_used_once_it_says_its_address_and_then_stopped(tmp_path):
    with service("server", [sys.executable, "-c", LISTENS], tmp_path) as running:
        assert running.address == "127.0.0.1:9"
        assert running.process.poll() is None
    assert running.process.returncode == 0


def test_a_service_that_ends_early_is_reported_with_its_last_words(tmp_path):
    command = [sys.executable, "-c", "import sys; sys.exit('no field in there')"]
    with (
        pytest.raises(RfedgeError, match=r"(?s)server ended with status 1.*no field in there"),
        service("server", command, tmp_path),
    ):
        pytest.fail("the block must not run")


def test_a_failing_command_is_reported_with_its_last_words(tmp_path):
    command = [sys.executable, "-c", "print('link is gone'); raise SystemExit(3)"]
    with pytest.raises(RfedgeError, match=r"(?s)agent ended with status 3.*link is gone"):
        run_to_end("agent", command, tmp_path, timeout_s=30)


def test_a_command_that_runs_over_is_ended(tmp_path):
    command = [sys.executable, "-c", "import signal; signal.pause()"]
    with pytest.raises(RfedgeError, match="did not end within 1 s"):
        run_to_end("agent", command, tmp_path, timeout_s=1)
