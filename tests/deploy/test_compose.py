"""The compose file starts commands that exist, on files that exist, and locks their doors."""

import asyncio
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import tyro
import yaml
from tyro.conf import OmitSubcommandPrefixes

import cav_agent.__main__ as agent_command
import mec_server.__main__ as server_command
from rfcore.dataset import read_dataset
from rfcore.link.plan import read_link
from rfcore.wire.address import Address
from rfcore.wire.tls import TlsFiles
from rfedge.cli import Verb
from rfedge.cli.field_tiles import FieldPublish
from rfedge.cli.services import CertsInit
from rfedge.link import LinkSettings
from rfedge.twin.web import WebSettings
from scripts import ROOT, loaded

COMPOSE = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
STAND_IN = yaml.safe_load((ROOT / "deploy/stand-in/docker-compose.yml").read_text())
ENV = dict(re.findall(r"^(\w+)=(.*)$", (ROOT / ".env").read_text(), re.MULTILINE))
SERVICES: dict[str, Any] = COMPOSE["services"]
OURS = [name for name, service in SERVICES.items() if service["image"] == "${RFEDGE_IMAGE}"]
LASTING = [name for name in SERVICES if "healthcheck" in SERVICES[name]]


def filled(text: str) -> str:
    """Return ``text`` with its variables as .env has them; a missing one is an error."""
    return re.sub(r"\$\{(\w+)\}", lambda found: ENV[found[1]], text).replace("$$", "$")


def command(name: str) -> list[str]:
    """Return the words that a service runs; of a shell's line, those of the command of ours."""
    words = [filled(str(word)) for word in SERVICES[name]["command"]]
    if words[:2] == ["sh", "-c"]:
        words = shlex.split(words[2].rpartition("|| ")[2].partition(";")[0])
    return words


def running(program: str) -> list[str]:
    return [name for name in OURS if command(name)[0] == program]


def host_path(name: str, path: str) -> Path:
    """Return the file of the checkout that a service sees at ``path``."""
    for volume in SERVICES[name]["volumes"]:
        source, target = volume.split(":")[:2]
        if path == target or path.startswith(f"{target}/"):
            assert source.startswith("./"), f"{path} of {name} is in no bind mount"
            return ROOT / source / path.removeprefix(target).lstrip("/")
    pytest.fail(f"{name} has nothing at {path}")


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folders that the one-shot service fills, by the very line it runs."""
    folder = tmp_path_factory.mktemp("certificates")
    for path in mounts("certificates").values():
        (folder / path.lstrip("/")).mkdir(parents=True, exist_ok=True)
    line = filled(SERVICES["certificates"]["command"][2])
    line = re.sub(r"/(certs|keys)\b", rf"{folder}/\1", line)
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    for _ in range(2):  # when services are started again, nothing is made anew
        subprocess.run(["sh", "-c", line], check=True, env=os.environ | {"PATH": path})
    return folder


def verb_of(name: str) -> Any:
    """Return what ``rfedge`` makes of a service's command line."""
    return tyro.cli(Verb, args=command(name)[1:], config=(OmitSubcommandPrefixes,))


def mounts(name: str) -> dict[str, str]:
    """Return where a service has its volumes, by their names."""
    volumes = (volume.split(":") for volume in SERVICES[name].get("volumes", []))
    return {source: target for source, target, *_ in volumes}


def keys_of(name: str, certificates: Path) -> Path:
    """Return what a service sees at /certs."""
    (volume,) = (source for source, target in mounts(name).items() if target == "/certs")
    return certificates / mounts("certificates")[volume].lstrip("/")


