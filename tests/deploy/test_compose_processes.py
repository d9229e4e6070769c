"""Without Docker the compose file's commands run as they stand; only their places differ."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from scripts import ROOT, loaded

ENV = dict(re.findall(r"^(\w+)=(.*)$", (ROOT / ".env").read_text(), re.MULTILINE))


processes = loaded("deploy/compose/processes.py")
COMPOSE = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
SERVICES = processes.read_services(COMPOSE, ENV)
LOCATIONS = processes.locations_of(SERVICES, Path("/run/demo"))


def service(command: list[str], name: str = "a", **more: Any) -> Any:
    content = {"image": "${RFEDGE_IMAGE}", "command": command, **more}
    return processes.read_services({"services": {name: content}}, {"PORT": "7"})[name]


def test_every_service_of_ours_gets_an_address_of_its_own():
    addresses = [location.address for location in LOCATIONS.values()]
    assert len(set(addresses)) == len(addresses) == len(SERVICES) > 10
    assert all(address.startswith("127.77.0.") for address in addresses)


@pytest.mark.parametrize("name", SERVICES)
def test_a_command_keeps_its_words_but_for_places(name):
    words = processes.words_of(SERVICES[name], LOCATIONS)
    assert len(words) == len(SERVICES[name].command)
    for before, after in zip(SERVICES[name].command, words, strict=True):
        if not re.search(r"[/:]|0\.0\.0\.0|rsu|link", before):
            assert after == before


@pytest.mark.parametrize("name", SERVICES)
def test_no_host_name_of_a_container_is_left(name):
    text = " ".join(processes.words_of(SERVICES[name], LOCATIONS))
    assert "0.0.0.0" not in text
    assert re.findall(rf"\b({'|'.join(LOCATIONS)}):\d", text) == []


def test_vehicles_still_have_their_names_and_connect_to_their_links():
    for number in range(1, 5):
        words = processes.words_of(SERVICES[f"cav-{number}"], LOCATIONS)
        assert f"--vehicle=cav-{number}" in words
        assert f"--server={LOCATIONS[f'link-{number}'].address}:50051" in words
        root = LOCATIONS[f"cav-{number}"].root
        assert f"--tls-cert={root}/certs/vehicle-cav-{number}.pem" in words


def test_the_certificates_name_the_addresses_that_are_connected_to():
    text = processes.words_of(SERVICES["certificates"], LOCATIONS)[2]
    hosts = text.partition("--hosts ")[2].partition(";")[0].split()
    servers = [LOCATIONS[name].address for name in SERVICES if name.startswith(("rsu", "link"))]
    assert set(servers) <= set(hosts)
    assert "cav-1 cav-2 cav-3 cav-4" in text, "vehicles are names, not places"


@pytest.mark.parametrize("name", SERVICES)
def test_every_mounted_path_is_moved_under_the_services_root(name):
    one, root = SERVICES[name], LOCATIONS[name].root
    tops = {f"/{target.split('/')[1]}" for target in one.mounts}
    for word in processes.words_of(one, LOCATIONS):
        for top in tops:
            assert re.search(rf"(?<![\w./-]){top}(?=/|\s|$)", word) is None, word
    if tops:
        assert any(str(root) in word for word in processes.words_of(one, LOCATIONS))


def test_mounts_become_links_to_the_checkout_and_to_volumes(tmp_path):
    one = service(["x"], volumes=["./samples/links:/links:ro", "cache:/cache"])
    location = processes.Location("127.77.0.1", tmp_path / "roots/a")
    processes.prepare_root(one, location, tmp_path)
    assert (location.root / "links/steady.toml").is_file()
    (location.root / "cache/file").write_text("kept")
    assert (tmp_path / "volumes/cache/file").read_text() == "kept"


def test_prometheus_scrapes_the_same_targets_under_the_same_names(tmp_path):
    words = processes.prepare_prometheus(LOCATIONS, tmp_path)
    assert words[0] == f"--config.file={tmp_path / 'etc/prometheus/prometheus.yml'}"
    instances = set()
    for path in (tmp_path / "etc/prometheus/targets").glob("*.json"):
        for entry in json.loads(path.read_text()):
            name, port = entry["labels"]["instance"].split(":")
            assert entry["targets"] == [f"{LOCATIONS[name].address}:{port}"]
            instances.add(name)
    assert instances == {name for name in SERVICES if SERVICES[name].health == ":9100/metrics"}
    assert SERVICES["twin"].health == ":8080/healthy"


def test_a_service_gets_its_variables():
    assert SERVICES["twin"].environment == {"RFEDGE_TWIN_TOKEN": ENV["TWIN_TOKEN"]}
    assert SERVICES["rsu-a"].environment == {}


def test_variables_are_filled_in_and_a_dollar_of_the_shell_stays_one():
    assert service(["x", "--port=${PORT}", "a $$b"]).command == ("x", "--port=7", "a $b")
    with pytest.raises(KeyError, match="MISSING"):
        service(["x", "${MISSING}"])


def test_images_of_others_are_left_out_unless_they_are_named():
    compose = {"services": {"p": {"image": "prom:1", "command": ["x"]}}}
    assert processes.read_services(compose, {}) == {}
    assert set(processes.read_services(compose, {}, ("p",))) == {"p"}
