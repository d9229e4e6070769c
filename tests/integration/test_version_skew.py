"""Old vehicles at new servers and new vehicles at old servers: the previous release, from history.

``previous_release.txt`` names its commit. It is compiled here once, in a minute or
two.
"""

import json
from pathlib import Path
from typing import Any

import pytest

from history import START_OLD, code_of, git
from integration.test_agents_live_on import running_command, until

PREVIOUS = Path(__file__).with_name("previous_release.txt")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


def previous_commit() -> str:
    """Return the commit; skip only where its history cannot be had without the network."""
    lines = PREVIOUS.read_text().splitlines()
    (commit,) = (line for line in lines if line and not line.startswith("#"))
    if git("rev-parse", "--git-dir").returncode != 0:
        pytest.skip("this is no git checkout: there is no history to build from")
    if git("cat-file", "-e", f"{commit}^{{commit}}").returncode == 0:
        return commit
    if git("rev-parse", "--is-shallow-repository").stdout.strip() == b"true":
        pytest.skip(f"the history is shallow and lacks {commit}: git fetch --unshallow")
    raise AssertionError(f"{PREVIOUS.name} names {commit}, which is not in this history")


@pytest.fixture(scope="module")
def previous(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the previous release, compiled."""
    return code_of(previous_commit(), tmp_path_factory.mktemp("previous"))


def acked(report: Path) -> int:
    if not report.exists():
        return 0
    lines = report.read_text().split("\n")[:-1]
    good = [json.loads(line) for line in lines if json.loads(line)["result"] == "acked"]
    assert all(line["server_digest"] == line["reconstruction_digest"] for line in good)
    return len(good)


@pytest.mark.parametrize(("server_is_old", "agent_is_old"), [(True, False), (False, True)])
async def test_the_previous_release_is_understood(
    previous: Path, street: Any, tmp_path: Path, server_is_old: bool, agent_is_old: bool
) -> None:
    """A field is fetched, and frames are acknowledged with the digests that the vehicle expects."""

    def start(is_old: bool, module: str, *arguments: object) -> Any:
        starter = tmp_path / "start_old.py"
        starter.write_text(START_OLD)
        program = (starter, previous, module) if is_old else ("-m", module)
        return running_command(tmp_path / f"{module}.log", *program, *arguments)

    ready, report = tmp_path / "ready", tmp_path / "report.jsonl"
    fields = tmp_path / "fields"
    fields.mkdir()
    served = ("--fields", street.store, "--listen", "127.0.0.1:0", "--ready-file", ready)
    async with start(server_is_old, "mec_server", *served, "--decoder", "in-process") as server:
        await until(lambda: ready.exists() or server.returncode is not None)
        assert server.returncode is None, (tmp_path / "mec_server.log").read_text()
        driven = (
            "--server",
            ready.read_text().strip(),
            "--drive",
            street.drive,
            "--fields",
            fields,
        )
        coder = () if agent_is_old else ("--coder", "x264")  # the old server knows no other
        more = (*coder, "--preset", "ultrafast", "--pace", "lockstep", "--report", report)
        async with start(agent_is_old, "cav_agent", *driven, *more) as agent:
            await until(lambda: agent.returncode is not None)
            assert agent.returncode == 0, (tmp_path / "cav_agent.log").read_text()
    assert acked(report) == 6
    assert (fields / f"{street.field_id}.rff").exists()