def config_of(
    name: str, module: Any, certificates: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Any:
    """Return what a service's program makes of its command line."""
    own = keys_of(name, certificates)
    words = [re.sub("=/certs/", f"={own}/", word) for word in command(name)]
    words = [re.sub(r"=/(fields|cache)$", f"={tmp_path}", word) for word in words]
    words = [re.sub(r"=/pictures/.*$", f"={tmp_path}", word) for word in words]
    configs: list[Any] = []
    start = "drive" if module is agent_command else "serve"
    monkeypatch.setattr(module, start, configs.append)
    monkeypatch.setattr(asyncio, "run", lambda _: None)
    monkeypatch.setattr("rfcore.wire.settings.configure_logs", lambda *_: None)
    monkeypatch.setattr(sys, "argv", words)
    module.main()
    return configs[0]


@pytest.mark.parametrize("name", running("mec-server"))
def test_a_server_takes_its_command_line(name, certificates, tmp_path, monkeypatch):
    config = config_of(name, server_command, certificates, tmp_path, monkeypatch)
    assert isinstance(config.transport.tls(), TlsFiles)
    assert config.metrics.port == 9100


@pytest.mark.parametrize("name", running("cav-agent"))
def test_a_vehicle_takes_its_command_line_and_is_whom_its_certificate_names(
    name, certificates, tmp_path, monkeypatch
):
    config = config_of(name, agent_command, certificates, tmp_path, monkeypatch)
    assert config.vehicle == name
    assert config.transport.tls().certificate.name == f"vehicle-{name}.pem"
    assert config.loop, "a demo goes on"


@pytest.mark.parametrize("name", OURS)
def test_a_service_holds_its_own_key_and_the_authority_s_only_where_it_signs(name, certificates):
    if "/certs" not in mounts(name).values() or name == "certificates":
        assert not any(volume.startswith(("keys", "authority")) for volume in mounts(name)) or (
            name == "certificates"
        )
        return
    own = keys_of(name, certificates)
    (key,) = own.glob("*.key")
    assert key.stat().st_mode & 0o777 == 0o600
    assert key.name != "ca.key"
    assert f"--tls-key=/certs/{key.name}" in command(name)
    assert sorted(path.name for path in own.iterdir()) == ["ca.pem", key.name, f"{key.stem}.pem"]


def test_places_of_keys_belong_to_the_user_of_the_image():
    made = (
        (ROOT / "Dockerfile").read_text().partition("install -d -o rfedge")[2].partition("COPY")[0]
    )
    assert set(mounts("certificates").values()) <= set(made.split())


@pytest.mark.parametrize("name", running("rfedge"))
def test_a_verb_takes_its_command_line(name):
    verb = verb_of(name)
    assert verb is not None


def test_every_link_leads_from_a_vehicle_to_a_server_that_its_certificate_names():
    init = verb_of("certificates")
    made: CertsInit = init.verb
    servers = running("mec-server")
    links = [name for name in running("rfedge") if command(name)[1] == "link"]
    assert set(made.vehicles) == set(running("cav-agent"))
    assert set(made.hosts) == {*servers, *links, "localhost", "127.0.0.1"}
    for name in links:
        link = verb_of(name)
        paths = LinkSettings(link.to, listen=link.listen, also=link.also, allow_insecure=True)
        assert [str(to) for _, to in paths.paths()] == [f"{server}:50051" for server in servers]
        read_link(host_path(name, str(link.profile)))
    for name in running("cav-agent"):
        words, link = command(name), f"link-{name.removeprefix('cav-')}"
        assert f"--server={link}:50051" in words
        assert words[words.index("--neighbours") + 1] == f"{link}:50052"


def test_the_tiles_of_the_servers_meet_and_each_reaches_over_the_whole_drive():
    tiles: list[FieldPublish] = []
    for name in ("field-a", "field-b"):
        verb = verb_of(name)
        tiles.append(verb.verb)
        assert host_path(name, str(verb.verb.field)).is_file()
    (west, east) = (tile.area for tile in tiles)
    assert west[2] == east[0]
    margins_m = [tile.margin_m or 0.0 for tile in tiles]
    drive = read_dataset(ROOT / "samples/street/transforms_drive_empty.json").pictures
    along_m = [picture.camera.world_from_cam.translation_m[0] for picture in drive]
    assert east[0] - margins_m[1] <= min(along_m)
    assert west[2] + margins_m[0] >= max(along_m)
    assert min(along_m) + 5 < west[2] < max(along_m) - 5, "vehicles pass from one to the other"


def test_pictures_are_reduced_for_every_vehicle_and_each_drives_its_own():
    line = filled(SERVICES["pictures"]["command"][2])
    names, out = re.search(r"for vehicle in ([^;]*); do out=(\S+);", line).groups()
    assert line.startswith("set -e;"), "a drive that cannot be made stops the service"
    assert set(names.split()) == set(running("cav-agent"))
    for name in running("cav-agent"):
        assert f"--drive={out.replace('$vehicle', name)}" in command(name)
    words = shlex.split(line.rpartition("|| ")[2].partition(";")[0])
    convert: Any = tyro.cli(Verb, args=words[1:], config=(OmitSubcommandPrefixes,))
    assert convert.verb.size == ENV["PICTURE_SIZE"]


@pytest.mark.sample
@pytest.mark.parametrize("name", running("cav-agent"))
def test_a_drive_comes_back_to_where_it_began_and_its_pictures_are_there(name, tmp_path):
    for folder in ("drive_empty", "drive_vehicles"):
        (tmp_path / folder).symlink_to(host_path("pictures", f"/drives/{folder}"))
    transforms = host_path("pictures", f"/drives/{name}.json")
    (tmp_path / "transforms.json").write_text(transforms.read_text())
    pictures = read_dataset(tmp_path).pictures
    east_m = [picture.camera.world_from_cam.translation_m[0] for picture in pictures]
    step_m = max(abs(b - a) for a, b in zip(east_m, [*east_m[1:], east_m[0]], strict=True))
    assert step_m < 1.0, "the longest step, the one back to the beginning included"


def test_the_drives_are_what_their_description_makes(tmp_path):
    loaded("deploy/compose/drives.py").write_drives(tmp_path)
    committed = sorted((ROOT / "deploy/compose/drives").glob("*.json"))
    assert [path.name for path in committed] == sorted(path.name for path in tmp_path.iterdir())
    for path in committed:
        assert path.read_text() == (tmp_path / path.name).read_text()


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_may_do_little(name):
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service.get("user", "of the image") != "root"


def test_the_images_of_ours_do_not_run_as_root():
    stages = re.split(r"^FROM ", (ROOT / "Dockerfile").read_text(), flags=re.MULTILINE)
    for stage in stages:
        if re.match(r"python AS (runtime|full)\n", stage):
            assert re.search(r"^USER rfedge$", stage, re.MULTILINE)


@pytest.mark.parametrize("name", LASTING)
def test_what_runs_for_ever_is_bounded_and_comes_back(name):
    service = SERVICES[name]
    assert service["restart"] == "unless-stopped"
    assert {"mem_limit", "cpus"} <= set(service)


def test_everything_that_is_served_is_scraped():
    targets = {
        target
        for path in sorted((ROOT / "deploy/compose/targets").glob("*.json"))
        for entry in json.loads(path.read_text())
        for target in entry["targets"]
    }
    serving = {name for name in OURS if any("--metrics-port" in w for w in command(name))}
    assert targets == {f"{name}:9100" for name in serving}
    assert serving == {name for name in OURS if name in LASTING} - {"twin"}


def test_the_twin_has_a_certificate_of_its_own_and_a_token():
    verb = verb_of("twin")
    init = verb_of("certificates")
    assert verb.target == f"{running('mec-server')[0]}:50051"
    assert verb.connection.tls_key.stem.removeprefix("consumer-") in init.verb.consumers
    assert verb.connection.tls_key.name not in " ".join(command("watch")), "a key is one service's"
    token = filled(SERVICES["twin"]["environment"]["RFEDGE_TWIN_TOKEN"])
    WebSettings(Address.parse("http", verb.http), token)
    (port,) = SERVICES["twin"]["ports"]
    assert filled(port) == f"127.0.0.1:{ENV['TWIN_PORT']}:{verb.http.rpartition(':')[2]}"
    assert SERVICES["twin"]["healthcheck"]["test"][2] == verb.http.rpartition(":")[2]
    assert f":{ENV['TWIN_PORT']}/?token={token}" in filled(SERVICES["urls"]["command"][2])


@pytest.mark.parametrize("name", SERVICES)
def test_what_is_mounted_is_there_and_ports_stay_on_this_machine(name):
    for volume in SERVICES[name].get("volumes", []):
        source = volume.split(":")[0]
        assert (ROOT / source).exists() if source.startswith("./") else source in COMPOSE["volumes"]
    for port in SERVICES[name].get("ports", []):
        assert filled(port).startswith("127.0.0.1:")


def test_foreign_images_are_pinned():
    for name in set(SERVICES) - set(OURS):
        assert re.search(r":v?\d+\.\d+\.\d+$", filled(SERVICES[name]["image"]))


def test_the_stand_in_changes_nothing_but_images():
    assert set(STAND_IN["services"]["prometheus"]) == {"image", "build"}
    assert set(STAND_IN["services"]["grafana"]) == {"profiles"}
