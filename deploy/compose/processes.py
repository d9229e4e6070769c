"""Start the services of docker-compose.yml as processes of this machine, where there is no Docker.

``python deploy/compose/processes.py FOLDER [--minutes M] [--prometheus PROGRAM]``

The commands are those of the compose file, word by word; only places differ. Each service gets a
loopback address of its own (127.77.0.N) in place of its host name, so that every port stays as it
is, and a folder of its own in place of the container's root, where its mounts are symbolic links.
Memory and CPU limits of the compose file are not applied. Servers of root are told to decode in a
sandbox all the same: the containers have a user for that. Images of others are not started, except
Prometheus, which is Debian's program. At the end it prints the CPU time of each service with its
children, and of the whole machine.
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

import psutil
import yaml

ROOT = Path(__file__).parents[2]

__all__ = ["Place", "Service", "main", "places_of", "read_services", "words_of"]

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
class Place:
    """Where a service runs: its loopback address, and the folder that is its root."""

    address: str
    root: Path


def read_services(
    compose: dict[str, Any], environment: dict[str, str], names: tuple[str, ...] = ()
) -> dict[str, Service]:
    """Return the services of our image and those of ``names``, with variables filled in."""
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
    """Return what deploy/healthy.sh asks for, from its words: healthy PORT [PATH]."""
    if check is None:
        return ""
    _, _, port, *path = check["test"]
    return f":{port}{path[0] if path else '/metrics'}"


def _filled(text: str, environment: dict[str, str]) -> str:
    """Return ``text`` with its variables; raise ``KeyError`` for one that is not set."""
    filled = re.sub(r"\$\{(\w+)\}", lambda found: environment[found[1]], text)
    return filled.replace("$$", "$")


def places_of(services: dict[str, Service], folder: Path) -> dict[str, Place]:
    """Return an address and a root folder for each service."""
    return {
        name: Place(f"127.77.0.{number}", folder / "roots" / name)
        for number, name in enumerate(services, start=1)
    }


def words_of(service: Service, places: dict[str, Place]) -> list[str]:
    """Return a service's command with addresses for host names and its own root for paths."""
    words = []
    in_hosts = False
    for word in service.command:
        in_hosts = word == "--hosts" or (in_hosts and not word.startswith("-"))
        if in_hosts and word in places:
            words.append(places[word].address)
            continue
        words.append(_placed(word, service, places))
    return words


def _placed(text: str, service: Service, places: dict[str, Place]) -> str:
    own = places[service.name]
    text = text.replace("0.0.0.0", own.address)
    names = "|".join(sorted(map(re.escape, places), key=len, reverse=True))
    text = re.sub(rf"\b({names})(?=:\d)", lambda found: places[found[1]].address, text)
    if "--hosts" in text:
        before, _, after = text.partition("--hosts")
        hosts, end, rest = after.partition(";")
        hosts = re.sub(names, lambda found: places[found[0]].address, hosts)
        text = f"{before}--hosts{hosts}{end}{rest}"
    for target in service.mounts:
        top = "/" + target.split("/")[1]
        text = re.sub(rf"(?<![\w./-]){re.escape(top)}(?=/|\s|$)", str(own.root) + top, text)
    return text


def prepare_root(service: Service, place: Place, folder: Path) -> None:
    """Make the folder that stands for the container's root: a link for each mount."""
    for target, source in service.mounts.items():
        if source.startswith("."):
            to = ROOT / source
        else:
            to = folder / "volumes" / source
            to.mkdir(parents=True, exist_ok=True)
        link = place.root / target.lstrip("/")
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(to)


def prepare_prometheus(places: dict[str, Place], root: Path) -> list[str]:
    """Write Prometheus's configuration with these places; return the words that start it."""
    etc = root / "etc/prometheus"
    (etc / "targets").mkdir(parents=True)
    for name in ("prometheus.yml", "rules.yml"):
        shutil.copy(ROOT / "deploy/prometheus" / name, etc)
    for path in sorted((ROOT / "deploy/compose/targets").glob("*.json")):
        entries = [
            {"targets": [f"{places[host].address}:{port}"], "labels": {"instance": target}}
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

    def cpu_s(self) -> dict[str, float]:
        """Return the seconds of CPU that each process took so far, with its children."""
        spent = {}
        for name, process in self.running.items():
            tree = psutil.Process(process.pid)
            times = [part.cpu_times() for part in (tree, *tree.children(recursive=True))]
            spent[name] = sum(time.user + time.system for time in times)
        return spent

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
    """Start everything, wait, print the CPU time that it took, and stop."""
    compose = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
    declared = dict(re.findall(r"^(\w+)=(.*)$", (ROOT / ".env").read_text(), re.MULTILINE))
    environment = {name: os.environ.get(name) or value for name, value in declared.items()}
    services = read_services(compose, environment)
    for name in ("urls", "watch"):
        services.pop(name)
    places = places_of(services, folder)
    processes = Processes(folder)
    try:
        for service in services.values():
            _start(service, places, processes, folder)
        listen = f"--web.listen-address=127.0.0.1:{environment['PROMETHEUS_PORT']}"
        words = prepare_prometheus(places, folder / "roots/prometheus")
        processes.start("prometheus", [prometheus, *words, listen])
        _report(processes, minutes)
    finally:
        processes.stop()


def _start(service: Service, places: dict[str, Place], processes: Processes, folder: Path) -> None:
    """Start one service and wait until it is healthy, or done if it is a one-shot one."""
    place = places[service.name]
    prepare_root(service, place, folder)
    words = words_of(service, places)
    if words[0] == "cav-agent":
        words.append(f"--report={folder / service.name}.jsonl")
    if words[0] == "mec-server" and os.geteuid() == 0:
        words.append("--sandbox-as-root")
    process = processes.start(service.name, words, service.environment)
    if service.lasting:
        processes.wait_healthy(service.name, f"http://{place.address}{service.health}")
    else:
        del processes.running[service.name]
        if process.wait(START_TIMEOUT_S) != 0:
            raise RuntimeError(f"{service.name} failed; see {folder / service.name}.log")
    print(f"{service.name} {place.address}", flush=True)


def _report(processes: Processes, minutes: float) -> None:
    """Wait, then print cores used: of each service, of all of them, and of the machine."""
    before, begin_s, machine = processes.cpu_s(), time.monotonic(), psutil.cpu_times()
    time.sleep(60 * minutes)
    after, span_s, later = processes.cpu_s(), time.monotonic() - begin_s, psutil.cpu_times()
    for name, spent_s in after.items():
        print(f"{name:12} {(spent_s - before[name]) / span_s:6.3f} cores")
    ours = (sum(after.values()) - sum(before.values())) / span_s
    busy = (sum(later) - later.idle - later.iowait) - (sum(machine) - machine.idle - machine.iowait)
    print(f"{'all':12} {ours:6.3f} cores; the machine {busy / span_s:.3f} of {os.cpu_count()}")


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
