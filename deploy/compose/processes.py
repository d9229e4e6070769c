"""Start the services of docker-compose.yml as processes of this machine, where there is no Docker.

``python deploy/compose/processes.py FOLDER [--minutes M] [--prometheus PROGRAM]``

The commands are those of the compose file; only addresses and folders differ. Each service gets a
loopback address of its own (127.77.0.N) in place of its host name, so that every port stays as it
is, and a folder of its own in place of the container's root, where its mounts are symbolic links.
Memory and CPU limits of the compose file are not applied. Servers that run as root are told to
decode in a sandbox, for which the containers have a user. Images of others are not started, except
Prometheus, which is Debian's program.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml

ROOT = Path(__file__).parents[2]

__all__ = ["Location", "Service", "locations_of", "main", "read_services", "words_of"]

OURS = "${RFEDGE_IMAGE}"
START_TIMEOUT_S = 120.0
STOP_TIMEOUT_S = 10.0


@dataclass(frozen=True)
class Service:
    """One service of the compose file; ``mounts`` maps a path in the container to its source.

    ``health``: port and path that answer while it is well, ``:9100/metrics``; empty for a one-shot
    service. ``environment``: beside that of this process.
    """

    name: str
    command: tuple[str, ...]
    mounts: dict[str, str]
    after: tuple[str, ...]
    health: str
    environment: dict[str, str]

    @property
    def lasting(self) -> bool:
        """Whether it runs until it is stopped."""
        return bool(self.health)


@dataclass(frozen=True)
class Location:
    """The loopback address of a service, and the folder that is its root."""

    address: str
    root: Path


def read_services(
    compose: dict[str, Any], environment: dict[str, str], names: tuple[str, ...] = ()
) -> dict[str, Service]:
    """Return the services of our image, and those of ``names``, with variables filled in."""
    services = {}
    for name, content in compose["services"].items():
        if content["image"] != OURS and name not in names:
            continue
        mounts = [volume.split(":")[:2] for volume in content.get("volumes", ())]
        variables = content.get("environment", {})
        services[name] = Service(
            name,
            tuple(_filled(str(word), environment) for word in content["command"]),
            {target: source for source, target in mounts},
            tuple(content.get("depends_on", ())),
            _health(content.get("healthcheck")) if content["image"] == OURS else ":9090/-/ready",
            {key: _filled(value, environment) for key, value in variables.items()},
        )
    return services


def _health(check: dict[str, Any] | None) -> str:
    """Return the port and path of a health check, from its words: healthy PORT [PATH]."""
    if check is None:
        return ""
    _, _, port, *path = check["test"]
    return f":{port}{path[0] if path else '/metrics'}"


def _filled(text: str, environment: dict[str, str]) -> str:
    """Return ``text`` with its variables; raise ``KeyError`` for one that is not set."""
    filled = re.sub(r"\$\{(\w+)\}", lambda found: environment[found[1]], text)
    return filled.replace("$$", "$")


def locations_of(services: dict[str, Service], folder: Path) -> dict[str, Location]:
    """Return an address and a root folder for each service."""
    return {
        name: Location(f"127.77.0.{number}", folder / "roots" / name)
        for number, name in enumerate(services, start=1)
    }


def words_of(service: Service, locations: dict[str, Location]) -> list[str]:
    """Return a service's command with addresses for host names and its own root for paths."""
    words = []
    in_hosts = False
    for word in service.command:
        in_hosts = word == "--hosts" or (in_hosts and not word.startswith("-"))
        if in_hosts and word in locations:
            words.append(locations[word].address)
            continue
        words.append(_located(word, service, locations))
    return words


def _located(text: str, service: Service, locations: dict[str, Location]) -> str:
    own = locations[service.name]
    text = text.replace("0.0.0.0", own.address)
    names = "|".join(sorted(map(re.escape, locations), key=len, reverse=True))
    text = re.sub(rf"\b({names})(?=:\d)", lambda found: locations[found[1]].address, text)
    if "--hosts" in text:
        before, _, after = text.partition("--hosts")
        hosts, end, rest = after.partition(";")
        hosts = re.sub(names, lambda found: locations[found[0]].address, hosts)
        text = f"{before}--hosts{hosts}{end}{rest}"
    for target in service.mounts:
        top = "/" + target.split("/")[1]
        text = re.sub(rf"(?<![\w./-]){re.escape(top)}(?=/|\s|$)", str(own.root) + top, text)
    return text


def prepare_root(service: Service, location: Location, folder: Path) -> None:
    """Make the folder that stands for the container's root: a link for each mount."""
    for target, source in service.mounts.items():
        if source.startswith("."):
            to = ROOT / source
        else:
            to = folder / "volumes" / source
            to.mkdir(parents=True, exist_ok=True)
        link = location.root / target.lstrip("/")
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(to)


def prepare_prometheus(locations: dict[str, Location], root: Path) -> list[str]:
    """Write Prometheus's configuration with these locations; return the words that start it."""
    etc = root / "etc/prometheus"
    (etc / "targets").mkdir(parents=True)
    for name in ("prometheus.yml", "rules.yml"):
        shutil.copy(ROOT / "deploy/prometheus" / name, etc)
    for path in sorted((ROOT / "deploy/compose/targets").glob("*.json")):
        entries = [
            {"targets": [f"{locations[host].address}:{port}"], "labels": {"instance": target}}
            for entry in json.loads(path.read_text())
            for target in entry["targets"]
            for host, port in (target.split(":"),)
        ]
        (etc / "targets" / path.name).write_text(json.dumps(entries))
    return [f"--config.file={etc / 'prometheus.yml'}", f"--storage.tsdb.path={root / 'data'}"]


class Processes:
    """The processes that were started here."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.running: dict[str, subprocess.Popen[bytes]] = {}

    def start(
        self, name: str, words: list[str], variables: Mapping[str, str] = MappingProxyType({})
    ) -> subprocess.Popen[bytes]:
        """Start a service; what it writes goes to ``FOLDER/NAME.log``."""
        environment = {
            **os.environ,
            **variables,
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        }
        with (self._folder / f"{name}.log").open("wb") as log:
            process = subprocess.Popen(words, stdout=log, stderr=log, env=environment, cwd=ROOT)
        self.running[name] = process
        return process

    def wait_healthy(self, name: str, url: str) -> None:
        """Wait until the service answers at ``url``; raise ``RuntimeError`` if it does not."""
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < deadline_s:
            if self.running[name].poll() is not None:
                break
            try:
                with urllib.request.urlopen(url, timeout=1):
                    return
            except (urllib.error.URLError, OSError):
                time.sleep(0.2)
        raise RuntimeError(f"{name} is not up; see {self._folder / name}.log")

    def stop(self) -> None:
        """End every process that was started here."""
        for process in self.running.values():
            process.terminate()
        for process in self.running.values():
            try:
                process.wait(STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()


def run(folder: Path, minutes: float, prometheus: str) -> None:
    """Start everything, wait, and stop."""
    compose = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
    declared = dict(re.findall(r"^(\w+)=(.*)$", (ROOT / ".env").read_text(), re.MULTILINE))
    environment = {name: os.environ.get(name) or value for name, value in declared.items()}
    services = read_services(compose, environment)
    for name in ("urls", "watch"):
        services.pop(name)
    locations = locations_of(services, folder)
    processes = Processes(folder)
    try:
        for service in services.values():
            _start(service, locations, processes, folder)
        listen = f"--web.listen-address=127.0.0.1:{environment['PROMETHEUS_PORT']}"
        words = prepare_prometheus(locations, folder / "roots/prometheus")
        processes.start("prometheus", [prometheus, *words, listen])
        time.sleep(60 * minutes)
    finally:
        processes.stop()


def _start(
    service: Service, locations: dict[str, Location], processes: Processes, folder: Path
) -> None:
    """Start one service and wait until it is healthy, or done if it is a one-shot one."""
    location = locations[service.name]
    prepare_root(service, location, folder)
    words = words_of(service, locations)
    if words[0] == "cav-agent":
        words.append(f"--report={folder / service.name}.jsonl")
    if words[0] == "mec-server" and os.geteuid() == 0:
        words.append("--sandbox-as-root")
    process = processes.start(service.name, words, service.environment)
    if service.lasting:
        processes.wait_healthy(service.name, f"http://{location.address}{service.health}")
    else:
        del processes.running[service.name]
        if process.wait(START_TIMEOUT_S) != 0:
            raise RuntimeError(f"{service.name} failed; see {folder / service.name}.log")
    print(f"{service.name} {location.address}", flush=True)


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="new folder for volumes, roots and logs")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--prometheus", default="prometheus", help="Debian's program")
    options = parser.parse_args()
    options.folder.mkdir(parents=True)
    run(options.folder.resolve(), options.minutes, options.prometheus)


if __name__ == "__main__":
    main()
